"""The operating point of a refrigerator's plant file, or which of its components is in the way and what would help."""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from coldloop.process.lti_model import LtiModel
from coldloop_plant.cold_box.diagnosis import FASTEST, GROWTH, obstacles, operating_point
from coldloop_plant.cold_box.equilibrium import Equilibrium, NoEquilibriumError
from coldloop_plant.cold_box.physics import streams
from coldloop_plant.components.screw_compressor import compress
from coldloop_plant.helium.properties import Helium
from coldloop_plant.numeric import PA_PER_BAR, RealArray
from coldloop_plant.refrigerator.equilibrium import AMBIENT, Rest, find_refrigerator_equilibrium, first_guess
from coldloop_plant.refrigerator.linearisation import jacobian
from coldloop_plant.refrigerator.model import make_refrigerator_file
from coldloop_plant.refrigerator.physics import BOX_STATES, COMMAND_NAMES, STATE_NAMES, STATE_UNITS
from coldloop_plant.refrigerator.plant_file import RefrigeratorPlantFile
from coldloop_plant.refrigerator.prediction import prediction_model
from coldloop_plant.refrigerator.station_settings import LqWeights

OPEN: Final = 100.0
WIDER: Final = 100.0
"""How much wider valves are made to see whether they are in the way."""
LEAST_BYPASS: Final = 0.5
"""g/s: with less the low pressure cannot be raised."""
COIL: Final = STATE_NAMES.index("T_nef5")


class Found(NamedTuple):
    """A refrigerator at rest, with what goes with it."""

    rest: Rest
    model: LtiModel
    """Of the refrigerator with its pressure loop closed; it carries the plant, its rest and its gains."""


def refrigerator_operating_point(file: RefrigeratorPlantFile, helium: Helium, weights: LqWeights) -> Found:
    """Return the state at which the refrigerator of a plant file rests, the gains of these weights, and the model.

    Raises:
        NoEquilibriumError: There is none that the model holds for; one line that names the part, and what would help.
    """
    for obstacle in _wrong_pressures(file):
        raise NoEquilibriumError(obstacle)
    cold = operating_point(file, helium)
    for obstacle in _wrong_flows(cold, file, helium):
        raise NoEquilibriumError(obstacle)
    plant = file.refrigerator
    with np.errstate(all="ignore"):
        try:
            rest = find_refrigerator_equilibrium(cold, plant, helium, file.station.buffer_bar * PA_PER_BAR)
        except (NoEquilibriumError, np.linalg.LinAlgError):
            raise NoEquilibriumError(_why_restless(cold, file, helium)) from None
        for obstacle in _wrong_rest(rest, file, helium):
            raise NoEquilibriumError(obstacle)
        try:
            own = make_refrigerator_file(plant, weights, rest)
        except (np.linalg.LinAlgError, ValueError):
            raise NoEquilibriumError(
                "station: no gains hold both pressures; more station.hp_volume_m3 and station.lp_volume_m3 would help"
            ) from None
        model = prediction_model(own, plant, file.parameters, own.document)
        for obstacle in _wrong_dynamics(model):
            raise NoEquilibriumError(obstacle)
    return Found(rest, model)


def _wrong_pressures(file: RefrigeratorPlantFile) -> Iterator[str]:
    """Yield what is in the way of the pressures at rest, before anything is sought."""
    high, low, buffer = file.boundaries.p_hp_bar, file.boundaries.p_lp_bar, file.station.buffer_bar
    for name, pressure in (("hp", high), ("lp", low), ("buffer", buffer)):
        opens = getattr(file, f"{name}_relief").pressure_bar
        if pressure >= opens:
            yield (
                f"{name}_relief: opens at {opens:g} bar, and the line is to be at {pressure:g} bar; more"
                f" {name}_relief.pressure_bar would help"
            )
    if not low < buffer < high:
        yield (
            f"station.buffer_bar: {buffer:g} bar is not between the lines, {low:g} and {high:g} bar, so that CV952 or"
            " CV953 moves no gas; take a pressure between"
        )


def _wrong_flows(cold: Equilibrium, file: RefrigeratorPlantFile, helium: Helium) -> Iterator[str]:
    """Yield that the compressors deliver less than the cold box takes."""
    plant = file.refrigerator
    box, station = plant.box, plant.station
    s = streams(cold.x, cold.u, box, helium)
    taken = 1e3 * (s.m_jt + s.m_t)
    given = 1e3 * sum(compress(nc, 1.0, box.P_LP, box.P_HP, AMBIENT).mass_flow for nc in (station.nc1, station.nc2))
    if given < taken + LEAST_BYPASS:
        factor = (taken + LEAST_BYPASS) / given if given > 0.0 else np.inf
        help_ = (
            f"{factor:.2f} times nc1.displacement_l_per_s and nc2.displacement_l_per_s would do"
            if np.isfinite(factor)
            else "less nc1.slip and nc2.slip would help"
        )
        yield (
            f"nc1, nc2: deliver {given:.1f} g/s from {file.boundaries.p_lp_bar:g} to {file.boundaries.p_hp_bar:g} bar,"
            f" and the cold box takes {taken:.1f} g/s; {help_}, or a smaller turbine.nozzle_g_sqrt_k_per_s_bar"
        )


