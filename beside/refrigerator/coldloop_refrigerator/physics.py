"""The whole refrigerator: the cold box (S1, S2), the nitrogen pre-cooler (S3) and the compression station (S4), joined.

What the cold box alone takes as given follows from the states here: its supply and suction pressure are those of the
station's lines, its inlet temperature that of the nitrogen bath's coil.

All functions are kernels, of real or complex numbers, and take

* x: 48 states, `STATE_NAMES`: those of the cold box, the pre-cooler and the station, one after the other;
* u: 3 inputs of the cold box (CV155 %, NCR22_A W, CV156 %);
* v: 4 commands of the warm valves, `COMMAND_NAMES`, %;
* d: 6 disturbances, `DISTURBANCE_NAMES`.

The exchangers' passes take and give helium as the high pressure moves (`refrigerator.high_pressure`); lines have
no pressure drop besides that of the cold box's return.
"""

from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop.process import cold_box
from coldloop_plant.cold_box import OUTPUTS, ColdBox, Streams, evaluate
from coldloop_plant.components.expansion import opening_rate
from coldloop_plant.components.heat_exchanger import WILD, HighPressureFlow, LowPressureFlow, widest_move
from coldloop_plant.components.phase_separator import Content, add_to_account, content, settle_account, start_account
from coldloop_plant.helium import Helium
from coldloop_plant.numeric import PA_PER_BAR, Array, RealArray
from coldloop_refrigerator.high_pressure import (
    COARSE_CELL,
    COARSE_PRESSURE,
    FIRST,
    Filling,
    add_gains,
    fill_passes,
    piped,
    read_passes,
    settle_passes,
    side_mass,
    side_pressure,
    start_gains,
)
from coldloop_refrigerator.precooler import (
    PRECOOLER_STATE_UNITS,
    PRECOOLER_STATES,
    Precooler,
    Precooling,
    nitrogen_level,
)
from coldloop_refrigerator.station import (
    STATION_STATE_UNITS,
    STATION_STATES,
    CompressionStation,
    StationFlows,
    station_pressures,
    station_rates,
)

BOX_STATES: Final = len(cold_box.STATE_NAMES)
STATION: Final = BOX_STATES + len(PRECOOLER_STATES)
"""Index of the station's first state; CV167 is before it."""
VALVES: Final = STATION + STATION_STATES.index("CV956")
"""Index of the first of the station's valves, in the order of `COMMAND_NAMES`."""
COIL: Final = BOX_STATES + PRECOOLER_STATES.index("T_nef5")
"""Index of the last state of the high-pressure passes."""
STATE_NAMES: Final = (*cold_box.STATE_NAMES, *PRECOOLER_STATES, *STATION_STATES)
STATE_UNITS: Final = (*cold_box.STATE_UNITS, *PRECOOLER_STATE_UNITS, *STATION_STATE_UNITS)
COMMAND_NAMES: Final = cold_box.STATION_VALVE_NAMES
DISTURBANCE_NAMES: Final = ("NCR22_HL", "T_ambient", "leak", "nitrogen", "NC1", "NC2")
"""Heat load (W), ambient temperature (K), leak at 16 bar (kg/s); 0 or 1: nitrogen in the tank, compressors to run."""

SIGNAL_NAMES: Final = cold_box.STATION_SIGNAL_NAMES
SIGNALS: Final = len(SIGNAL_NAMES)


class Refrigerator(NamedTuple):
    """Components of the refrigerator, in SI units; `refrigerator.plant_file` has the reference plant's."""

    box: ColdBox
    """Its boundaries P_HP and P_LP are the pressures at rest; the equations do not read them, nor T_in."""
    precooler: Precooler
    station: CompressionStation


class Crossing(NamedTuple):
    """Streams over the boundary of the cold part, and within it."""

    high: HighPressureFlow
    """Through CV155 and CV156, as it would come from the compressors, were nothing stored on the way."""
    filling: Filling
    """Flows of helium into and out of line and passes."""
    cold: Streams
    """Streams of the cold box."""
    leaving: LowPressureFlow
    """Low-pressure flow from the cold box to NEF6."""
    relief: float
    """Flow from the bath into the recovery line, kg/s."""
    bath: Content
    """Content of the bath."""
    cooling: Precooling
    """Flows of NEF6 and NEF5."""
    heater: float
    """W."""


