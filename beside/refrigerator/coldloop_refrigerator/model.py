"""The refrigerator at rest, off line: operating point, LQ gains of its station, prediction model, what is in their way.

`python -m coldloop_refrigerator.model FILE` makes the refrigerator's file; with `--config` or `--set
plant.station.weights.lp_bar=0.02` its gains are of these weights. With `--prediction` it makes the prediction model of
the file that is shipped.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from coldloop.config import load_configuration
from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES, STATION_SIGNAL_NAMES, STATION_VALVE_NAMES, TICK_S
from coldloop.process.lti_model import LtiModel
from coldloop.service import add_configuration_options
from coldloop.service.start import SECTIONS
from coldloop_plant.cold_box import model as cold_box
from coldloop_plant.cold_box import plant_file, streams
from coldloop_plant.equilibrium import Linear, Modes, NoEquilibriumError, complex_step, model_of, newton
from coldloop_plant.helium import Helium, load_helium
from coldloop_plant.numeric import PA_PER_BAR, Array, RealArray
from coldloop_plant.settings import LqWeights, PlantSettings, StationSettings
from coldloop_refrigerator import physics
from coldloop_refrigerator.physics import COMMAND_NAMES, STATE_NAMES, Refrigerator
from coldloop_refrigerator.plant_file import KIND, REFERENCE_REFRIGERATOR, RefrigeratorPlantFile
from coldloop_refrigerator.program import SHIPPED, RefrigeratorFile, read_refrigerator_file, refrigerator_digest
from coldloop_refrigerator.warm import LIQUID_DENSITY, GasVolume, compress, gas_mass

AMBIENT: Final = 300.0
V_L, M_HP, M_LP, M_BUFFER, M_LOST, M_N2, CV956, CV167 = (
    STATE_NAMES.index(name) for name in ("V_l", "M_HP", "M_LP", "M_buffer", "M_lost", "M_N2", "CV956", "CV167")
)
LINES: Final = (M_HP, M_LP)
PRESSURE_ROWS: Final = tuple(
    len(STATE_NAMES) + len(OUTPUT_NAMES) + physics.SIGNAL_NAMES.index(name) for name in ("P12", "P11")
)
"""Rows of the refrigerator's Jacobian that are those of the pressures of both lines."""


def rate_scales(plant: Refrigerator) -> RealArray:
    """Return the size of an ordinary deviation of each state: as in the cold box; 10 g of helium, 1 % of opening."""
    return cold_box.state_scales(plant.box, physics.STATE_UNITS)


def jacobian(x: RealArray, u: RealArray, v: RealArray, d: RealArray, plant: Refrigerator, helium: Helium) -> RealArray:
    """Return the derivatives of (dx/dt, y, signals) with respect to (x, u, v, d), shape (89, 61)."""
    cuts = np.cumsum([x.size, u.size, v.size])

    def evaluate(z: Array) -> Array:
        xz, uz, vz, dz = np.split(z, cuts)
        return np.concatenate(physics.evaluated(xz, uz, vz, dz, plant, helium))

    at = np.concatenate([x, u, v, d])
    return complex_step(evaluate, at, np.ones(at.size))


def _disturbances(load: float) -> RealArray:
    """Return those at an operating point, shape (6,): nitrogen is there, both compressors run."""
    return np.array([load, AMBIENT, 0.0, 1.0, 1.0, 1.0])


AS_ASKED: Final = tuple(STATE_NAMES.index(name) for name in ("NC1", "NC2", "CV952", "CV953"))
"""Compressors run, and both valves of the buffer are shut, to the bit."""
GIVEN: Final = (V_L, M_LP, M_BUFFER, M_LOST, M_N2, *AS_ASKED)


class Rest(NamedTuple):
    """The refrigerator at rest, in the shapes and units of `physics`."""

    x: RealArray
    u: RealArray
    v: RealArray
    d: RealArray
    y: RealArray
    signals: RealArray
    residual: float  # Largest |dx/dt| in units of `rate_scales`, per second


