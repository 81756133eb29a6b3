"""The cold box at rest and its linear model, off line: operating points, what is in their way, loads that are held.

`python -m coldloop_plant.cold_box.model FILE` writes the model file of the reference cold box; `coldloop model --plant`
makes that of another one.
"""

import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from math import isfinite, nan
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from coldloop.process import cold_box, model_range
from coldloop.process.lti_model import LtiModel
from coldloop_plant import equilibrium
from coldloop_plant.cold_box import ColdBox, advance, evaluated, streams
from coldloop_plant.cold_box.plant_file import OPERATING_INPUTS, OPERATING_LEVEL, REFERENCE, PlantFile
from coldloop_plant.components.expansion import CRITICAL_RATIO
from coldloop_plant.equilibrium import Linear, Modes, NoEquilibriumError
from coldloop_plant.helium import ISOBAR_PRESSURE, Helium, load_helium, saturation
from coldloop_plant.numeric import PA_PER_BAR, Array, RealArray

SIZES: Final = {
    "Pa": 2e3, "K": 1.0, "kg": 0.01, "1": 0.01, "%": 1.0, "kg/s": 0.01, "bar": 0.1, "bar s": 1.0,
}  # fmt: skip
"""An ordinary deviation of a state, by its unit; of the liquid volume 1 % of level."""
FURTHER_SIZES: Final = (10.0, 50.0, 10.0, 50.0)
"""Ordinary deviations of CV155 (%), NCR22_A (W), CV156 (%) and the load (W)."""
RELAXATION_S, RELAXATION_STEP_S = 3000.0, 0.5
LEVEL_GAIN: Final = 100.0  # W of load per % of level, while relaxing, for the CV155 of the reference plant


def state_scales(box: ColdBox, units: Iterable[str] = cold_box.STATE_UNITS) -> RealArray:
    """Return the size of an ordinary deviation of each state, by default of the cold box: 2 kPa, 1 % of level, 1 K."""
    return np.array([box.separator.volume / 100.0 if unit == "m3" else SIZES[unit] for unit in units])


def _equations(states: int, box: ColdBox, helium: Helium) -> Callable[[Array], Array]:
    """Return the function z = (x, u, w) -> (dx/dt, y)."""

    def evaluate(z: Array) -> Array:
        x, u, w = z[:states], z[states:-1], z[-1]
        return np.concatenate(evaluated(x, u, w, box, helium))

    return evaluate


def linearise(x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium) -> Linear:
    """Return the linear model of the cold box at (x, u, w)."""
    sizes = np.array([*state_scales(box), *FURTHER_SIZES])
    jacobian = equilibrium.complex_step(_equations(x.size, box, helium), np.array([*x, *u, w]), sizes)
    linear = Linear.of(jacobian, x.size, u.size)
    return linear._replace(F=linear.F[:, 0], G=linear.G[:, 0])


def linearisation_error(x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium) -> float:
    """Return the largest difference between the complex step and central differences.

    The differences are extrapolated once after Richardson. Both Jacobians are scaled: states by `state_scales`, inputs
    and load by `FURTHER_SIZES`, outputs by 1 (%, Hz, K, bar), rates per second.
    """
    evaluate, at, rates = _equations(x.size, box, helium), np.array([*x, *u, w]), state_scales(box)
    sizes, rows = np.array([*rates, *FURTHER_SIZES]), np.array([*rates, *np.ones(len(cold_box.OUTPUT_NAMES))])
    fine, coarse = equilibrium.central_differences(evaluate, at, 1e-3 * sizes)
    difference = equilibrium.complex_step(evaluate, at, sizes) - (4.0 * fine - coarse) / 3.0
    return float(np.max(np.abs(difference * sizes / rows[:, np.newaxis])))


class Equilibrium(NamedTuple):
    """A state at rest x (28,), with the inputs u (3,), the load w (W) and the outputs y (22,)."""

    x: RealArray
    u: RealArray
    w: float
    y: RealArray
    residual: float  # Largest |dx/dt|, in units of 2 kPa, 1 % of level and 1 K, per second


class AtRest(NamedTuple):
    """A plant around a cold box at rest, as `coldloop model` describes it."""

    rest: Equilibrium  # Rest of its cold box
    box: ColdBox  # Its cold box with the temperature of the supplied gas that it has at rest
    model: LtiModel
    lines: Sequence[str] = ()  # Further lines of its kind


