"""`coldloop identify`: the factors on the prediction model's gains with which it predicts what a run has measured.

They are fitted on the first half of the record and judged on the second. The model of a run is never changed.
"""

import argparse
import sys
from pathlib import Path


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("run", type="folder", metavar="RUN", help="folder of a run, of half an hour or more")
    parser.add_argument("--model", type="read", metavar="FILE", help="model file (default: that of the run)")
    parser.add_argument("--out", type="write", metavar="FILE",
                        help="write the model with these factors, to be looked at, if it predicts better")  # fmt: skip


def execute(options: argparse.Namespace) -> int:
    """Print factors and errors; write the model when there is --out and it is better."""
    from coldloop.errors import UsageError
    from coldloop.process.lti_model import load
    from coldloop.whole_file import require_regular_file
    from coldloop_rig.cli.identification_listing import describe, note_of
    from coldloop_rig.results.folders import writing
    from coldloop_rig.results.run_folder import RunFolder
    from coldloop_rig.runs.identification import identify, read_record, scaled
    from coldloop_rig.runs.inputs import MODEL_COPY

    out: Path | None = options.out
    if out is not None:
        require_regular_file(out)
        if out.exists():
            raise UsageError(f"{out}: exists; name another file with --out")
    run = RunFolder(options.run)
    model = load(options.model or run.held(MODEL_COPY))
    found = identify(model, read_record(run, model))
    sys.stdout.write(describe(model, found))
    if out is None:
        return 0
    if not found.fitted:
        raise UsageError(f"{out}: not written: no factor can be told from this record; name a run that moves more")
    if not found.improved:
        raise UsageError(f"{out}: not written: with these factors the half held back is predicted no better")
    with writing(out):
        scaled(model, found.factors, note_of(run, model, found)).save(out)
    sys.stdout.write(
        f"written to {out}, to be looked at: nothing uses it before a configuration names it, for all three services:\n"
        f"    coldloop run --set model.file={out}\n"
    )
    return 0