def find_refrigerator_equilibrium(
    cold: cold_box.Equilibrium, plant: Refrigerator, helium: Helium, P_buffer: float = 6e5
) -> Rest:
    """Return the rest of `plant` at the cold box's inputs and level, near the rest `cold` of the cold box alone.

    Supply and suction pressure are the cold box's boundaries, `P_buffer` (Pa) is that of the buffer.

    Unknown beside the states are the load, the opening of the bypass and that of the nitrogen feed; in their place the
    levels, the two pressures and the buffer's content are given; the mass of the high-pressure side follows from its
    pressure and the temperatures of the passes. The mass of the whole circuit is constant, so one equation follows from
    the others, and the steps of Newton's method are those of least squares.

    Raises:
        NoEquilibriumError: Newton's method does not converge.
    """
    start, u, n, m = first_guess(cold, plant, helium, P_buffer), cold.u, len(STATE_NAMES), len(cold.u)
    v, d = np.array([start[CV956], 0.0, 0.0, start[CV167]]), _disturbances(cold.w)
    x = _relaxed(start.copy(), u, v, d, plant, helium)
    dx, _, signals = physics.evaluated(x, u, v, d, plant, helium)
    surplus = 1e3 * dx[M_HP] / signals[physics.SIGNAL_NAMES.index("M_CV956")]
    x[CV956] = v[0] = max(0.0, float(x[CV956] * (1.0 + surplus)))  # else the surplus works on the passes
    free = [i for i in range(n) if i not in (*GIVEN, M_HP)]
    warm = [k for k, i in enumerate(free) if STATE_NAMES[i].startswith("T_")]
    scales, unknown = rate_scales(plant), [*free, n + m + len(COMMAND_NAMES), n + m, n + m + 3]  # load, bypass, feed

    def apart(z: RealArray) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        return z[:n], u, z[n:-1], _disturbances(z[-1])

    def step(z: RealArray, moving: RealArray) -> RealArray:
        J = jacobian(*apart(z), plant, helium)
        follows = -J[PRESSURE_ROWS[0]] / J[PRESSURE_ROWS[0], M_HP]  # the mass follows, the high pressure is given
        J = (J + np.outer(J[:, M_HP], follows))[:n] / scales[:, np.newaxis]
        moved = np.linalg.lstsq(J[:, unknown], -moving, rcond=1e-13)[0]
        moved *= min(1.0, 10.0 / float(np.max(np.abs(moved[warm]))))  # 10 K at most
        z = z.copy()
        z[[*free, -1, n, n + 3]] += moved
        z[M_HP] = physics.high_pressure_mass(z[:n], plant.box.P_HP, AMBIENT, plant, helium)
        return z

    z, residual = newton(
        np.array([*x, *v, cold.w]), lambda z: physics.evaluated(*apart(z), plant, helium)[0] / scales, step, 60,
        "the refrigerator has no equilibrium",
    )  # fmt: skip
    return Rest(*apart(z), *physics.evaluated(*apart(z), plant, helium)[1:], residual)


def _relaxed(x: RealArray, u: RealArray, v: RealArray, d: RealArray, plant: Refrigerator, helium: Helium) -> RealArray:
    """Return the state after a time in which what is given is held.

    In the place of the two lines are very large ones, so that their pressures stay whatever enters and leaves, and no
    work of the pressure warms the passes.
    """
    large_line = GasVolume(1e6)
    large = plant._replace(station=plant.station._replace(hp=large_line, lp=large_line))
    held = [*GIVEN, M_HP]
    in_low_pressure_line = x[M_LP]
    x[M_HP] = physics.high_pressure_mass(x, plant.box.P_HP, AMBIENT, large, helium)
    x[M_LP] = gas_mass(large_line, plant.box.P_LP, AMBIENT)
    given = x[held]
    for _ in range(20_000):
        x = physics.advance_refrigerator(x, u, v, d, TICK_S, large, helium)
        x[held] = given
    x[M_LP] = in_low_pressure_line
    x[M_HP] = physics.high_pressure_mass(x, plant.box.P_HP, AMBIENT, plant, helium)
    return x


