"""Description of a process before it is controlled, as text: steady state, modes, gains, and errors found."""

from collections.abc import Sequence
from math import log
from typing import Final

import numpy as np

from coldloop.process import declaration, lti_model, sections
from coldloop.text import ends_text, number_text
from coldloop_rig.plc_sizing.holding import NOTHING, digits_last_s, leaves_its_band, shortest_period_s, waiting
from coldloop_rig.process_file import linear_model, making, step_test

ROUGH: Final = 1e-4  # error of the derivatives from which on the plant has a kink, or noise, at its operating point
SMALL: Final = 1e-6  # singular value, over the largest, below which a direction counts as none
SHARE: Final = 0.01
"""Largest step of a signal in single precision, over its rate or its band, with which it can be controlled."""
INVERSE: Final = 0.1  # inverse response, over the final change, from which on it is reported


def described(made: making.Made) -> str:
    """Return the description of a process and its model; first come how late an update may be and a warning."""
    warnings, late = _warnings(made), []
    values = sorted(np.linalg.eigvals(made.own_A), key=lambda value: -value.real)
    values = [complex(v.real if abs(v.real) > NOTHING else 0.0, v.imag) for v in values]
    if values[0].real <= NOTHING:  # of another plant the first warning says it
        late = [f"late       no mode grows: no period loses the plant{leaves_its_band(made.model, made.process)}"]
    texts = [f"{v.real:.3g}" if abs(v.imag) < 1e-12 else f"{v.real:.3g}{v.imag:+.3g}i" for v in values]
    modes = [f"modes      {'  '.join(texts[i : i + 8])} /s" for i in range(0, len(texts), 8)]
    if made.linear.error:
        modes.append(f"derivatives within {made.linear.error:.1e} of those with steps twice as wide")
    digest = f"model      sha256 {made.model.digest}\n"
    return "\n".join([
        *late, *warnings[:1], *_rest(made), *made.linear.notes, *modes, *_gains(made), *warnings[1:], digest
    ])  # fmt: skip


def _values(
    names: tuple[str, ...], values: linear_model.Array, units: tuple[str, ...], reach: linear_model.Array | None = None
) -> str:
    """Return values with their units, and half their intervals where these are known."""
    found = []
    for k, (name, value, unit) in enumerate(zip(names, values, units, strict=True)):
        within = f" +- {number_text(reach[k], 2)}" if reach is not None and k < len(reach) else ""
        found.append(f"{name} {number_text(value if abs(value) > NOTHING else 0.0, 5)}{within} {unit}".rstrip())
    return "  ".join(found)


def _rest(made: making.Made) -> list[str]:
    m, process = made.model, made.process
    load = f"; load {m.load_name} {number_text(m.w0, 5)} {m.load_unit}".rstrip() if m.F.any() or m.G.any() else ""
    problem = len(process.decision_instants) * (len(process.inputs) + 2 * len(process.bands))
    named = ((m.input_names, "input"), (m.output_names, "output"), (m.state_names, "state"))
    counted = ", ".join(f"{len(names)} {noun}{'s' * (len(names) != 1)}" for names, noun in named)
    times = f"tick {process.tick_s:g} s, sampling period {process.sampling_period_s:g} s"
    return [
        f"{process.name}: {counted}; {times}, horizon {process.horizon_s:g} s, {problem} variables",
        f"inputs     {_values(m.input_names, m.u0, m.input_units)}{load}",
        f"outputs    {_values(m.output_names, m.y0, m.output_units)}",
        f"states     {_values(m.state_names, m.x0, m.state_units)}",
    ]


def _gains(made: making.Made) -> list[str]:
    m = made.model
    horizon_s = made.process.horizon_s
    held = m.discretised(horizon_s)
    n = len(made.own_A)
    effects = np.column_stack([m.C @ held.B + m.D, m.C @ held.F + m.G, (m.C @ held.A)[:, n:]])
    names = (*m.input_names, m.load_name, *m.state_names[n:])
    units = (*m.input_units, m.load_unit, *m.state_units[n:])
    reach: dict[str, linear_model.Array] = {}  # half the intervals of what each input of a record does to the outputs
    lines = []
    if made.linear.record is not None:
        record, found = made.linear.record
        reach = dict(zip(record.input_names, step_test.half_widths(record, found, horizon_s).T, strict=True))
        lines = [
            f"gains      all within +- with a probability of {100 * step_test.LEVEL:g} %, by the noise of the record"
        ]
    return lines + [
        f"after {horizon_s:g} s of +1 {unit} {name}: ".replace("  ", " ")
        + _values(m.output_names, column, m.output_units, reach.get(name))
        for name, unit, column in zip(names, units, effects.T, strict=True)
        if column.any()
    ]


