"""`coldloop reproduce`: every study of the paper, one report, and a scorecard."""

import argparse
import sys

from coldloop_rig.cli.commands.study import add_scale_options, ending, study_options, workers


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_scale_options(parser)


def execute(options: argparse.Namespace) -> int:
    """Do all studies and write the report."""
    from coldloop_rig.report.reproduction import reproduce

    text, failed_runs = reproduce(study_options(options), workers(options), options.out)
    sys.stdout.write(text)
    return ending(failed_runs)
