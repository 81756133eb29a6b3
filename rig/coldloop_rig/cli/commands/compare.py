"""`coldloop compare`: a table and a figure of several recorded runs."""

import argparse
import sys
from pathlib import Path


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("runs", nargs="+", type="folder", metavar="RUN", help="folders of runs, two or more")
    parser.add_argument("--out", type="write", default=Path("compare.png"), metavar="FILE",
                        help="figure: .png, .pdf or .svg (default: compare.png)")  # fmt: skip
    parser.add_argument("--force", action="store_true", help="replace a figure that exists")


def execute(options: argparse.Namespace) -> int:
    """Print the table and draw the figure."""
    from coldloop.errors import UsageError
    from coldloop_rig.cli.commands.choices import FIGURE_FORMATS
    from coldloop_rig.figures.comparison import compare

    if len(options.runs) < 2:
        raise UsageError("compare: name two runs or more")
    if options.out.suffix.removeprefix(".") not in FIGURE_FORMATS:
        raise UsageError(f"--out {options.out}: name a .png, .pdf or .svg file")
    if options.out.exists() and not options.force:
        raise UsageError(f"{options.out}: exists; name another figure with --out, or overwrite with --force")
    sys.stdout.write(compare(options.runs, options.out))
    return 0