@kernel
def evaluate_refrigerator(
    x: Array, u: Array, v: Array, d: Array, plant: Refrigerator, helium: Helium, dx: Array, y: Array, signals: Array
) -> Crossing:
    """Write the rates (48, per second), the cold box's outputs (22) and the warm signals (19, `SIGNAL_NAMES`).

    Returns the streams that cross the boundary of its cold part.
    """
    station, precooler, box = plant.station, plant.precooler, plant.box
    pipes = piped(box, precooler)
    held = read_passes(x, pipes, helium)
    T_hot = d[1] + station.cooler_approach
    HP = side_pressure(station.hp.volume, x[STATION], T_hot, held.mass)
    P = station_pressures(HP, x[STATION:], station, d[1])
    joined = ColdBox(
        box.separator, box.jt_valve, box.turbine, box.nef1, box.nef2, box.nef34, box.return_line, P.HP, P.LP,
        x[pipes.coil],
    )  # fmt: skip
    inputs = u if d[4].real + d[5].real > 0.0 else 0.0 * u
    cold, leaving, relief, bath = evaluate(
        x[:BOX_STATES], inputs, d[0], joined, helium, dx[:BOX_STATES], y, is_supply_held=False
    )
    high = HighPressureFlow(cold.m_jt + cold.m_t, T_hot, P.HP)
    flows = station_rates(
        x[STATION:], P, high.mass_flow, leaving.mass_flow, d[1], d[2], d[4:].real, station, dx[STATION:]
    )
    filling, cooling = fill_passes(
        P.HP, dx[STATION], T_hot, cold, leaving, station.hp.volume, pipes, held, helium, x, d[3], dx
    )
    dx[STATION + 3] += relief
    move_valves(x, v, plant, dx)
    signals[0], signals[1], signals[2] = P.LP / PA_PER_BAR, P.HP / PA_PER_BAR, P.buffer / PA_PER_BAR
    signals[3], signals[4] = cooling.warm_end.T, x[pipes.coil - 1]
    signals[5] = 1e3 * filling.entering
    _write_flows(flows, signals[6:])
    signals[10] += 1e3 * relief
    signals[13] = nitrogen_level(precooler.nef5, x[pipes.coil + 1])
    signals[14] = x[pipes.coil + 2]
    signals[15] = 1e3 * cooling.boiling.boil_off
    signals[16] = inventory(x, plant, helium)
    signals[17] = x[STATION + 3]
    signals[18] = d[1]
    return Crossing(high, filling, cold, leaving, relief, bath, cooling, inputs[1])


@kernel
def _write_flows(flows: StationFlows, signals: Array) -> None:
    signals[0] = 1e3 * flows.compressed
    signals[1], signals[2], signals[3] = 1e3 * flows.bypass, 1e3 * flows.discharge, 1e3 * flows.charge
    signals[4] = 1e3 * flows.out
    signals[5], signals[6] = 1e-3 * flows.power, 1e-3 * flows.cooling


@kernel
def move_valves(x: Array, v: Array, plant: Refrigerator, dx: Array) -> None:
    """Write the rates of the warm valves' openings into `dx` (48): all that the commands `v` act on at once."""
    for i in range(3):
        dx[VALVES + i] = opening_rate(plant.station.actuator, x[VALVES + i], v[i])
    dx[STATION - 1] = opening_rate(plant.precooler.actuator, x[STATION - 1], v[3])


@kernel
def inventory(x: Array, plant: Refrigerator, helium: Helium) -> float:
    """Return the helium (kg) in lines, passes, buffer and bath; what was lost is not in it."""
    in_bath = content(plant.box.separator, x[0], x[1], helium).mass
    total: float = x[STATION] + x[STATION + 1] + x[STATION + 2] + in_bath
    return total


@kernel
def high_pressure_mass(x: Array, P: float, T_ambient: float, plant: Refrigerator, helium: Helium) -> float:
    """Return what the high-pressure line and the passes hold (kg) at `P` (Pa), the passes as warm as in `x`."""
    held = read_passes(x, piped(plant.box, plant.precooler), helium)
    mass, _ = side_mass(plant.station.hp.volume, P, T_ambient + plant.station.cooler_approach, held.mass)
    return mass


