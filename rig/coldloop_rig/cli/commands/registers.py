"""`coldloop registers`: the register maps, as a table, Markdown, CSV or JSON, or as files of other programs."""

import argparse
import sys

from coldloop_rig.cli.commands.choices import REGISTER_FORMATS, SERVICES, TAG_FORMATS
from coldloop_rig.cli.commands.options import HostPort, port_base


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--format", choices=(*REGISTER_FORMATS, *TAG_FORMATS), default="table",
                        help="fuxa, grafana, ignition, node-red, telegraf: files for these programs")  # fmt: skip
    parser.add_argument("--service", choices=SERVICES, help="default: all")
    parser.add_argument("--host", default="127.0.0.1", help="where these programs find the rig (default: 127.0.0.1)")
    parser.add_argument("--port-base", type=port_base, metavar="PORT", help="first of three consecutive ports")


def execute(options: argparse.Namespace) -> int:
    """Print the list."""
    from coldloop.process.settings import settings_process
    from coldloop.registers.maps import maps_of
    from coldloop_rig.cli.register_listing import FORMATS

    every = maps_of(settings_process()).by_service
    maps = [every[options.service]] if options.service else list(every.values())
    if options.format in FORMATS:
        sys.stdout.write(FORMATS[options.format](maps))
        return 0
    from coldloop_rig.cli.tag_exports import EXPORTS
    from coldloop_rig.cosim.wiring import SERVICES as IN_ORDER
    from coldloop_rig.live.started_rigs import ports_from

    ports = ports_from(options.port_base)
    places = {service: HostPort(options.host, port) for service, port in zip(IN_ORDER, ports, strict=True)}
    sys.stdout.write(EXPORTS[options.format](maps, places))
    return 0