def first_guess(cold: cold_box.Equilibrium, plant: Refrigerator, helium: Helium, P_buffer: float) -> RealArray:
    """Return the state from which the search sets out."""
    station, precooler = plant.station, plant.precooler
    hot = AMBIENT + station.cooler_approach
    nitrogen = 60.0 / 100.0 * precooler.nef5.volume * LIQUID_DENSITY
    masses = [0.0, gas_mass(station.lp, plant.box.P_LP, AMBIENT), gas_mass(station.buffer, P_buffer, AMBIENT)]
    exchanger = np.linspace(hot - 25.0, 84.0, precooler.nef6.cells)
    x = np.concatenate([cold.x, exchanger, [80.0, nitrogen, 30.0], masses, [0.0, 1.0, 1.0, 25.0, 0.0, 0.0]])
    x[M_HP] = physics.high_pressure_mass(x, plant.box.P_HP, AMBIENT, plant, helium)
    return x


def lq_gains(J: RealArray, lag_s: float, weights: LqWeights) -> RealArray:
    """Return K, shape (2, 6), of flows = -K (HP, LP, bypass, inventory, integral of HP, integral of LP).

    The states are the pressures of the two lines (bar), the flows through bypass and inventory valves (kg/s), which
    follow their commands with the actuators' lag, and the integrals of the two pressures' errors (bar s). Inputs are
    flows: u = (bypass, inventory), the inventory flow positive from the buffer into the low-pressure line.
    `station_control` turns flows into openings. Of the refrigerator's Jacobian J the lines are read, with the states of
    the cold box held. The idea is that of Bonne et al., CEC 2013.
    """
    A = np.zeros((4, 4))
    scale = np.diag([J[row, line] for row, line in zip(PRESSURE_ROWS, LINES, strict=True)])
    A[:2, :2] = scale @ J[np.ix_(LINES, LINES)] @ np.linalg.inv(scale)
    A[:2, 2:] = scale @ np.array([[-1.0, 0.0], [1.0, 1.0]])
    A[2:, 2:] = -np.eye(2) / lag_s
    held = np.zeros((6, 6))
    held[:4, :4], held[2:4, 4:] = A, np.eye(2) / lag_s
    held = expm(held * TICK_S)
    F, G = np.eye(6), np.zeros((6, 2))
    F[:4, :4], G[:4] = held[:4, :4], held[:4, 4:]
    F[4:, :2] = TICK_S * np.eye(2)
    sizes = [weights.hp_bar, weights.lp_bar, np.inf, np.inf, weights.hp_integral, weights.lp_integral]
    Q = np.diag(1.0 / np.square(sizes))
    R = np.diag(1.0 / np.square([weights.bypass_kg_s, weights.inventory_kg_s]))
    P = solve_discrete_are(F, G, Q, R)
    gains: RealArray = np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)
    return gains


def make_refrigerator_file(
    plant: Refrigerator = REFERENCE_REFRIGERATOR, weights: LqWeights | None = None, rest: Rest | None = None
) -> RefrigeratorFile:
    """Return operating point and gains of a refrigerator at a rest, by default at the cold box's operating inputs.

    Raises:
        NoEquilibriumError: It does not come to rest there.
    """
    helium, weights = load_helium(), weights or LqWeights()
    if rest is None:
        cold = cold_box.find_equilibrium(
            np.array(plant_file.OPERATING_INPUTS), plant_file.OPERATING_LEVEL, plant.box, helium
        )
        rest = find_refrigerator_equilibrium(cold, plant, helium)
    J = jacobian(rest.x, rest.u, rest.v, rest.d, plant, helium)
    first, second = lq_gains(J, plant.station.actuator.lag, weights).tolist()
    return RefrigeratorFile(
        parameters_digest=refrigerator_digest(plant), w0=float(rest.d[0]), x0=tuple(rest.x.tolist()),
        u0=tuple(rest.u.tolist()), v0=tuple(rest.v.tolist()), gains=(tuple(first), tuple(second)), weights=weights,
    )  # fmt: skip


