"""Factors on the gains of the prediction model with which it predicts the measurements of a run.

The model's responses to each input and to the load alone are simulated over the record. Measurements and responses are
compared by their changes over `WINDOW_S`, so that constants and slow drifts drop out, each output over its spread. The
factors on the responses are those of least squares over the first half of the record; the second half is held back.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from coldloop.errors import UsageError
from coldloop.process.lti_model import LtiModel, RealArray
from coldloop.process.updating_periods import LONGEST_TICKS
from coldloop_rig.results.run_folder import RunFolder
from coldloop_rig.text_tables import aligned

WINDOW_S: Final = 60.0
SETTLING_S: Final = 300.0
"""Left out at the beginning: the state is not known there, and is forgotten like the model's slowest mode, in 110 s."""
BLOCKS: Final = 8
"""Blocks of the fitted half: left out in turn, they give standard errors that allow for correlated residuals."""
LEAST_S: Final = 1800.0  # shortest record: blocks of 90 s, longer than the window
MOST_ERROR: Final = 0.05  # largest standard error of a factor that is taken
TAIL: Final = 0.025


class Record(NamedTuple):
    """Record of inputs and outputs at N consecutive ticks."""

    inputs: RealArray
    """Inputs and load that were applied from each tick on, shape (N, m + 1)."""
    y: RealArray
    """Outputs, shape (N, p)."""
    sensors: RealArray
    """Standard deviations of the outputs' sensors, as the estimator has them, shape (p,)."""


class Factor(NamedTuple):
    """Identified factor of an input or of the load, with its confidence interval."""

    name: str
    unit: str
    value: float
    """Factor on the columns of the model; 1 if it was not fitted."""
    low: float
    """Lower end of the 95 % interval, whose upper end is `high`; NaN if the factor was not fitted."""
    high: float
    moved: float
    """Range of the input or load in the record: largest minus least value."""
    reason: str
    """Reason why the factor was not fitted; empty if it was."""


class Identification(NamedTuple):
    """Factors of all inputs and of the load, and the prediction errors on the half of the record that was held out."""

    factors: tuple[Factor, ...]
    before: RealArray
    """RMS error of predicted changes over `WINDOW_S` with the model as it is, in the outputs' units, shape (p,)."""
    after: RealArray
    """RMS error with the factors, shape (p,)."""
    improved: bool
    """Whether the mean square of all errors, each output over its spread, is less than before."""

    @property
    def fitted(self) -> bool:
        """Whether there is a factor that was fitted."""
        return any(not factor.reason for factor in self.factors)


def read_record(run: RunFolder, model: LtiModel) -> Record:
    """Return what a run has measured of the signals of a model.

    Raises UsageError: there is no trace, it is too short or has gaps, or the model has other signals.
    """
    process = run.process
    if (model.input_names, model.output_names) != (process.input_names, process.output_names):
        raise UsageError(
            f"{run.path}: a model of {len(model.input_names)} inputs and {len(model.output_names)} outputs, whose names"
            " are not those of the trace; name another with --model"
        )
    moved = (*process.input_names, process.load.column)
    curves = run.series((*moved, *process.output_names), LONGEST_TICKS)
    recorded_s = len(curves["time_s"]) * process.tick_s
    if recorded_s < LEAST_S:
        raise UsageError(f"{run.path}: a record of {recorded_s:g} s is too short; name one of {LEAST_S:g} s or more")
    inputs = np.column_stack([curves[name] for name in moved])
    y = np.column_stack([curves[name] for name in process.output_names])
    gaps = int((~np.isfinite(np.hstack([inputs, y])).all(axis=1)).sum())
    if gaps:
        raise UsageError(f"{run.path}: {gaps} ticks of the trace are not known; name a run without them")
    key, configured = "optimizer_plc.program.estimator.{}_sensor", run.configuration
    sensors = [configured[key.format(one.quantity)] if one.quantity else one.noise for one in process.outputs]
    return Record(inputs, y, np.array(sensors))


