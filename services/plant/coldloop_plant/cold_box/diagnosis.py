"""The operating point of a plant file, or which part of the plant is in its way and what would help.

Parameters may be in range one by one and not work together. The search for an equilibrium then ends nowhere, or in a
state that no plant has. Where it ended, the first cause that applies is named.
"""

from collections.abc import Iterator
from math import isfinite, nan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.process.cold_box import STATE_NAMES, STATE_UNITS, T5
from coldloop.process.model_range import COLDEST_CELLS_K, SATURATION_BAR, WARMEST_CELL_K, model_range
from coldloop.process.range_bits import ModelRange
from coldloop_plant.cold_box.equilibrium import Equilibrium, NoEquilibriumError, first_guess, relaxed, rest_near
from coldloop_plant.cold_box.linearisation import state_and_load_jacobian, state_scales
from coldloop_plant.cold_box.physics import ColdBox, derivative, outputs, streams
from coldloop_plant.cold_box.plant_file import PlantFile
from coldloop_plant.components.gas_valve import CRITICAL_RATIO
from coldloop_plant.helium.properties import Helium, saturation
from coldloop_plant.numeric import PA_PER_BAR, RealArray

FASTEST: Final = 4.0
"""Largest rate at rest, 1/s. A tick of 0.25 s follows 11 /s, and away from rest rates are up to three times as large;
the reference plant has 1.6 /s."""
GROWTH: Final = 1e-4
"""Rate from which on a deviation is said to grow, 1/s; that of the level is 0 but for rounding."""
LEVERS: Final = (
    "cv155.area_mm2", "turbine.cv156_area_mm2", "turbine.nozzle_g_sqrt_k_per_s_bar", "turbine.efficiency",
    "nef1.ua_w_per_k", "nef2.ua_w_per_k", "nef34.ua_w_per_k", "boundaries.p_hp_bar", "boundaries.t_in_k",
)  # fmt: skip
"""Parameters that decide how much the box cools."""
STEP: Final = 0.01
"""Share by which a parameter is moved to see what it does."""
NAMED_LEVERS: Final = 3
FURTHER_RELAXATIONS: Final = 5
"""Of 3000 s each: a plant with ten times the metal for its flows takes ten times as long."""


def operating_point(file: PlantFile, helium: Helium) -> Equilibrium:
    """Return the state at which the cold box of a plant file rests, with inputs and level as there.

    Raises:
        NoEquilibriumError: There is none that the model holds for; one line that names the part, and what would help.
    """
    u, level = np.array(file.operating_point.inputs), file.operating_point.level_pct
    with np.errstate(all="ignore"):  # far from any plant numbers overflow, which is then said
        found = _settled(*relaxed(u, level, file.box, helium), u, file.box, helium)
        for _ in range(FURTHER_RELAXATIONS):
            if not isfinite(found.residual):  # a slow plant, perhaps
                found = _settled(*relaxed(u, level, file.box, helium, found.x), u, file.box, helium)
        for obstacle in obstacles(found, file, helium):
            raise NoEquilibriumError(obstacle)
    return found


def _settled(x: RealArray, w: float, u: RealArray, box: ColdBox, helium: Helium) -> Equilibrium:
    """Return the rest near a state; where there is none, that state, with a residual that is not a number."""
    try:
        return rest_near(x, w, u, box, helium)
    except NoEquilibriumError:
        return Equilibrium(x, u, w, outputs(x, u, w, box, helium), nan)