KEPT: Final = (*range(STATE_NAMES.index("T_nef5") + 1), *LINES)
"""States of the refrigerator that are states of the model; the lines come last."""
LOOP_STATES: Final = {"bypass": "kg/s", "inventory": "kg/s", "integral_HP": "bar s", "integral_LP": "bar s"}


def prediction_model(
    file: RefrigeratorFile,
    plant: Refrigerator = REFERENCE_REFRIGERATOR,
    parameters: Mapping[str, Any] | None = None,
    rest: Mapping[str, Any] | None = None,
) -> LtiModel:
    """Return the linear model of a refrigerator with its pressure loop closed by the gains of its file.

    Its inputs, load and outputs are those of the cold box's model, so that the optimiser and the control PLC take it in
    the other's place. Beside the cold box's states it has those of the pre-cooler's exchangers, the masses of both
    lines, the flows through bypass and inventory valves, and the integrals of the LQ controller. Left out is what has
    no influence on them: the nitrogen's level while the coil is wet, the buffer while its valves are choked, the
    compressors' speed.

    `parameters` and `rest` are what the model file is to carry of the plant, beside the linear model.
    """
    helium = load_helium()
    point = np.array(file.x0), np.array(file.u0), np.array(file.v0), _disturbances(file.w0)
    J = jacobian(*point, plant, helium)
    _, y0, _ = physics.evaluated(*point, plant, helium)
    n, extra = len(STATE_NAMES), len(LOOP_STATES)
    inputs, load = slice(n, n + 3), n + 7 + physics.DISTURBANCE_NAMES.index("NCR22_HL")
    outputs, rows = slice(n, n + len(y0)), list(KEPT)
    kept, lag_s = len(rows), plant.station.actuator.lag
    A, loop = np.zeros((kept + extra, kept + extra)), np.zeros((2 + extra, kept + extra))
    A[:kept, :kept] = J[np.ix_(rows, rows)]
    A[:kept, kept] = J[rows, CV956] / -J[M_HP, CV956]  # the bypass flow leaves the high-pressure side, whose gas cools,
    A[kept - 1, kept : kept + 2] = 1.0  # and reaches, with that from the buffer, the low-pressure line
    loop[:2, :kept] = J[np.ix_(PRESSURE_ROWS, rows)]  # the high pressure also follows the passes' temperatures
    loop[2:, kept:] = np.eye(extra)
    A[kept : kept + 2] = -np.array(file.gains) @ loop / lag_s  # flows follow -K (pressures, flows, integrals)
    A[kept : kept + 2, kept : kept + 2] -= np.eye(2) / lag_s
    A[kept + 2 :] = loop[:2]
    linear = Linear(
        A=A,
        B=np.vstack([J[rows, inputs], np.zeros((extra, 3))]),
        F=np.concatenate([J[rows, load], np.zeros(extra)]), C=np.hstack([J[outputs, rows], np.zeros((len(y0), extra))]),
        D=J[outputs, inputs], G=J[outputs, load],
    )  # fmt: skip
    return model_of(
        linear, np.concatenate([point[0][rows], np.zeros(extra)]), point[1], file.w0, y0, COLD_BOX,
        {STATE_NAMES[i]: physics.STATE_UNITS[i] for i in rows} | LOOP_STATES, refrigerator_digest(plant), plant=KIND,
        plant_parameters=dict(parameters or {}), plant_rest=dict(rest or {}),
    )  # fmt: skip


