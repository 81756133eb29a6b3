"""`coldloop page`: the operator's page of a rig that is up, or of recorded runs."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from coldloop.errors import UsageError
from coldloop_rig.cli.commands.options import add_rig_options, configuration, rig_endpoints

if TYPE_CHECKING:
    from coldloop_rig.settings import Settings

MOST_RUNS = 2


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_rig_options(parser)
    parser.add_argument("runs", nargs="*", type="folder", metavar="RUN",
                        help="folder of a recorded run; two: side by side; none: a rig that is up")  # fmt: skip
    parser.add_argument("--page-port", type=int, metavar="PORT", help="port of the page (default: 8020)")


def execute(options: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    if len(options.runs) > MOST_RUNS:
        raise UsageError(f"{len(options.runs)} runs: one is replayed, or two side by side")
    from coldloop_rig.live.up import check_page

    effective = configuration(options).settings
    check_page(effective.hmi)
    from coldloop_rig.until_interrupted import run_until_interrupted

    if options.runs:
        return 130 if run_until_interrupted(lambda: _replay(options.runs, effective)) else 0
    return 130 if run_until_interrupted(lambda: _watch(options, effective)) else 0


async def _replay(folders: list[Path], settings: "Settings") -> None:
    from coldloop_hmi.replay import serve_replays
    from coldloop_rig.live.recorded_page import RecordedPage
    from coldloop_rig.results.run_folder import RunFolder

    await serve_replays([RecordedPage(RunFolder(folder)) for folder in folders], settings.hmi, _say)


async def _watch(options: argparse.Namespace, settings: "Settings") -> None:
    from coldloop_hmi.runtime import serve
    from coldloop_hmi.settings import HmiSettings
    from coldloop_rig.live.started_rigs import make_own_folder
    from coldloop_rig.live.up import pointed_at, with_own_files

    pointed = pointed_at(settings.hmi, rig_endpoints(options, settings))
    section, login = with_own_files(pointed, make_own_folder(f"page-{pointed.port}"))
    _say(f"http{'s' if section.https else ''}://{section.host}:{section.port}/")
    if login is not None:
        _say(login.line.strip())
    await serve(HmiSettings(model=settings.model, hmi=section))


def _say(address: str) -> None:
    sys.stdout.write(f"{address}\n")
    sys.stdout.flush()