@kernel
def rates(x: Array, u: Array, v: Array, d: Array, plant: Refrigerator, helium: Helium) -> Array:
    """Return dx/dt, shape (48,), in `STATE_UNITS` per second."""
    dx = np.empty_like(x)
    evaluate_refrigerator(x, u, v, d, plant, helium, dx, np.empty(22, x.dtype), np.empty(SIGNALS, x.dtype))
    return dx


@kernel
def read(x: Array, u: Array, v: Array, d: Array, plant: Refrigerator, helium: Helium) -> tuple[Array, Array]:
    """Return the outputs of the cold box, shape (22,), and the warm signals, shape (19,)."""
    y, signals = np.empty(22, x.dtype), np.empty(SIGNALS, x.dtype)
    evaluate_refrigerator(x, u, v, d, plant, helium, np.empty_like(x), y, signals)
    return y, signals


@kernel
def advance_refrigerator(
    x: RealArray, u: RealArray, v: RealArray, d: RealArray, dt: float, plant: Refrigerator, helium: Helium
) -> RealArray:
    """Return the state after `dt` seconds (shape (48,)), inputs held: one classical Runge-Kutta step.

    Stable up to dt = 1 s at the operating point. Loops run in a fixed order: the result is the same to the bit
    everywhere.
    """
    slope, signals = np.empty(x.shape[0]), np.empty(SIGNALS)
    cells = evaluate_refrigerator(x, u, v, d, plant, helium, slope, np.empty(OUTPUTS), signals).filling.cells
    return advance_along(x, slope, cells, PA_PER_BAR * signals[1], u, v, d, dt, plant, helium)


@kernel
def advance_along(
    x: RealArray, first: RealArray, cells: RealArray, P: float, u: RealArray, v: RealArray, d: RealArray, dt: float,
    plant: Refrigerator, helium: Helium,
) -> RealArray:  # fmt: skip
    """Return the state after `dt` seconds, where the first stage is known.

    At `x` dx/dt is `first`, the high pressure is `P` (Pa), and `cells` are those of `Filling`.
    """
    n = x.shape[0]
    slope, y, signals = np.empty(n), np.empty(OUTPUTS), np.empty(SIGNALS)
    stage, total = np.empty(n), np.empty(n)
    stages = np.empty((4, n))
    account = start_account(content(plant.box.separator, x[0], x[1], helium), first)
    gains = start_gains(cells)
    swing: float = 0.0
    for i in range(n):
        stages[0, i] = x[i]
        total[i] = first[i]
        stage[i] = x[i] + 0.5 * dt * first[i]
    for k, fraction in ((1, 0.5), (2, 1.0)):
        crossing = evaluate_refrigerator(stage, u, v, d, plant, helium, slope, y, signals)
        account = add_to_account(account, crossing.bath, slope, 2.0)
        add_gains(gains, crossing.filling.cells, 2.0)
        swing = max(swing, abs(crossing.filling.P - P))
        for i in range(n):
            stages[k, i] = stage[i]
            total[i] += 2.0 * slope[i]
            stage[i] = x[i] + fraction * dt * slope[i]
    crossing = evaluate_refrigerator(stage, u, v, d, plant, helium, slope, y, signals)
    account = add_to_account(account, crossing.bath, slope, 1.0)
    add_gains(gains, crossing.filling.cells, 1.0)
    swing = max(swing, abs(crossing.filling.P - P))
    for i in range(n):
        stages[3, i] = stage[i]
        stage[i] = x[i] + dt / 6.0 * (total[i] + slope[i])
    settle_account(plant.box.separator, account, dt / 6.0, stage, helium)
    pipes = piped(plant.box, plant.precooler)
    if swing > COARSE_PRESSURE or COARSE_CELL < widest_move(stages, stage, FIRST, pipes.coil) < WILD:
        T_hot = d[1] + plant.station.cooler_approach
        settle_passes(stage[STATION], gains, dt / 6.0, T_hot, plant.station.hp.volume, pipes, stage, helium)
    return stage
