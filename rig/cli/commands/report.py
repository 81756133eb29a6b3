"""`coldloop report`: one HTML page of a recorded run, with interactive plots, alarms and settings."""

import argparse
import sys
from pathlib import Path


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("--out", type=Path, metavar="FILE", help="page (default: report.html in the folder of the run)")
    parser.add_argument("--force", action="store_true", help="replace a page that exists")
    parser.set_defaults(execute=execute)


def execute(options: argparse.Namespace) -> int:
    """Write the page."""
    from coldloop.errors import ResultsError, UsageError
    from rig.report.run_page import run_page
    from rig.results.folders import require_regular_file, whole_file

    path: Path = options.out or options.run / "report.html"
    require_regular_file(path)
    if path.exists() and not options.force:
        raise UsageError(f"{path}: exists; name another page with --out, or overwrite with --force")
    page = run_page(options.run)
    try:
        whole_file(path, lambda draft: draft.write_text(page, encoding="utf-8"))
    except OSError as error:
        raise ResultsError(f"{path}: {error.strerror}; choose another --out") from None
    sys.stdout.write(f"{path}\n")
    return 0
