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
from coldloop_refrigerator import high_pressure as passes
from coldloop_refrigerator import warm
from coldloop_refrigerator.warm import Precooler, gas_pressure, station_rates

BOX_STATES: Final = len(cold_box.STATE_NAMES)
STATION: Final = BOX_STATES + len(warm.PRECOOLER_STATES)  # Index of the station's first state; CV167 is before it
VALVES: Final = STATION + warm.STATION_STATES.index("CV956")
"""Index of the first of the station's valves, in the order of `COMMAND_NAMES`."""
COIL: Final = BOX_STATES + warm.PRECOOLER_STATES.index("T_nef5")  # Index of the last state of the high-pressure passes
STATE_NAMES: Final = (*cold_box.STATE_NAMES, *warm.PRECOOLER_STATES, *warm.STATION_STATES)
STATE_UNITS: Final = (*cold_box.STATE_UNITS, *warm.PRECOOLER_STATE_UNITS, *warm.STATION_STATE_UNITS)
COMMAND_NAMES: Final = cold_box.STATION_VALVE_NAMES
DISTURBANCE_NAMES: Final = ("NCR22_HL", "T_ambient", "leak", "nitrogen", "NC1", "NC2")
"""Heat load (W), ambient temperature (K), leak at 16 bar (kg/s); 0 or 1: nitrogen in the tank, compressors to run."""

SIGNAL_NAMES: Final = cold_box.STATION_SIGNAL_NAMES
SIGNALS: Final = len(SIGNAL_NAMES)


class Refrigerator(NamedTuple):
    """Components of the refrigerator, in SI units; `refrigerator.plant_file` has the reference plant's."""

    box: ColdBox  # Its boundaries P_HP and P_LP are the pressures at rest; the equations do not read them, nor T_in
    precooler: Precooler
    station: warm.CompressionStation


class Crossing(NamedTuple):
    """Streams over the boundary of the cold part, and within it."""

    high: HighPressureFlow
    """Through CV155 and CV156, as it would come from the compressors, were nothing stored on the way."""
    filling: passes.Filling
    """Flows of helium into and out of line and passes."""
    cold: Streams
    """Streams of the cold box."""
    leaving: LowPressureFlow
    """Low-pressure flow from the cold box to NEF6."""
    relief: float
    """Flow from the bath into the recovery line, kg/s."""
    bath: Content
    """Content of the bath."""
    cooling: warm.Precooling
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
    pipes = passes.piped(box, precooler)
    held = passes.read_passes(x, pipes, helium)
    T_hot = d[1] + station.cooler_approach
    HP = passes.side_pressure(station.hp.volume, x[STATION], T_hot, held.mass)
    LP, P_buffer = gas_pressure(station.lp, x[STATION + 1], d[1]), gas_pressure(station.buffer, x[STATION + 2], d[1])
    joined = ColdBox(
        box.separator, box.jt_valve, box.turbine, box.nef1, box.nef2, box.nef34, box.return_line, HP, LP,
        x[pipes.coil],
    )  # fmt: skip
    inputs = u if d[4].real + d[5].real > 0.0 else 0.0 * u
    cold, leaving, relief, bath = evaluate(
        x[:BOX_STATES], inputs, d[0], joined, helium, dx[:BOX_STATES], y, is_supply_held=False
    )
    high = HighPressureFlow(cold.m_jt + cold.m_t, T_hot, HP)
    station_rates(
        x[STATION:], HP, LP, P_buffer, high.mass_flow, leaving.mass_flow, d[1], d[2], d[4:].real, station,
        dx[STATION:], signals[6:],
    )  # fmt: skip
    filling, cooling = passes.fill_passes(
        HP, dx[STATION], T_hot, cold, leaving, station.hp.volume, pipes, held, helium, x, d[3], dx
    )
    dx[STATION + 3] += relief
    move_valves(x, v, plant, dx)
    signals[0], signals[1], signals[2] = LP / PA_PER_BAR, HP / PA_PER_BAR, P_buffer / PA_PER_BAR
    signals[3], signals[4] = cooling.warm_end.T, x[pipes.coil - 1]
    signals[5] = 1e3 * filling.entering
    signals[10] += 1e3 * relief
    signals[13], signals[14] = warm.nitrogen_level(precooler.nef5, x[pipes.coil + 1]), x[pipes.coil + 2]
    signals[15], signals[16] = 1e3 * cooling.boiling.boil_off, inventory(x, plant, helium)
    signals[17], signals[18] = x[STATION + 3], d[1]
    return Crossing(high, filling, cold, leaving, relief, bath, cooling, inputs[1])


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
    held = passes.read_passes(x, passes.piped(plant.box, plant.precooler), helium)
    mass, _ = passes.side_mass(plant.station.hp.volume, P, T_ambient + plant.station.cooler_approach, held.mass)
    return mass


@kernel
def evaluated(
    x: Array, u: Array, v: Array, d: Array, plant: Refrigerator, helium: Helium
) -> tuple[Array, Array, Array]:
    """Return dx/dt (48,) in `STATE_UNITS` per second, the outputs of the cold box (22,) and the warm signals (19,)."""
    dx, y, signals = np.empty_like(x), np.empty(OUTPUTS, x.dtype), np.empty(SIGNALS, x.dtype)
    evaluate_refrigerator(x, u, v, d, plant, helium, dx, y, signals)
    return dx, y, signals


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
    gains = passes.start_gains(cells)
    swing: float = 0.0
    for i in range(n):
        stages[0, i] = x[i]
        total[i] = first[i]
        stage[i] = x[i] + 0.5 * dt * first[i]
    for k, weight, ahead in ((1, 2.0, 0.5), (2, 2.0, 1.0), (3, 1.0, 0.0)):
        crossing = evaluate_refrigerator(stage, u, v, d, plant, helium, slope, y, signals)
        account = add_to_account(account, crossing.bath, slope, weight)
        passes.add_gains(gains, crossing.filling.cells, weight)
        swing = max(swing, abs(crossing.filling.P - P))
        for i in range(n):
            stages[k, i] = stage[i]
            total[i] += weight * slope[i]
            stage[i] = x[i] + (ahead * dt * slope[i] if k < 3 else dt / 6.0 * total[i])
    settle_account(plant.box.separator, account, dt / 6.0, stage, helium)
    pipes = passes.piped(plant.box, plant.precooler)
    if (
        swing > passes.COARSE_PRESSURE
        or passes.COARSE_CELL < widest_move(stages, stage, passes.FIRST, pipes.coil) < WILD
    ):
        T_hot = d[1] + plant.station.cooler_approach
        passes.settle_passes(stage[STATION], gains, dt / 6.0, T_hot, plant.station.hp.volume, pipes, stage, helium)
    return stage
