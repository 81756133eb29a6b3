"""`coldloop export`: a recorded run as CSV, MATLAB or HDF5 files, with units."""

import argparse
import sys
from pathlib import Path


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    kinds = parser.add_mutually_exclusive_group(required=True)
    for kind, text in (
        ("csv", "a CSV file for each of trace, updates, events"),
        ("mat", "run.mat, with a structure for each of them"),
        ("hdf5", "run.h5, with a group for each of them (needs h5py)"),
    ):
        kinds.add_argument(f"--{kind}", dest="kind", action="store_const", const=kind, help=text)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where to (default: the folder of the run)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def execute(options: argparse.Namespace) -> int:
    """Write the files."""
    from rig.results.export import export

    paths = export(options.run, options.kind, options.out or options.run, force=options.force)
    sys.stdout.writelines(f"{path}\n" for path in paths)
    return 0
