"""`coldloop plot`: the figure of a recorded run again, as PNG, PDF or SVG."""

import argparse
import sys

from coldloop_rig.cli.commands.choices import FIGURE_FORMATS


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run", type="folder", metavar="RUN", help="folder of a run")
    parser.add_argument("--figures", nargs="+", choices=FIGURE_FORMATS, default=["png", "pdf", "svg"],
                        metavar="FORMAT", help="png, pdf, svg (default: all)")  # fmt: skip


def execute(options: argparse.Namespace) -> int:
    """Draw."""
    from coldloop_rig.figures.run_plot import plot_run
    from coldloop_rig.results.folders import writing

    with writing(options.run, "the figure was not written"):
        paths = plot_run(options.run, options.figures)
    sys.stdout.writelines(f"{path}\n" for path in paths)
    return 0
