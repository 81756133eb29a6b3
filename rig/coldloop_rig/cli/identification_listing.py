"""What was identified from a run, as text."""

from typing import Final

from coldloop.process.lti_model import LtiModel
from coldloop_rig.results.run_folder import RunFolder
from coldloop_rig.runs.identification import WINDOW_S, Factor, Identification
from coldloop_rig.text_tables import aligned

HEADER: Final = ("input", "factor", "95 % interval", "moved by", "verdict")


def describe(model: LtiModel, found: Identification) -> str:
    """Return the factors and the prediction errors as tables."""
    names, units = model.output_names, model.output_units
    errors = [
        (name, unit, f"{before:.4f}", f"{after:.4f}")
        for name, unit, before, after in zip(names, units, found.before, found.after, strict=True)
        if max(before, after) >= 5e-5  # the others do not move
    ]
    verdict = "less than before" if found.improved else "not less than before"
    return "\n".join([
        aligned([HEADER, *map(_row, found.factors)]),
        f"error (RMS) of predicted changes over {WINDOW_S:g} s in the half held back",
        aligned([("output", "", "before", "after"), *errors], numbers=True),
        f"mean square of all, each over its spread: {verdict}\n",
    ])  # fmt: skip


def note_of(run: RunFolder, model: LtiModel, found: Identification) -> str:
    """Return what a model file says of its origin."""
    factors = ", ".join(f"{each.name} x {each.value:.4f}" for each in found.factors if not each.reason)
    trace = str(run.manifest["hashes"]["trace_sha256"])[:12]
    return f"gains of model {model.digest[:12]} scaled by coldloop identify from trace {trace}: {factors}"


def _row(factor: Factor) -> tuple[str, ...]:
    moved = f"{factor.moved:.3g} {factor.unit}"
    if factor.reason:
        return factor.name, "1", "", moved, f"not fitted: {factor.reason}"
    return factor.name, f"{factor.value:.3f}", f"{factor.low:.3f} to {factor.high:.3f}", moved, "fitted"