def find_equilibrium(u: RealArray, level: float, box: ColdBox, helium: Helium) -> Equilibrium:
    """Return the state at which the cold box rests under `u` with the bath at `level` (%).

    The load is the unknown that replaces the liquid volume. The plant first relaxes in simulated time, with the load
    holding the level; Newton's method does the rest.

    Raises:
        NoEquilibriumError: Newton's method does not converge, for instance beyond the capacity maximum.
    """
    x, w = relaxed(u, level, box, helium)
    return rest_near(x, w, u, box, helium)


def rest_near(x: RealArray, w: float, u: RealArray, box: ColdBox, helium: Helium) -> Equilibrium:
    """Return the state of rest under `u` that Newton's method finds from (x, w), with the level of x.

    Raises:
        NoEquilibriumError: It does not converge.
    """
    scales = state_scales(box)

    def step(z: RealArray, _: RealArray) -> RealArray:
        linear = linearise(z[:-1], u, z[-1], box, helium)
        linear.A[:, 1] = linear.F  # the level is given, the load is not
        moved = np.linalg.solve(linear.A, -evaluated(z[:-1], u, z[-1], box, helium)[0])
        load, moved[1] = moved[1], 0.0
        further: RealArray = z + np.append(moved, load)
        return further

    z, residual = equilibrium.newton(
        np.append(x, w), lambda z: evaluated(z[:-1], u, z[-1], box, helium)[0] / scales, step, 30,
        f"no equilibrium at u = {u.tolist()}",
    )  # fmt: skip
    return Equilibrium(z[:-1], u, float(z[-1]), evaluated(z[:-1], u, z[-1], box, helium)[1], residual)


def relaxed(
    u: RealArray, level: float, box: ColdBox, helium: Helium, start: RealArray | None = None
) -> tuple[RealArray, float]:
    """Return a state near the equilibrium under `u` with the bath at `level` (%), and its load (W)."""
    x = first_guess(level, box) if start is None else start
    volume = level / 100.0 * box.separator.volume
    size = box.jt_valve.flow_area / REFERENCE.jt_valve.flow_area
    w = 0.0
    for _ in range(round(RELAXATION_S / RELAXATION_STEP_S)):
        w = size * (LEVEL_GAIN * 100.0 * (x[1] - volume) / box.separator.volume + 400.0)
        x = advance(x, u, w, RELAXATION_STEP_S, box, helium)
    x[1] = volume
    return x, float(w)


def first_guess(level: float, box: ColdBox) -> RealArray:
    """Return the state from which the search sets out, with the bath at `level` (%)."""
    nef1 = np.linspace(9.5, 4.5, box.nef1.cells)
    nef2 = np.linspace(18.0, 10.0, box.nef2.cells)
    nef34 = np.linspace(box.T_in - 5.0, 19.0, box.nef34.cells)
    return np.concatenate([[box.P_LP + 0.18e5, level / 100.0 * box.separator.volume], nef1, nef2, nef34])


LEVERS: Final = (
    "cv155.area_mm2", "turbine.cv156_area_mm2", "turbine.nozzle_g_sqrt_k_per_s_bar", "turbine.efficiency",
    "nef1.ua_w_per_k", "nef2.ua_w_per_k", "nef34.ua_w_per_k", "boundaries.p_hp_bar", "boundaries.t_in_k",
)  # fmt: skip
"""Parameters that decide how much the box cools."""


def operating_point(file: PlantFile, helium: Helium) -> Equilibrium:
    """Return the state at which the cold box of a plant file rests, with inputs and level as there.

    Parameters may be in range one by one and not work together. The search for an equilibrium then ends nowhere, or in
    a state that no plant has. Where it ended, the first cause that applies is named.

    Raises:
        NoEquilibriumError: There is none that the model holds for; one line that names the part, and what would help.
    """
    u, level = np.array(file.operating_point.inputs), file.operating_point.level_pct
    with np.errstate(all="ignore"):  # far from any plant numbers overflow, which is then said
        found = _settled(*relaxed(u, level, file.box, helium), u, file.box, helium)
        for _ in range(5):
            if not isfinite(found.residual):  # with ten times the metal for its flows it takes ten times as long
                found = _settled(*relaxed(u, level, file.box, helium, found.x), u, file.box, helium)
        for obstacle in obstacles(found, file, helium):
            raise NoEquilibriumError(obstacle)
    return found


def _settled(x: RealArray, w: float, u: RealArray, box: ColdBox, helium: Helium) -> Equilibrium:
    """Return the rest near a state; where there is none, that state, with a residual that is not a number."""
    try:
        return rest_near(x, w, u, box, helium)
    except NoEquilibriumError:
        return Equilibrium(x, u, w, evaluated(x, u, w, box, helium)[1], nan)


