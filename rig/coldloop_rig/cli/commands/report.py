"""`coldloop report`: one HTML page of a recorded run, with interactive plots, alarms and settings."""

import argparse
import sys
from pathlib import Path


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run", type="folder", metavar="RUN", help="folder of a run")
    parser.add_argument("--out", type="write", metavar="FILE", help="page (default: report.html in the run's folder)")
    parser.add_argument("--force", action="store_true", help="replace a page that exists")


def execute(options: argparse.Namespace) -> int:
    """Write the page."""
    from coldloop.errors import UsageError
    from coldloop.whole_file import require_regular_file, whole_text
    from coldloop_rig.report.run_page import run_page
    from coldloop_rig.results.folders import writing

    path: Path = options.out or options.run / "report.html"
    require_regular_file(path)
    if path.exists() and not options.force:
        raise UsageError(f"{path}: exists; name another page with --out, or overwrite with --force")
    page = run_page(options.run)
    with writing(path):
        whole_text(path, page)
    sys.stdout.write(f"{path}\n")
    return 0