def refrigerator_operating_point(
    file: RefrigeratorPlantFile, helium: Helium, weights: LqWeights
) -> tuple[Rest, LtiModel]:
    """Return the state at which the refrigerator of a plant file rests, and its model with its pressure loop closed.

    The model carries the plant, its rest and the gains of these weights.

    Raises:
        NoEquilibriumError: There is none that the model holds for; one line that names the part, and what would help.
    """
    for obstacle in _wrong_pressures(file):
        raise NoEquilibriumError(obstacle)
    cold = cold_box.operating_point(file, helium)
    for obstacle in _wrong_flows(cold, file, helium):
        raise NoEquilibriumError(obstacle)
    plant = file.refrigerator
    with np.errstate(all="ignore"):
        try:
            rest = find_refrigerator_equilibrium(cold, plant, helium, file.station.buffer_bar * PA_PER_BAR)
        except NoEquilibriumError:
            raise NoEquilibriumError(_why_restless(cold, file, helium)) from None
        of_the_box = cold_box.obstacles(cold_part(rest), cooled_file(file, rest), helium)
        for obstacle in chain(_too_narrow(rest.v), of_the_box):
            raise NoEquilibriumError(obstacle)
        try:
            own = make_refrigerator_file(plant, weights, rest)
        except (np.linalg.LinAlgError, ValueError):
            raise NoEquilibriumError(
                "station: no gains hold both pressures; more station.hp_volume_m3 and station.lp_volume_m3 would help"
            ) from None
        model = prediction_model(own, plant, file.parameters, own.model_dump(mode="json"))
        modes = _modes(model.A, model.state_names, model.state_units, plant)
        for obstacle in (*modes.growing(", with its pressures controlled"), *modes.too_fast(slower)):
            raise NoEquilibriumError(obstacle)
    return rest, model


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


def _wrong_flows(cold: cold_box.Equilibrium, file: RefrigeratorPlantFile, helium: Helium) -> Iterator[str]:
    """Yield that the compressors deliver less than the cold box takes."""
    least_bypass = 0.5  # g/s: with less the low pressure cannot be raised
    box, station = file.refrigerator.box, file.refrigerator.station
    s = streams(cold.x, cold.u, box, helium)
    taken = 1e3 * (s.m_jt + s.m_t)
    given = 1e3 * sum(compress(nc, 1.0, box.P_LP, box.P_HP, AMBIENT).mass_flow for nc in (station.nc1, station.nc2))
    if given < taken + least_bypass:
        factor = (taken + least_bypass) / given if given > 0.0 else np.inf
        help_ = (
            f"{factor:.2f} times nc1.displacement_l_per_s and nc2.displacement_l_per_s would do"
            if np.isfinite(factor)
            else "less nc1.slip and nc2.slip would help"
        )
        yield (
            f"nc1, nc2: deliver {given:.1f} g/s from {file.boundaries.p_lp_bar:g} to {file.boundaries.p_hp_bar:g} bar,"
            f" and the cold box takes {taken:.1f} g/s; {help_}, or a smaller turbine.nozzle_g_sqrt_k_per_s_bar"
        )


def _why_restless(cold: cold_box.Equilibrium, file: RefrigeratorPlantFile, helium: Helium) -> str:
    """Return why no rest was found: a part is too fast, or a valve too small, as with a wider one there is a rest."""
    plant, P_buffer = file.refrigerator, file.station.buffer_bar * PA_PER_BAR
    x, n = first_guess(cold, plant, helium, P_buffer), len(STATE_NAMES)
    A = jacobian(x, cold.u, np.zeros(len(COMMAND_NAMES)), _disturbances(cold.w), plant, helium)[:n, :n]
    for obstacle in _modes(A, STATE_NAMES, physics.STATE_UNITS, plant).too_fast(slower):
        return obstacle
    for section, key in (("nef5", "cv167_area_mm2"), ("station", "cv956_area_mm2")):
        part = getattr(file, section)
        wider = 100.0 * max(1.0, type(part).model_fields[key].default / getattr(part, key))
        wide = part.model_copy(update={key: wider * getattr(part, key)})
        try:
            plant = file.model_copy(update={section: wide}).refrigerator
            rest = find_refrigerator_equilibrium(cold, plant, helium, P_buffer)
        except NoEquilibriumError:
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
    if not 0.0 < bypass <= 100.0:
        yield (
            f"station.cv956_area_mm2: the bypass would be {bypass:.0f} % open; more of it, or less displacement of nc1"
            " and nc2, would help"
        )
    if not 0.0 < feed <= 100.0:
        yield (
            f"nef5.cv167_area_mm2: the nitrogen feed would be {feed:.0f} % open; more of it would help, or more"
            " nef6.ua_w_per_k, which leaves less to cool"
        )


