"""The command `export`."""

import argparse
import sys
from pathlib import Path
from typing import Final

from coldloop import errors, service
from coldloop_rig.cli.commands.options import Command, positive_count

PLC: Final = Path("plc")
SAID: Final = {"export": "a run as CSV, MATLAB or HDF5; the optimiser as C99 or Structured Text"}
GROUP: Final = {"export": "a run"}
"""Group in which `coldloop --help` lists the command."""


def _declare(parser: argparse.ArgumentParser) -> None:
    service.add_configuration_options(parser)
    parser.add_argument("run", type="folder", metavar="RUN", help="folder of a run; plc, with --target: the optimiser")
    kinds = parser.add_mutually_exclusive_group(required=True)
    for kind, text in (
        ("csv", "a CSV file for each of trace, updates, events"),
        ("mat", "run.mat, with a structure for each of them"),
        ("hdf5", "run.h5, with a group for each of them (needs h5py)"),
    ):
        kinds.add_argument(f"--{kind}", dest="kind", action="store_const", const=kind, help=text)
    kinds.add_argument("--target", choices=("c", "st", "plcopen"), help="with plc: the whole optimiser in single"
                       " precision, its ODE-based solver alone and the output guard, as C99, as Structured Text"
                       " (IEC 61131-3), or as PLCopen XML of that; with golden vectors and self-tests")  # fmt: skip
    parser.add_argument("--out", type="into", metavar="FOLDER", help="where to (default: the folder of the run)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    parser.add_argument("--plc", type="name", metavar="PLC", help="with plc: a profile, as of coldloop budget: the"
                        " READMEs say what takes how long there, and what does not fit")  # fmt: skip
    parser.add_argument("--ticks", type=positive_count, metavar="N", help="with plc: length of the run whose problems"
                        " are the golden vectors (default: 1440, six minutes)")  # fmt: skip
    parser.add_argument("--score", action="store_true", help="with plc --target c: compile it (gcc), change single bits"
                        " of its tables in the linked programs, and put into the manifest which the self-tests miss;"
                        " takes minutes")  # fmt: skip


def execute_export(options: argparse.Namespace) -> int:
    """A recorded run as CSV, MATLAB or HDF5 files, with units; or the optimiser as sources for a PLC."""
    if options.target is not None:
        paths = _optimizer(options)
    elif options.ticks is not None:
        raise errors.UsageError("--ticks: is for coldloop export plc --target")
    elif options.config or options.assignments or options.plc or options.score:
        raise errors.UsageError("--config, --set, --plc and --score: are for coldloop export plc --target")
    else:
        from coldloop_rig.results.run_folder import export

        paths = export(options.run, options.kind, options.out or options.run, force=options.force)
    sys.stdout.writelines(f"{path}\n" for path in paths)
    return 0


def _optimizer(options: argparse.Namespace) -> list[Path]:
    """Write the optimiser of the paper's PLC, unless the user says otherwise."""
    from coldloop.config import load_configuration
    from coldloop_export import folder, golden
    from coldloop_rig.cli import process_setting
    from coldloop_rig.plc_sizing.plc import find_profile
    from coldloop_rig.settings import Settings

    if options.run != PLC:
        raise errors.UsageError(
            f"{options.run}: has no target; coldloop export plc --target {options.target} --out FOLDER"
        )
    if options.out is None or options.force:
        raise errors.UsageError("export plc: name a new folder with --out; --force does not replace one")
    if options.score and options.target != "c":
        raise errors.UsageError(f"--score: is for --target c; no linker makes a program of {options.target} here")
    profile = find_profile(options.plc) if options.plc else None
    assignments, process = [*golden.SINGLE, *options.assignments], process_setting(options.assignments)
    loaded = load_configuration(Settings, file=options.config, assignments=assignments, options=process)
    return folder.export_plc(options.target, options.ticks, options.out, loaded.settings, profile, score=options.score)


COMMANDS: Final = {"export": Command(_declare, execute_export)}
