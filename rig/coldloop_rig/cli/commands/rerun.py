"""`coldloop rerun`: repeat a recorded run from its manifest, in one process, and compare the traces."""

import argparse
import sys
from pathlib import Path
from typing import Final

from coldloop.errors import UsageError

TRUST: Final = "--trust"
MANIFEST: Final = "manifest.json"


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("manifest", type="folder", metavar="MANIFEST", help="manifest.json of a run, or its folder")
    parser.add_argument(TRUST, action="store_true", help="execute the plant of another process that the folder"
                        " holds; else --process names a file that gives the same model")  # fmt: skip
    parser.add_argument("--out", type="into", help="folder for the results of the repetition (default: none are kept)")
    parser.add_argument("--force", action="store_true", help="replace the run in a folder that is not empty")


def execute(options: argparse.Namespace) -> int:
    """Run again; 0 for the same trace, 1 for another one."""
    from coldloop.process.settings import ModelSettings
    from coldloop_rig.runs.rerun import repeat

    path: Path = options.manifest
    if path.is_file() and path.name != MANIFEST:
        raise UsageError(f"{path}: not the {MANIFEST} of a run; name that, or its folder")
    folder, trusted = path.parent if path.name == MANIFEST else path, None if options.trust else ModelSettings().file
    same, text = repeat(folder, options.out, force=options.force, trusted=trusted)
    sys.stdout.write(text)
    return 0 if same else 1