def responses(model: LtiModel, inputs: RealArray) -> RealArray:
    """Return what each input and the load alone do to the p outputs, from rest, as means over samples of 5 s.

    `inputs` are the m inputs and the load applied from each of N ticks on, shape (N, m + 1). The result is in the
    outputs' units, shape (N ticks in samples, p, m + 1).
    """
    moves = inputs - np.append(model.u0, model.w0)
    gains, feedthrough = np.column_stack([model.B_tick, model.F_tick]), np.column_stack([model.D, model.G])
    ticks = model.declared.ticks_per_sample
    before = _samples(np.vstack([moves[:1], moves[:-1]]), ticks)  # outputs show the inputs that were held until then
    x, sums = np.zeros(gains.shape), np.zeros((len(before), *gains.shape))
    for tick, held in enumerate(moves[: len(before) * ticks]):
        sums[tick // ticks] += x
        x = model.A_tick @ x + gains * held
    return model.C @ (sums / ticks) + feedthrough * before[:, np.newaxis, :]


def identify(model: LtiModel, record: Record) -> Identification:
    """Fit the factors on the first half of a record of `LEAST_S` or more, and judge them on the second."""
    sampling_s, ticks = model.declared.sampling_period_s, model.declared.ticks_per_sample
    skipped, window = round(SETTLING_S / sampling_s), round(WINDOW_S / sampling_s)
    predicted, measured = responses(model, record.inputs), _samples(record.y, ticks)
    effects, changes = (each[skipped:] - each[skipped - window : -window] for each in (predicted, measured))
    half = len(changes) // 2
    fit, held = slice(half), slice(half + window, None)  # no sample is in the windows of both
    spread = np.maximum(changes[fit].std(axis=0), record.sensors)
    effects_fit = (effects[fit] - effects[fit].mean(axis=0)) / spread[:, np.newaxis]
    changes_fit = (changes[fit] - changes[fit].mean(axis=0)) / spread
    blocks = zip(np.array_split(effects_fit, BLOCKS), np.array_split(changes_fit, BLOCKS), strict=True)
    moments = [(np.einsum("kpi,kpj->ij", z, z), np.einsum("kpi,kp->i", z, y)) for z, y in blocks]
    reach = (np.abs(effects[fit]) / record.sensors[:, np.newaxis]).max(axis=(0, 1))
    begin, end = skipped * ticks, (skipped + half) * ticks
    moved = np.ptp(record.inputs[begin:end], axis=0)
    factors = _factors(model, moments, reach, moved)
    both = np.ones(len(factors)), np.array([factor.value for factor in factors])
    before, after = ((changes[held] - effects[held] @ values).std(axis=0) for values in both)
    improved = bool(((after / spread) ** 2).sum() < ((before / spread) ** 2).sum())
    return Identification(factors, before, after, improved)


def scaled(model: LtiModel, factors: tuple[Factor, ...], note: str) -> LtiModel:
    """Return a model whose gains from inputs and load are multiplied by factors; `note` says where it comes from."""
    *of_inputs, of_load = (factor.value for factor in factors)
    return replace(
        model, B=model.B * of_inputs, D=model.D * of_inputs, B_tick=model.B_tick * of_inputs,
        F=model.F * of_load, G=model.G * of_load, F_tick=model.F_tick * of_load, note=note,
    )  # fmt: skip


def _samples(rows: RealArray, ticks: int) -> RealArray:
    """Return the means over whole samples of so many ticks, shape (samples, columns)."""
    count = len(rows) // ticks
    return np.asarray(rows[: count * ticks].reshape(count, ticks, -1).mean(axis=1))


def _factors(
    model: LtiModel, moments: list[tuple[RealArray, RealArray]], reach: RealArray, moved: RealArray
) -> tuple[Factor, ...]:
    """Fit all identifiable factors; the least certain one is fixed at 1 first, which makes the others more certain.

    `moments` are matrix (q, q) and right side (q,) of the normal equations of each block; `reach` (q,) is the largest
    change by each input over the sensor's standard deviation, `moved` (q,) how far each moved.
    """
    names, units = (*model.input_names, model.load_name), (*model.input_units, model.load_unit)
    free = reach >= 1.0
    reasons = ["" if each else "too little to tell" for each in free]
    values, errors = _least_squares(moments, free)
    while free.any() and (worst := float(np.max(errors))) > MOST_ERROR:
        uncertain = int(np.argmax(errors))
        free[uncertain], reasons[uncertain] = False, f"standard error {worst:.2g}: too little to tell"
        values, errors = _least_squares(moments, free)
    reaches = np.where(free, stdtrit(BLOCKS - 1, 1.0 - TAIL) * errors, np.nan)
    columns = (names, units, values, values - reaches, values + reaches, moved, reasons)
    return tuple(Factor(*row) for row in zip(*columns, strict=True))


def _least_squares(moments: list[tuple[RealArray, RealArray]], free: NDArray[np.bool_]) -> tuple[RealArray, RealArray]:
    """Return the factors, those not free 1, and their standard errors by the jackknife over blocks, shape (q,) each."""
    matrices, right_sides = (np.array(each) for each in zip(*moments, strict=True))

    def solution(blocks: Sequence[int]) -> RealArray:
        N, right = matrices[blocks].sum(axis=0), right_sides[blocks].sum(axis=0)
        values = np.ones(len(free))
        values[free] = np.linalg.lstsq(N[np.ix_(free, free)], right[free] - N[np.ix_(free, ~free)].sum(axis=1))[0]
        return values

    every = range(BLOCKS)
    without = np.array([solution([block for block in every if block != left]) for left in every])
    return solution(every), np.sqrt((BLOCKS - 1) * without.var(axis=0))


def describe(model: LtiModel, found: Identification) -> str:
    """Return the factors and the prediction errors as tables."""
    columns = zip(model.output_names, model.output_units, found.before, found.after, strict=True)
    errors = [
        (name, unit, f"{before:.4f}", f"{after:.4f}")
        for name, unit, before, after in columns
        if max(before, after) >= 5e-5  # the others do not move
    ]
    rows = []
    for one in found.factors:
        value, within = ("1", "") if one.reason else (f"{one.value:.3f}", f"{one.low:.3f} to {one.high:.3f}")
        verdict = f"not fitted: {one.reason}" if one.reason else "fitted"
        rows.append((one.name, value, within, f"{one.moved:.3g} {one.unit}", verdict))
    verdict = "less than before" if found.improved else "not less than before"
    return "\n".join([
        aligned([("input", "factor", "95 % interval", "moved by", "verdict"), *rows]),
        f"error (RMS) of predicted changes over {WINDOW_S:g} s in the half held back",
        aligned([("output", "", "before", "after"), *errors], numbers=True),
        f"mean square of all, each over its spread: {verdict}\n",
    ])  # fmt: skip


def note_of(run: RunFolder, model: LtiModel, found: Identification) -> str:
    """Return what a model file says of its origin."""
    factors = ", ".join(f"{each.name} x {each.value:.4f}" for each in found.factors if not each.reason)
    trace = str(run.manifest["hashes"]["trace_sha256"])[:12]
    return f"gains of model {model.digest[:12]} scaled by coldloop identify from trace {trace}: {factors}"