def obstacles(found: Equilibrium, file: PlantFile, helium: Helium) -> Iterator[str]:
    """Yield what is in the way of a plant at the state that was found; its residual is not a number if it moves."""
    x, u, w, y, residual = found
    box = file.box
    if not (isfinite(w) and np.isfinite(x).all() and np.isfinite(y).all()):
        part = _modes(first_guess(file.operating_point.level_pct, box), u, 0.0, box, helium).fastest
        yield f"{part}: does not stay finite in steps of a tick; {slower(part)}"
        return
    s = streams(x, u, box, helium)
    P_mix, P_nozzle, relief = s.P_mix / PA_PER_BAR, s.P_turbine / PA_PER_BAR, box.separator.relief_pressure
    outside = model_range.model_range(x, box.P_HP / PA_PER_BAR, box.P_LP / PA_PER_BAR)
    if outside & cold_box.ModelRange.BATH_PRESSURE or x[0] > relief:
        half = "warm" if s.P_mix - box.P_LP > x[0] - s.P_mix else "cold"
        yield (
            f"bath: its pressure would be {x[0] / PA_PER_BAR:.2f} bar, not between {model_range.SATURATION_BAR[0]:g}"
            f" bar and bath.relief_pressure_bar, {relief / PA_PER_BAR:g} bar; less return_line.{half}_drop_bar or"
            " boundaries.p_lp_bar would help, or less flow (cv155.area_mm2, turbine.nozzle_g_sqrt_k_per_s_bar)"
        )
    if outside & (cold_box.ModelRange.COLD_CELL | cold_box.ModelRange.WARM_CELL):
        colder = x[2:] - model_range.COLDEST_CELLS_K
        cell = int(np.argmin(colder) if outside & cold_box.ModelRange.COLD_CELL else np.argmax(x[2:]))
        name, coldest = cold_box.STATE_NAMES[2 + cell], model_range.COLDEST_CELLS_K[cell]
        yield (
            f"{part_of(name)}: {name} would be {x[2 + cell]:.1f} K, and is to be within {coldest:g} to"
            f" {model_range.WARMEST_CELL_K:g} K; change {part_of(name)}.ua_w_per_k or the flows through it"
        )
    if s.P_mix > CRITICAL_RATIO * s.P_turbine:
        yield (
            f"turbine: its nozzle is not choked with {P_nozzle:.2f} bar before and {P_mix:.2f} bar behind it; less"
            " turbine.nozzle_g_sqrt_k_per_s_bar or a wider CV156 would help, or less return_line.warm_drop_bar"
        )
    if y[cold_box.T5] <= saturation(s.P_mix, helium).T + 1e-6:
        yield (
            f"turbine: its exhaust would be wet, T5 at the boiling point of {y[cold_box.T5]:.2f} K; less"
            " turbine.efficiency or less nef34.ua_w_per_k would help, or more load (a smaller"
            " turbine.nozzle_g_sqrt_k_per_s_bar)"
        )
    if w <= 0.0:
        levers = (
            _levers(found, file, helium) if isfinite(residual) else "more turbine.efficiency or boundaries.p_hp_bar"
        )
        yield (
            f"operating_point.ncr22_a_w: the box cools {w + u[1]:.0f} W and its heater takes {u[1]:g} W, which leaves"
            f" {w:.0f} W for the load; most would help {levers}"
        )
    if not isfinite(residual):
        k = int(np.argmax(np.abs(evaluated(x, u, w, box, helium)[0] / state_scales(box))))
        name, unit = cold_box.STATE_NAMES[k], cold_box.STATE_UNITS[k]
        yield (
            f"{part_of(name)}: finds no rest, {name} ({unit}) moves most; another"
            " operating_point.cv155_pct would help, or less nef1.ua_w_per_k and nef2.ua_w_per_k for their flows"
        )
        return
    modes = _modes(x, u, w, box, helium)
    yield from modes.growing()
    yield from modes.too_fast(slower)


def _modes(x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium) -> Modes:
    return Modes.of(linearise(x, u, w, box, helium).A, state_scales(box), list(map(part_of, cold_box.STATE_NAMES)))


def part_of(state: str) -> str:
    """Return the section of a plant file that a state belongs to."""
    if state.startswith("T_"):
        return state.split("_")[1]
    return "bath" if state in cold_box.STATE_NAMES else "station"


def slower(part: str) -> str:
    """Return what makes a part slower."""
    return "more bath.volume_m3 would help" if part == "bath" else f"more {part}.aluminium_kg or less flow would help"