def _rank_deficit(matrix: linear_model.Array) -> int:
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return int((sizes < SMALL * max(sizes.max(), 1e-300)).sum()) if sizes.size else 0


def _coarse(process: declaration.Process) -> list[str]:
    """Return what registers and on-line arithmetic, which have single precision, do not resolve."""
    bands = zip(process.banded, process.bands, strict=True)
    resolved: list[tuple[sections.Input | sections.Output, tuple[float, float], float, str]] = [
        *((one, (one.low, one.high), SHARE * one.rate, "its rate") for one in process.inputs),
        *((one, one.range, one.noise, "the noise of its sensor") for one in process.outputs),
        *((one, one.range, SHARE * (band.high - band.low), "its band") for one, band in bands),
    ]
    return [
        f"{one.name} has steps of {step:.2g} {one.unit}, too coarse for {what}; count it from another zero"
        for one, ends, least, what in resolved
        if (step := float(np.spacing(np.float32(max(map(abs, ends)))))) > least
    ]


def unheld(banded: Sequence[sections.Output], A: linear_model.Array) -> str:
    """Return that only MPC holds a plant (n, n) with an unstable mode and no loop on any output; else nothing."""
    if any(one.loop for one in banded) or np.linalg.eigvals(A).real.max() <= NOTHING:
        return ""
    return "nothing holds this plant when MPC has no answer: a mode grows, and no output has a loop"


def _inverse_responses(made: making.Made) -> list[str]:
    """Return which outputs with a band first move to the other side after a step of an input than where they end."""
    m, process, n, quarters = made.model, made.process, len(made.own_A), 4
    poles = np.linalg.eigvals(made.own_A)
    delays = [lag["delay_s"] for lag in made.linear.parameters.get("lags", ())]  # approximated by what moves so
    if any(delays) or poles.real.max() > NOTHING or (abs(poles.imag[poles.real > -NOTHING]) > NOTHING).any():
        return []
    part_s = process.sampling_period_s / quarters
    times = part_s * np.arange(1, quarters * process.decision_instants[-1] + 1)
    part, x = m.discretised(part_s), np.zeros_like(m.B)
    moves = np.array([m.C @ (x := part.A @ x + part.B) + m.D for _ in times])
    ends = moves[-1]
    if (poles.real < -NOTHING).all():
        ends = m.D - m.C[:, :n] @ np.linalg.solve(made.own_A, m.B[:n])
    found = []
    seen = np.abs(moves).max(axis=0) * [one.high - one.low for one in process.inputs]
    for one, j in ((one, j) for one in process.banded for j in range(len(m.input_names))):
        i = m.output_names.index(one.name)
        if seen[i, j] < one.noise:
            continue
        share = moves[:, i, j] / (ends[i, j] or np.inf)
        far = np.flatnonzero(np.abs(share) > INVERSE)
        if far.size and share[far[0]] < 0.0:
            back = np.flatnonzero(share[far[0] :] > 0.0)
            until = f"until {times[far[0] + back[0]]:.3g} s" if back.size else "longer than the horizon"
            step = f"after a step of {m.input_names[j]} {m.output_names[i]} first moves the other way"
            found.append(f"inverse response: {step}, by {-share.min():.2g} of its change in the end, {until}")
    return found


def _unstable(made: making.Made, growth: float) -> list[str]:
    """Return how long a plant with a mode that grows can wait for an update, and what its horizon may be."""
    process, limits = made.process, np.array([[one.low, one.high, one.rate] for one in made.process.inputs]).T
    single, double = (digits_last_s(growth, real) for real in (np.float32, np.float64))
    period_s = shortest_period_s(0.25 * (process.share("preparation") + process.share("ode")), process.tick_s)
    needs = waiting(made.model, process, limits)
    held = needs and needs.text(period_s, "the shortest one of the reference PLC")
    found = [f"unstable: a mode grows with {growth:.3g} /s and doubles in {log(2.0) / growth:.3g} s; {held}"]
    found += [f"fail-safe: {text}" for text in (unheld(process.banded, made.own_A),) if text]
    if process.horizon_s > single:
        found.append(
            f"horizon: beyond {single:.3g} s the mode leaves the problem no digits in single precision, beyond "
            f"{double:.3g} s none in double; it is {process.horizon_s:g} s: shorten prediction.decision_instants"
        )
    return found


