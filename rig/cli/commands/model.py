"""`coldloop model`: the cold box at its operating point, and its linear model as both PLCs run it."""

import argparse
import sys
from pathlib import Path

from coldloop.service.command_line import add_configuration_options
from rig.cli.commands.options import configuration


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the model file, for model.file")


def execute(options: argparse.Namespace) -> int:
    """Solve, linearise, print; write the model file when there is --out; reject an invalid configured model."""
    from coldloop.errors import UsageError
    from coldloop.process.lti_model import load
    from coldloop.whole_file import require_regular_file
    from rig.cli.model_listing import describe_model

    if options.out is not None:
        require_regular_file(options.out)
    in_use = configuration(options).settings.model.file
    model, text = describe_model(in_use)
    sys.stdout.write(text)
    if options.out is not None:
        try:
            model.save(options.out)
        except OSError as error:
            raise UsageError(f"{options.out}: {error.strerror}; name a file that can be written with --out") from None
        sys.stdout.write(f"written to {options.out}\n")
    load(in_use)
    return 0
