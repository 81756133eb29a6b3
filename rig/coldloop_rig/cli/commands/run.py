"""`coldloop run`: one run of the loop, recorded, evaluated and drawn."""

import argparse
from typing import TYPE_CHECKING

from coldloop.errors import UsageError
from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands.choices import MODES
from coldloop_rig.cli.commands.options import (
    OWN_PORTS,
    PLACES,
    add_loop_options,
    add_result_options,
    check_load,
    configuration,
    endpoint,
    exported,
    refuse_ineffective,
)
from coldloop_rig.durations import duration

if TYPE_CHECKING:
    from coldloop_rig.cosim.scenario import Job


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--mode", choices=MODES, help="default: lockstep")
    parser.add_argument("--factor", type=float, help="real time only: seconds of plant time per second (default: 1)")
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--in-process", action="store_true", help="one process and direct calls instead of Modbus/TCP")
    way.add_argument("--attach", nargs=3, type=endpoint, metavar="HOST:PORT",
                     help="use a rig that is up: plant, control PLC, optimiser PLC")  # fmt: skip
    way.add_argument("--optimizer", type="export", metavar="export:FOLDER",
                     help="the exported optimiser in the place of ours (`coldloop docs plc-export`)")  # fmt: skip
    parser.add_argument("--duration", type=duration, help="plant time, such as 2h or 90s (default: that of the load)")
    add_loop_options(parser, "another draw such as a@2, or ")
    add_result_options(parser, "<load>")


def execute(options: argparse.Namespace) -> int:
    """Run, and write the results."""
    check_load(options.load)
    from coldloop_rig.figures.worker import FigureProcess

    with FigureProcess(options.figures) as figure:
        if options.in_process:
            from coldloop.kernels.lean_numba import load_numba_alone

            figure.start()  # a short run would wait for matplotlib
            load_numba_alone()
        from coldloop_rig.cli.recorded_job import record

        return record(_job(options), options, figure)


def _job(options: argparse.Namespace) -> "Job":
    """Return the run that the options and the configuration ask for."""
    from coldloop.modbus.endpoints import Endpoint
    from coldloop_rig.cosim.scenario import Job
    from coldloop_rig.results.way import Way
    from coldloop_rig.runs.running import check_certificates, make_scenario

    effective = configuration(options)
    settings = effective.settings
    realtime = settings.session.mode == "realtime"
    if options.in_process and realtime:
        raise UsageError("--in-process runs in lock-step: drop it, or --mode realtime")
    factor_from = effective.sources.get("session.factor")
    if factor_from and not realtime and (settings.session.factor != 1.0 or factor_from.startswith("--")):
        raise UsageError(f"{factor_from}: a factor has no effect in lock-step; add --mode realtime")
    ticks = options.duration.ticks(settings.process.tick_s) if options.duration else None
    scenario = make_scenario(settings, ticks)
    if options.attach:
        from coldloop_rig.cosim.networked_run import as_attached
        from coldloop_rig.cosim.wiring import QUIET_S

        ends = [
            Endpoint(host=end.host, port=end.port, tls=settings.rig.tls, timeout_s=QUIET_S) for end in options.attach
        ]
        return Job(as_attached(effective, ends), scenario, Way.ATTACHED, tuple(ends))
    refuse_ineffective(effective, {**dict.fromkeys(PLACES, OWN_PORTS), "session.autostart": "it begins a session"})
    if options.in_process:
        return Job(effective, scenario, Way.IN_PROCESS)
    check_certificates(settings)
    return Job(effective, scenario, Way.LOCALHOST, optimizer=exported(options.optimizer, settings))