def _why_restless(cold: Equilibrium, file: RefrigeratorPlantFile, helium: Helium) -> str:
    """Return why no rest was found: a part is too fast, or a valve too small, as with a wider one there is a rest."""
    plant, P_buffer = file.refrigerator, file.station.buffer_bar * PA_PER_BAR
    x, n = first_guess(cold, plant, helium, P_buffer), len(STATE_NAMES)
    v, d = np.zeros(len(COMMAND_NAMES)), np.array([cold.w, AMBIENT, 0.0, 1.0, 1.0, 1.0])
    for obstacle in _too_fast(jacobian(x, cold.u, v, d, plant, helium)[:n, :n], STATE_NAMES, STATE_UNITS):
        return obstacle
    for section, key in (("nef5", "cv167_area_mm2"), ("station", "cv956_area_mm2")):
        part = getattr(file, section)
        wider = WIDER * max(1.0, type(part).model_fields[key].default / getattr(part, key))
        wide = part.model_copy(update={key: wider * getattr(part, key)})
        try:
            plant = file.model_copy(update={section: wide}).refrigerator
            rest = find_refrigerator_equilibrium(cold, plant, helium, P_buffer)
        except (NoEquilibriumError, np.linalg.LinAlgError):
            continue
        for obstacle in _too_narrow(wider * rest.v):
            if obstacle.startswith(section):
                return obstacle
    return (
        "nef6: finds no rest with the nitrogen bath and the cold box; more nef6.ua_w_per_k or nef5.ua_w_per_k would"
        " help, or less flow"
    )


def _too_narrow(v: RealArray) -> Iterator[str]:
    """Yield which warm valve would have to open further than it can."""
    bypass, _, _, feed = v
    if not 0.0 < bypass <= OPEN:
        yield (
            f"station.cv956_area_mm2: the bypass would be {bypass:.0f} % open; more of it, or less displacement of nc1"
            " and nc2, would help"
        )
    if not 0.0 < feed <= OPEN:
        yield (
            f"nef5.cv167_area_mm2: the nitrogen feed would be {feed:.0f} % open; more of it would help, or more"
            " nef6.ua_w_per_k, which leaves less to cool"
        )


def _wrong_rest(rest: Rest, file: RefrigeratorPlantFile, helium: Helium) -> Iterator[str]:
    """Yield what is in the way at the rest that was found."""
    yield from _too_narrow(rest.v)
    yield from obstacles(cold_part(rest), cooled_file(file, rest), helium)


def cold_part(rest: Rest) -> Equilibrium:
    """Return the rest of the cold box within that of the refrigerator."""
    return Equilibrium(rest.x[:BOX_STATES], rest.u, float(rest.d[0]), rest.y, rest.residual)


def cooled_file(file: RefrigeratorPlantFile, rest: Rest) -> RefrigeratorPlantFile:
    """Return the file with the temperature after the pre-cooler that it has at rest."""
    given = file.boundaries.model_copy(update={"t_in_k": float(rest.x[COIL])})
    return file.model_copy(update={"boundaries": given})


def _wrong_dynamics(model: LtiModel) -> Iterator[str]:
    """Yield that the refrigerator runs away with its pressures controlled, or is too fast for a tick."""
    rates, parts = _rates(model.A, model.state_names, model.state_units)
    rising = int(np.argmax(rates))
    if rates[rising] > GROWTH:
        yield (
            f"{parts[rising]}: runs away from this operating point within {1.0 / rates[rising]:.0f} s, with its"
            " pressures controlled; take other operating_point.cv155_pct and cv156_pct"
        )
    yield from _too_fast(model.A, model.state_names, model.state_units)


def _too_fast(A: RealArray, names: Sequence[str], units: Sequence[str]) -> Iterator[str]:
    """Yield which part follows faster than steps of a tick can."""
    rates, parts = _rates(A, names, units)
    falling = int(np.argmin(rates))
    if rates[falling] < -FASTEST:
        part = parts[falling]
        more = MORE.get(part, f"{part}.aluminium_kg")
        yield f"{part}: follows within {-1.0 / rates[falling]:.2g} s, too fast for a tick; more {more} would help"


def _rates(A: RealArray, names: Sequence[str], units: Sequence[str]) -> tuple[RealArray, list[str]]:
    """Return the real parts of the eigenvalues (1/s), and the part that moves most with each."""
    rates, vectors = np.linalg.eig(A)
    moves = np.abs(vectors) / np.array([SIZES.get(unit, 1.0) for unit in units])[:, np.newaxis]
    return rates.real, [_part(names[int(k)]) for k in np.argmax(moves, axis=0)]


SIZES: Final = {"Pa": 2e3, "m3": 2e-3, "kg": 0.01, "kg/s": 0.01, "bar": 0.1, "bar s": 1.0}
"""An ordinary deviation of a state, by its unit; of others 1."""
MORE: Final = {
    "station": "station.hp_volume_m3, station.lp_volume_m3 or station.valve_lag_s",
    "nef5": "nef5.capacity_kj_per_k",
    "bath": "bath.volume_m3",
}
"""What makes a part slower that has no walls of aluminium."""


def _part(state: str) -> str:
    """Return the section of a plant file that a state belongs to."""
    if state.startswith("T_"):
        return state.split("_")[1]
    return "bath" if state in {"P1", "V_l"} else "station"