def cold_part(rest: Rest) -> cold_box.Equilibrium:
    """Return the rest of the cold box within that of the refrigerator."""
    return cold_box.Equilibrium(rest.x[: physics.BOX_STATES], rest.u, float(rest.d[0]), rest.y, rest.residual)


def cooled_file(file: RefrigeratorPlantFile, rest: Rest) -> RefrigeratorPlantFile:
    """Return the file with the temperature after the pre-cooler that it has at rest."""
    given = file.boundaries.model_copy(update={"t_in_k": float(rest.x[physics.COIL])})
    return file.model_copy(update={"boundaries": given})


def described_at_rest(file: RefrigeratorPlantFile, control: StationSettings) -> cold_box.AtRest:
    """Return the refrigerator of a plant file at rest, with its controller's setpoints and weights.

    Raises:
        NoEquilibriumError: As `refrigerator_operating_point`.
    """
    rest, model = refrigerator_operating_point(file, load_helium(), control.weights)
    signals = dict(zip(STATION_SIGNAL_NAMES, rest.signals.tolist(), strict=True))
    openings = [f"{name} {value:.2f} %" for name, value in zip(STATION_VALVE_NAMES, rest.v.tolist(), strict=True)]
    per_watt = 1e3 * signals["E_NC"] / float(rest.d[0] + rest.u[1])
    lines = [
        f"station    {'  '.join(openings)}",
        f"           compressors {signals['M_NC']:.1f} g/s, {signals['E_NC']:.1f} kW, {per_watt:.0f} W/W",
        f"           bypass {signals['M_CV956']:.1f} g/s, nitrogen {signals['M_GN2']:.2f} g/s",
    ]
    high, low = file.boundaries.p_hp_bar, file.boundaries.p_lp_bar
    if (high, low) != (control.hp_bar, control.lp_bar):
        settings = f"--set plant.station.hp_bar={high:g} --set plant.station.lp_bar={low:g}"
        set_points = f"set points {control.hp_bar:g} and {control.lp_bar:g} bar"
        lines.append(f"{set_points} are not the pressures at rest: {settings}")
    return cold_box.AtRest(cold_part(rest), cooled_file(file, rest).box, model, lines)


def _modes(A: RealArray, names: Sequence[str], units: Sequence[str], plant: Refrigerator) -> Modes:
    return Modes.of(A, cold_box.state_scales(plant.box, units), list(map(cold_box.part_of, names)))


def slower(part: str) -> str:
    """Return what makes a part slower; station and coil have no walls of aluminium."""
    volumes = "station.hp_volume_m3, station.lp_volume_m3 or station.valve_lag_s"
    more = {"station": volumes, "nef5": "nef5.capacity_kj_per_k"}
    return f"more {more[part]} would help" if part in more else cold_box.slower(part)


def main() -> None:
    """Write the file that the command line asks for."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description="Make the file of the refrigerator.")
    add_configuration_options(parser)
    parser.add_argument("file", type=Path, help="what to write")
    parser.add_argument("--prediction", action="store_true", help="make the prediction model instead")
    options = parser.parse_args()
    if options.prediction:
        prediction_model(read_refrigerator_file(SHIPPED)).save(options.file)
        return
    station = load_configuration(
        PlantSettings, file=options.config, assignments=options.assignments, others=SECTIONS
    ).settings.plant.station
    make_refrigerator_file(weights=station.weights).save(options.file)


if __name__ == "__main__":
    main()
