"""`coldloop status`: what a rig that is up is doing."""

import argparse
import asyncio
import sys
from typing import Final

from coldloop_rig.cli.commands.options import add_rig_options, operator_settings, rig_endpoints, rig_services
from coldloop_rig.terminal import coloured, cut, fitted, width

LOOK_S: Final = 1.0


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_rig_options(parser)
    parser.add_argument("--follow", action="store_true", help="a line a second until Ctrl-C")


def execute(options: argparse.Namespace) -> int:
    """Print the state once, or again and again."""
    from coldloop_rig.until_interrupted import run_until_interrupted

    interrupted = run_until_interrupted(lambda: _show(options))
    return 130 if interrupted and not options.follow else 0


async def _show(options: argparse.Namespace) -> None:
    from coldloop.operating.execution import clients_of
    from coldloop_rig.live.status import colour, line, page, read_status

    settings = operator_settings(options)
    endpoints = rig_endpoints(options, settings)
    clients = clients_of({each: getattr(endpoints, each) for each in rig_services(options)}, settings.process)
    try:
        status = await read_status(clients)
        if not options.follow:
            sys.stdout.write(fitted(page(status), width()))
        while options.follow:
            sys.stdout.write(f"{coloured(cut(line(status), width()), colour(status))}\n")
            sys.stdout.flush()
            await asyncio.sleep(LOOK_S)
            status = await read_status(clients)
    finally:
        for client in clients.values():
            client.close()
