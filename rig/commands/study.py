"""`coldloop study`: a question that takes many runs, from the paper or beyond it."""

import argparse
import os
import sys
from pathlib import Path

from coldloop.errors import UsageError
from rig.commands.options import duration
from rig.studies import STUDIES
from rig.studies.execution import Workers
from rig.studies.results import conduct
from rig.studies.study import StudyOptions


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("name", nargs="?", metavar="NAME", help="see --list")
    parser.add_argument("--list", action="store_true", help="name the studies")
    parser.add_argument("--duration", type=duration, help="plant time of each run (default: that of its load)")
    parser.add_argument("--load", nargs="+", metavar="LOAD", default=[], help="named loads or CSV files time_s,load_w")
    add_scale_options(parser)
    parser.set_defaults(execute=execute)


def add_scale_options(parser: argparse.ArgumentParser) -> None:
    """Declare how much is done, by whom, and where the results go."""
    parser.add_argument("--seeds", type=_positive, default=3, metavar="N",
                        help="draws of each load; of a file, draws of the sensors' noise (default: 3)")  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="one seed, ten minutes, fewer points")
    parser.add_argument("--workers", type=_positive, metavar="N", help="processes to use (default: one a core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler that is up, such as tcp://host:8786")
    parser.add_argument("--out", type=Path, default=Path("studies"), help="folder for all results (default: studies)")


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 1 on")
    return int(text)


def workers(options: argparse.Namespace) -> Workers:
    """Return who does the runs.

    Raises:
        UsageError: Both workers and a scheduler are asked for.
    """
    if options.scheduler and options.workers:
        raise UsageError("--workers is for a local cluster and --scheduler for one that is up: give one of them")
    return Workers(options.workers or os.cpu_count() or 1, options.scheduler)


def execute(options: argparse.Namespace) -> int:
    """Do a study, or list them."""
    if options.list or options.name is None:
        for name, study in STUDIES.items():
            sys.stdout.write(f"{name:18} {study.title}\n")
        return 0
    if options.name not in STUDIES:
        raise UsageError(f"study {options.name}: there is no such study; `coldloop study --list` names them")
    study = STUDIES[options.name]
    asked = StudyOptions(options.seeds, options.duration, tuple(options.load), options.quick)
    result = conduct(study, asked, workers(options), options.out)
    for what, values in result.values.items():
        sys.stdout.write(f"{what}: {', '.join(f'{value:.4g}' for value in values)}\n")
    sys.stdout.write(f"results in {options.out / study.name}\n")
    return 0
