"""`coldloop up`: the rig on fixed ports, in real time, until Ctrl-C."""

import argparse

from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands.choices import WITHOUT
from coldloop_rig.cli.commands.options import PLACES, add_loop_options, check_load, port_base, refuse_ineffective


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--factor", type=float, help="seconds of plant time per second (default: 1)")
    add_loop_options(parser, "or, its end held, ")
    parser.add_argument("--tls", type="folder", metavar="FOLDER",
                        help="Modbus/TCP Security with what `coldloop certificates --out FOLDER` made")  # fmt: skip
    parser.add_argument("--port-base", type=port_base, metavar="PORT",
                        help="first of three consecutive ports (default: 5020)")  # fmt: skip
    parser.add_argument("--page", action="store_true", help="serve the operator's page, too")
    parser.add_argument("--page-port", type=int, metavar="PORT", help="its port (default: 8020); implies --page")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--without", choices=WITHOUT, metavar="|".join(WITHOUT),
                       help="leave its place to a client of your own (`coldloop docs your-optimiser`)")  # fmt: skip
    other.add_argument("--optimizer", type="export", metavar="export:FOLDER",
                       help="the exported optimiser in the place of ours (`coldloop docs plc-export`)")  # fmt: skip
    parser.add_argument("--cuttable", action="store_true",
                        help="put a proxy into each link, for `coldloop fault cut`")  # fmt: skip
    parser.add_argument("--detach", action="store_true", help="return when it is up; `coldloop down` ends it")
    parser.add_argument("--quiet", action="store_true", help="do not print addresses and commands")
    parser.add_argument("--locked", type=int, help=argparse.SUPPRESS)  # what --detach has locked for this process
    parser.set_defaults(mode="realtime")


def execute(options: argparse.Namespace) -> int:
    """Start the rig; end it with Ctrl-C."""
    check_load(options.load)
    from coldloop_rig.cli.commands.options import configuration, exported, tell
    from coldloop_rig.live.started_rigs import RigLock, check_ports, detached, ports_from
    from coldloop_rig.runs.remarks import remarks
    from coldloop_rig.runs.running import check_certificates

    effective = configuration(options)
    refuse_ineffective(
        effective, {**dict.fromkeys(PLACES, "give --port-base"), "session.autostart": "it begins a session"}
    )
    check_certificates(effective.settings)
    told = [] if options.without else remarks(effective)
    optimizer = exported(options.optimizer, effective.settings)
    ports = ports_from(options.port_base)
    lock = RigLock(ports[0], options.locked)
    check_ports(ports)
    page = options.page or options.page_port is not None
    if page:
        from coldloop_rig.live.up import check_page

        check_page(effective.settings.hmi)
    if options.detach and options.locked is None:
        return detached(ports, lock)
    from coldloop_rig.cosim.wiring import REQUIRED, SERVICES
    from coldloop_rig.live.up import UpRig
    from coldloop_rig.until_interrupted import run_until_interrupted

    for line in told:
        tell(line)
    services = REQUIRED if options.without else SERVICES
    rig = UpRig(effective.settings, ports, options.tls, page=page, cuttable=options.cuttable, services=services,
                optimizer=optimizer)  # fmt: skip
    run_until_interrupted(lambda: rig.run(announce=not options.quiet))
    return 0