def _exchanged(model: lti_model.LtiModel, bath: sections.Bath, horizon_s: float) -> list[str]:
    """Return which outputs of a bath seem exchanged, in words."""
    values, modes = np.linalg.eig(model.A[np.ix_(model.moved, model.moved)])
    slowest = int(np.argmin(np.abs(values)))
    shown = np.abs(model.C[:, model.moved] @ modes[:, slowest])
    level, outlet = (shown[model.output_names.index(name)] for name in (bath.level, bath.turbine_outlet))
    if abs(values[slowest]) * horizon_s > 0.1:  # part of itself that a mode may move by and still integrate
        return [f"bath: no mode integrates as a level does, so {bath.level} is none"]
    if level <= outlet:
        return [f"bath: {bath.turbine_outlet} integrates as a level does, {bath.level} less; are they exchanged?"]
    return []


def _warnings(made: making.Made) -> list[str]:
    m, process, found = made.model, made.process, list[str]()
    sample_s, tick_s, lags = process.sampling_period_s, process.tick_s, made.linear.parameters.get("lags", ())
    poles = np.linalg.eigvals(made.own_A)
    fastest, slowest = -poles.real.min(), -poles.real.max()
    if poles.real.max() > NOTHING:
        found += _unstable(made, float(poles.real.max()))
    elif slowest > NOTHING and process.horizon_s * slowest < 1.0:
        found.append(f"horizon: it ends before the slowest mode, {1 / slowest:.3g} s, has moved much")
    fast = poles[(poles.imag * sample_s > np.pi) & (-poles.real * sample_s < 3.0)].imag  # 5 % of them are left
    found += [f"sampling: the oscillation of {2 * np.pi / w:.3g} s is faster than two sampling periods" for w in fast]
    if fastest * sample_s > 20.0:
        found.append(f"sampling: the fastest mode, {1 / fastest:.2g} s, is over within a sampling period")
    for band, output in zip(process.bands, process.banded, strict=True):
        value = float(m.y0[m.output_names.index(output.name)])
        if not band.margin and not band.low <= value <= band.high:
            ends = ends_text(band.low, band.high)
            found.append(f"band: {output.name} rests at {number_text(value, 5)}, its band is {ends}")
    rows = [m.output_names.index(output.name) for output in process.banded]
    reach = m.discretised(process.horizon_s).B * [one.scale for one in process.inputs]
    effect = (m.C[rows] @ reach) / [[band.high - band.low] for band in process.bands]
    if _rank_deficit(effect):
        found.append("controllability: the inputs do not move the outputs with a band independently within the horizon")
    if made.linear.error > ROUGH:
        found.append(f"kink: derivatives differ by {made.linear.error:.1e} with the step; the model holds for one side")
    if process.bath is not None:
        found += _exchanged(m, process.bath, process.horizon_s)
    found += [
        f"loop: the gain of {one.name} by {one.loop.input} has the wrong sign: it would drive it away"
        for row, one in zip(effect, process.banded, strict=True)
        if one.loop is not None and one.loop.gain * row[process.input_names.index(one.loop.input)] < 0
    ]
    found += _inverse_responses(made)
    found += [  # the simulated plant has the nearest dead time in whole ticks
        f"dead time: {lag['output']} after {lag['source']}, {lag['delay_s']:g} s, is simulated as {near:g} s"
        for lag in lags
        if abs((near := round(lag["delay_s"] / tick_s) * tick_s) - lag["delay_s"]) > SMALL * tick_s
    ]
    found += [f"single precision: {text}" for text in _coarse(process)]
    steady = m.A_tick - np.eye(len(m.A))
    if _rank_deficit(np.vstack([steady, m.C])):
        found.append("observability: the outputs do not show where some state rests")
    return [f"warning    {text}" for text in found]