def _levers(found: Equilibrium, file: PlantFile, helium: Helium) -> str:
    """Return which parameters raise the load most, by how much for 10 %, to first order at the state that was found."""
    x, u, w = found.x, found.u, found.w
    linear, share = linearise(x, u, w, file.box, helium), 0.01  # by which a parameter is moved to see what it does
    linear.A[:, 1] = linear.F
    here = evaluated(x, u, w, file.box, helium)[0]
    moved = np.stack([evaluated(x, u, w, file.scaled(key, 1.0 + share), helium)[0] - here for key in LEVERS], axis=1)
    gains: RealArray = 0.1 / share * np.linalg.lstsq(linear.A, -moved, rcond=None)[0][1]
    best = np.argsort(-np.abs(gains))[:3]
    return ", ".join(f"10 % {'more' if gains[k] > 0 else 'less'} {LEVERS[k]} (+{abs(gains[k]):.0f} W)" for k in best)


Range = tuple[float, float]

LOOP_MARGIN: Final = 39.0
"""Margin of the optimiser below the largest load, W: its rows are soft, and let L1 rest beyond its band before CV156 is
open. The reference plant rests at 554 W; it stays in its bands, with their dead bands, up to 515 W."""


def held_loads(
    box: ColdBox, helium: Helium, level: float, cv155: Iterable[float], heater: Range, cv156: Iterable[float],
    warmth: Range,
) -> tuple[Equilibrium, Equilibrium]:  # fmt: skip
    """Return the steady states of the least and the largest load that some inputs hold, with the bath at `level` (%).

    T5 is within `warmth` (K). Heater and load heat the same bath, so that each steady state is sought once, from its
    neighbour's, and the heater's ends say which loads go with it. The grid is of openings in %, rising; between its
    points loads may be some watts more.

    Raises:
        ValueError: There is no such state.
    """
    rests, openings = [], list(cv155)
    for turbine in cv156:
        rest: Equilibrium | None = None
        for opening in openings:
            u = np.array([opening, heater[0], turbine])
            try:
                rest = rest_near(rest.x, rest.w, u, box, helium) if rest else find_equilibrium(u, level, box, helium)
            except NoEquilibriumError:
                rest = None
                continue
            if warmth[0] <= rest.y[cold_box.T5] <= warmth[1]:
                rests.append(rest)
    least, largest = min(rests, key=lambda rest: rest.w), max(rests, key=lambda rest: rest.w)
    by = heater[1] - heater[0]
    return least._replace(u=least.u + np.array([0.0, by, 0.0]), w=least.w - by), largest


def build_model(box: ColdBox = REFERENCE) -> LtiModel:
    """Return the linear model of `box` at the operating point of the reference plant.

    Raises:
        NoEquilibriumError: The box does not come to rest at the operating inputs.
    """
    helium = load_helium()
    return model_at(find_equilibrium(np.array(OPERATING_INPUTS), OPERATING_LEVEL, box, helium), box, helium)


def model_at(rest: Equilibrium, box: ColdBox, helium: Helium, parameters: Mapping[str, Any] | None = None) -> LtiModel:
    """Return the linear model of `box` at a state of rest; `parameters` are what its file says of the plant."""
    return equilibrium.model_of(
        linearise(rest.x, rest.u, rest.w, box, helium), rest.x, rest.u, rest.w, rest.y, cold_box.COLD_BOX,
        dict(zip(cold_box.STATE_NAMES, cold_box.STATE_UNITS, strict=True)), parameters_digest(box, helium),
        plant_parameters=dict(parameters or {}),
    )  # fmt: skip


def parameters_digest(box: ColdBox, helium: Helium) -> str:
    """Return the SHA-256 over every parameter and every table entry that the cold box reads, in hexadecimal."""
    digest = hashlib.sha256()
    _add(digest, (box, helium))
    if box.P_HP != ISOBAR_PRESSURE:
        _add(digest, helium.departure.nodes)
    return digest.hexdigest()


def _add(digest: Any, part: Any) -> None:  # noqa: ANN401 - hashlib's object and a nested tuple have no public type
    if isinstance(part, tuple):
        for name, value in zip(getattr(part, "_fields", ("",) * len(part)), part, strict=True):
            if name == "departure":
                continue  # from 16 bar, where the reference plant is
            digest.update(f"{name}:".encode())
            _add(digest, value)
    elif isinstance(part, np.ndarray):
        digest.update(part.astype("<f8").tobytes())
    else:
        digest.update(f"{part!r};".encode())


if __name__ == "__main__":
    build_model().save(Path(sys.argv[1]))