def obstacles(found: Equilibrium, file: PlantFile, helium: Helium) -> Iterator[str]:
    """Yield what is in the way of a plant at the state that was found; its residual is not a number if it moves."""
    x, u, w, y, residual = found
    box = file.box
    if not (isfinite(w) and np.isfinite(x).all() and np.isfinite(y).all()):
        rates, parts = _rates(first_guess(file.operating_point.level_pct, box), u, 0.0, box, helium)
        part = parts[int(np.argmin(rates.real))]
        yield f"{part}: does not stay finite in steps of a tick; {_slower(part)}"
        return
    s = streams(x, u, box, helium)
    P_mix, P_nozzle, relief = s.P_mix / PA_PER_BAR, s.P_turbine / PA_PER_BAR, box.separator.relief_pressure
    outside = model_range(x, box.P_HP / PA_PER_BAR, box.P_LP / PA_PER_BAR)
    if outside & ModelRange.BATH_PRESSURE or x[0] > relief:
        half = "warm" if s.P_mix - box.P_LP > x[0] - s.P_mix else "cold"
        yield (
            f"bath: its pressure would be {x[0] / PA_PER_BAR:.2f} bar, not between {SATURATION_BAR[0]:g} bar and"
            f" bath.relief_pressure_bar, {relief / PA_PER_BAR:g} bar; less return_line.{half}_drop_bar or"
            " boundaries.p_lp_bar would help, or less flow (cv155.area_mm2, turbine.nozzle_g_sqrt_k_per_s_bar)"
        )
    if outside & (ModelRange.COLD_CELL | ModelRange.WARM_CELL):
        cell = int(np.argmin(x[2:] - COLDEST_CELLS_K) if outside & ModelRange.COLD_CELL else np.argmax(x[2:]))
        k, coldest = 2 + cell, COLDEST_CELLS_K[cell]
        yield (
            f"{_part(k)}: {STATE_NAMES[k]} would be {x[k]:.1f} K, and is to be within {coldest:g} to {WARMEST_CELL_K:g}"
            f" K; change {_part(k)}.ua_w_per_k or the flows through it"
        )
    if s.P_mix > CRITICAL_RATIO * s.P_turbine:
        yield (
            f"turbine: its nozzle is not choked with {P_nozzle:.2f} bar before and {P_mix:.2f} bar behind it; less"
            " turbine.nozzle_g_sqrt_k_per_s_bar or a wider CV156 would help, or less return_line.warm_drop_bar"
        )
    if y[T5] <= saturation(s.P_mix, helium).T + 1e-6:
        yield (
            f"turbine: its exhaust would be wet, T5 at the boiling point of {y[T5]:.2f} K; less turbine.efficiency or"
            " less nef34.ua_w_per_k would help, or more load (a smaller turbine.nozzle_g_sqrt_k_per_s_bar)"
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
        k = int(np.argmax(np.abs(derivative(x, u, w, box, helium) / state_scales(box))))
        yield (
            f"{_part(k)}: finds no rest, {STATE_NAMES[k]} ({STATE_UNITS[k]}) moves most; another"
            " operating_point.cv155_pct would help, or less nef1.ua_w_per_k and nef2.ua_w_per_k for their flows"
        )
        return
    yield from _dynamics(found, box, helium)


def _dynamics(rest: Equilibrium, box: ColdBox, helium: Helium) -> Iterator[str]:
    """Yield what is in the way of a plant that rests: it runs away, or is too fast for a tick."""
    rates, parts = _rates(rest.x, rest.u, rest.w, box, helium)
    rising, falling = int(np.argmax(rates.real)), int(np.argmin(rates.real))
    if rates[rising].real > GROWTH:
        yield (
            f"{parts[rising]}: runs away from this operating point within {1.0 / rates[rising].real:.0f} s; take other"
            " operating_point.cv155_pct and cv156_pct"
        )
    if rates[falling].real < -FASTEST:
        part = parts[falling]
        yield f"{part}: follows within {-1.0 / rates[falling].real:.2f} s, too fast for a tick; {_slower(part)}"


def _rates(
    x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium
) -> tuple[NDArray[np.complex128], list[str]]:
    """Return the eigenvalues at a state (1/s), and the part that moves most with each."""
    rates, vectors = np.linalg.eig(state_and_load_jacobian(x, u, w, box, helium)[0])
    moves = np.abs(vectors / state_scales(box)[:, np.newaxis])
    return rates.astype(np.complex128), [_part(int(k)) for k in np.argmax(moves, axis=0)]


def _part(state: int) -> str:
    """Return the section of a plant file that a state belongs to."""
    return STATE_NAMES[state].split("_")[1] if STATE_NAMES[state].startswith("T_") else "bath"


def _slower(part: str) -> str:
    """Return what makes a part slower."""
    return "more bath.volume_m3 would help" if part == "bath" else f"more {part}.aluminium_kg or less flow would help"


def _levers(found: Equilibrium, file: PlantFile, helium: Helium) -> str:
    """Return which parameters raise the load most, by how much for 10 %, to first order at the state that was found."""
    x, u, w = found.x, found.u, found.w
    by_state, by_load = state_and_load_jacobian(x, u, w, file.box, helium)
    by_state[:, 1] = by_load
    here = derivative(x, u, w, file.box, helium)
    moved = np.stack([derivative(x, u, w, file.scaled(key, 1.0 + STEP), helium) - here for key in LEVERS], axis=1)
    gains: RealArray = 0.1 / STEP * np.linalg.lstsq(by_state, -moved, rcond=None)[0][1]
    best = np.argsort(-np.abs(gains))[:NAMED_LEVERS]
    return ", ".join(f"10 % {'more' if gains[k] > 0 else 'less'} {LEVERS[k]} (+{abs(gains[k]):.0f} W)" for k in best)
