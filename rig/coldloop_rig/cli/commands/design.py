"""`coldloop design`: which decision and constraint instants the problem needs, by what each set costs in the loop."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands.options import check_load, configuration

if TYPE_CHECKING:
    from coldloop_rig.studies.instants import Judged


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--load", type="name", dest="loads", nargs="+", metavar="LOAD", default=["a"],
                        help="loads to compare them under: names or CSV files (default: a)")  # fmt: skip
    parser.add_argument("--figure", type="write", metavar="FILE",
                        help="draw loss and iterations over the number of variables: .png, .pdf or .svg")  # fmt: skip
    parser.add_argument("--out", type="write", metavar="FILE", help="write the proposed set as a configuration (TOML)")


def execute(options: argparse.Namespace) -> int:
    """Compare, print; draw when there is --figure, write the proposal when there is --out."""
    from coldloop.errors import UsageError
    from coldloop.whole_file import require_regular_file, whole_text
    from coldloop_rig.cli.commands.choices import FIGURE_FORMATS
    from coldloop_rig.progress import make_console
    from coldloop_rig.results.folders import writing
    from coldloop_rig.studies import instants

    for name in options.loads:
        check_load(name)
    for path in filter(None, (options.figure, options.out)):
        require_regular_file(path)
    if options.figure and options.figure.suffix.removeprefix(".") not in FIGURE_FORMATS:
        raise UsageError(f"--figure {options.figure}: name a .png, .pdf or .svg file")
    settings = configuration(options).settings
    with make_console().status("") as status:
        found = instants.judged(
            settings, options.loads, lambda done, of: status.update(f"{done} of {of} sets of instants")
        )
    sys.stdout.write(instants.table(found, options.loads))
    if options.figure is not None:
        _draw(found, options.loads, options.figure)
    if options.out is not None:
        with writing(options.out):
            whole_text(options.out, instants.configuration(found))
        sys.stdout.write(f"written to {options.out}\n")
    return 0


def _draw(found: "Sequence[Judged]", loads: Sequence[str], path: Path) -> None:
    from coldloop_rig.figures.run_plot import save_figure
    from coldloop_rig.results.folders import writing
    from coldloop_rig.studies.instants_figure import drawn

    with writing(path, "choose another --figure"):
        save_figure(drawn(found, loads), path)
    sys.stdout.write(f"figure in {path}\n")
