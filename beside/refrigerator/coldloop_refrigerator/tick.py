"""One tick of the whole refrigerator: its machinery, its physics and its station's controller, on arrays in place.

The machinery starts compressors, protects the turbine, and holds what is stuck or blocked. What is asked of the cold
box and what is given become what acts: in ordinary operation it is the same, to the bit.
"""

from math import sqrt
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.kernels.intrinsics import PlainTuples, borrowed, named
from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES, P1, TICK_S, V1
from coldloop_plant.cold_box import ColdBox
from coldloop_plant.components.heat_exchanger import HeatExchanger
from coldloop_plant.helium import Helium
from coldloop_plant.numeric import PA_PER_BAR, RealArray
from coldloop_refrigerator import physics, station_control
from coldloop_refrigerator.high_pressure import COLUMNS
from coldloop_refrigerator.physics import DISTURBANCE_NAMES, SIGNAL_NAMES, STATE_NAMES, Refrigerator
from coldloop_refrigerator.station_control import EquipmentLaw, StationLaw
from coldloop_refrigerator.warm import Precooler

GIVEN_NAMES: Final = (
    *DISTURBANCE_NAMES, "HP_noise", "LP_noise", "turbine", "cv155", "cv156", "heater",
    "blocked_nef1", "blocked_nef2", "blocked_nef34", "blocked_nef6",
)  # fmt: skip
"""Names of what is given in a tick: the disturbances; by how much the station's gauges are off (bar); 1 or 0: the
turbine may run, CV155 and CV156 move; the heater, `HEATER_FOLLOWS` or another; how fast exchangers block up (1/h)."""
NC1, NC2, HP_NOISE, LP_NOISE, TURBINE, CV155_MOVES, CV156_MOVES, HEATER, BLOCKING = (
    GIVEN_NAMES.index(name)
    for name in ("NC1", "NC2", "HP_noise", "LP_noise", "turbine", "cv155", "cv156", "heater", "blocked_nef1")
)
HEATER_OFF, HEATER_FOLLOWS, HEATER_ON = range(3)

START, ADMISSION, TRIPPED, CV155, CV156, BLOCKED, ACTING, DEVIATING = 0, 2, 3, 4, 5, 6, 10, 13
LOW_SUCTION: Final = -1.0  # Sentinel for a start: the low pressure has tripped the compressor
EQUIPMENT_SIZE: Final = 14
"""The equipment's memory: how far each compressor's start has come (2, 1 is loaded, -1 tripped by
the low pressure), the share of CV156's opening that
the turbine's governor allows, 1 after an overspeed trip, positions of CV155 and CV156 (%), the blocked share of NEF1,
NEF2, NEF34 and NEF6 (4), the inputs that act on the cold box (3), and 1 where one is not as it is asked."""

FULL_HEATER_W: Final = 150.0  # Power of a heater that is stuck on, W
MOST_BLOCKED: Final = 0.98
CLEAN_DROP_BAR: Final = 0.05
"""Pressure drop of the high-pressure side of each exchanger at the operating point, of which only the rise counts."""
VALVE_DROP_BAR: Final = (14.77, 4.62)  # Pressure drops of CV155 and CV156 at the operating point, bar
NOMINAL_OPENING: Final = (43.0, 36.0)  # %, of CV155 and CV156
GOVERNOR_S: Final = 5.0  # s, in which the governor closes by as much as the speed is too high
LEAST_ADMISSION: Final = 0.002
DEVIATION: Final = 1.0  # % or W between what is asked and what acts, from which on it is alarmed


class Acting(NamedTuple):
    """Inputs and disturbances that act on the plant in a tick."""

    u: RealArray  # Inputs of the cold box, shape (3,)
    d: RealArray  # Disturbances; NC1 and NC2 are the shares that they are to run at
    plant: Refrigerator  # With the exchangers as they are blocked


def resting_equipment(u: RealArray, *, warm: bool = False) -> RealArray:
    """Return the equipment's memory with all in order at the inputs `u` (3,); `warm`: nothing has started."""
    memory = np.zeros(EQUIPMENT_SIZE)
    memory[CV155], memory[CV156] = u[0], u[2]
    if not warm:
        memory[:TRIPPED], memory[ACTING:DEVIATING] = 1.0, u
    return memory


@kernel
def loaded_compressors(memory: RealArray, d: RealArray) -> int:
    """Return how many compressors are switched on and loaded."""
    return int(d[NC1] != 0.0 and memory[START] == 1.0) + int(d[NC2] != 0.0 and memory[START + 1] == 1.0)


@kernel
def act(
    law: EquipmentLaw, memory: RealArray, u: RealArray, d: RealArray, lp: float, taken: float, speed: float,
    plant: Refrigerator,
) -> Acting:  # fmt: skip
    """Return what acts in the tick that begins, where `u` is asked of the cold box and `d` is given (`GIVEN_NAMES`).

    `memory` (14), from `START` on, is overwritten. `lp` is the low pressure (bar), `taken` the share of what the
    compressors give that the cold box takes, `speed` that of the turbine (Hz).
    """
    given = d.copy()
    start_compressors(law, memory, given, lp, taken)
    isolated = loaded_compressors(memory, d) == 0
    runs = govern_turbine(law, memory, d, speed, isolated)
    if d[CV155_MOVES] != 0.0:
        memory[CV155] = u[0]
    if d[CV156_MOVES] != 0.0:
        memory[CV156] = u[2] * memory[ADMISSION]
    for i in range(4):
        blocked = memory[BLOCKED + i] + d[BLOCKING + i] * TICK_S / 3600.0
        memory[BLOCKED + i] = min(max(blocked, 0.0), MOST_BLOCKED)
    heater = FULL_HEATER_W if d[HEATER] == HEATER_ON else (0.0 if d[HEATER] == HEATER_OFF else u[1])
    memory[ACTING] = 0.0 if isolated else memory[CV155]
    memory[ACTING + 1] = 0.0 if isolated else heater
    memory[ACTING + 2] = memory[CV156] if runs else 0.0
    off = max(abs(memory[CV155] - u[0]), abs(memory[CV156] - u[2] * memory[ADMISSION]), abs(heater - u[1]))
    memory[DEVIATING] = 1.0 if off > DEVIATION else 0.0
    inputs = memory[ACTING:DEVIATING].copy()
    warm = further_drop(memory[BLOCKED + 2]) + further_drop(memory[BLOCKED + 3])
    cold = further_drop(memory[BLOCKED]) + further_drop(memory[BLOCKED + 1])
    inputs[0] = throttled(inputs[0], 0, warm + cold)
    inputs[2] = throttled(inputs[2], 1, warm)
    return Acting(inputs, given, blocked_plant(plant, memory))


@kernel
def start_compressors(law: EquipmentLaw, memory: RealArray, d: RealArray, lp: float, taken: float) -> None:
    """Bring starts forward, and write into `d` the shares that both compressors are to run at.

    One starts at a time, NC1 first, and the other when the cold box takes enough for two: the bypass of a warm one
    could not pass the rest. It idles, and is loaded in a ramp; one that is switched off, or tripped by the low
    pressure, stops at once.
    """
    for i in range(2):
        other = memory[START + 1 - i]
        if d[NC1 + i] == 0.0:
            memory[START + i] = 0.0
        elif memory[START + i] > 0.0 and lp < law.trip_lp[i]:
            memory[START + i] = LOW_SUCTION
        elif memory[START + i] > 0.0 or (
            memory[START + i] == 0.0 and lp > law.least_lp and (other <= 0.0 or (other == 1.0 and taken > law.second))
        ):
            memory[START + i] = min(memory[START + i] + TICK_S / (law.idle_s + law.load_s), 1.0)
        come = memory[START + i]
        if come < 1.0:
            loading = max(come * (law.idle_s + law.load_s) - law.idle_s, 0.0) / law.load_s
            d[NC1 + i] = law.idle + (1.0 - law.idle) * loading if come > 0.0 else 0.0


@kernel
def govern_turbine(law: EquipmentLaw, memory: RealArray, d: RealArray, speed: float, isolated: bool) -> bool:  # noqa: FBT001
    """Return whether the turbine's stop valve is open; let the governor move.

    An overspeed trip is held until the turbine is switched off. CV156 opens in a ramp, no further than the governor
    allows: its share changes by its own size in `GOVERNOR_S` where the speed is off by all of the governed one.
    """
    if d[TURBINE] == 0.0:
        memory[TRIPPED] = 0.0
    elif speed > law.overspeed_hz:
        memory[TRIPPED] = 1.0
    if isolated or d[TURBINE] == 0.0 or memory[TRIPPED] != 0.0:
        memory[ADMISSION] = 0.0
        return False
    share = memory[ADMISSION]
    faster = (share + LEAST_ADMISSION) * (1.0 - speed / law.governed_hz) / GOVERNOR_S
    memory[ADMISSION] = min(max(share + TICK_S * min(faster, 1.0 / law.run_up_s), 0.0), 1.0)
    return True


@kernel
def further_drop(blocked: float) -> float:
    """Return by how many times its clean value the pressure drop of an exchanger rises: 1/(1 - b)^2 - 1."""
    free = 1.0 - blocked
    return 1.0 / (free * free) - 1.0


@kernel
def throttled(opening: float, valve: int, drop: float) -> float:
    """Return the opening (%) with which a valve alone passes what it does behind exchangers with a further `drop`.

    Two resistances in series, each with a pressure drop of the square of the flow.
    """
    relative = opening / NOMINAL_OPENING[valve]
    return opening / sqrt(1.0 + CLEAN_DROP_BAR / VALVE_DROP_BAR[valve] * drop * relative * relative)


@kernel
def blocked_plant(plant: Refrigerator, memory: RealArray) -> Refrigerator:
    """Return the plant whose exchangers have lost the blocked share of their heat transfer."""
    box, warm = plant.box, plant.precooler
    cold_box = ColdBox(
        box.separator, box.jt_valve, box.turbine,
        blocked_exchanger(box.nef1, memory[BLOCKED]), blocked_exchanger(box.nef2, memory[BLOCKED + 1]),
        blocked_exchanger(box.nef34, memory[BLOCKED + 2]), box.return_line, box.P_HP, box.P_LP, box.T_in,
    )  # fmt: skip
    precooler = Precooler(blocked_exchanger(warm.nef6, memory[BLOCKED + 3]), warm.nef5, warm.actuator)
    return Refrigerator(cold_box, precooler, plant.station)


@kernel
def blocked_exchanger(exchanger: HeatExchanger, blocked: float) -> HeatExchanger:
    """Return an exchanger without the blocked share of its heat transfer."""
    return HeatExchanger(exchanger.UA * (1.0 - blocked), exchanger.volume, exchanger.aluminium, exchanger.cells)


HP, LP, BUFFER, NITROGEN, LOST = (SIGNAL_NAMES.index(name) for name in ("P12", "P11", "P13", "L_N2", "lost"))
TO_BOX, COMPRESSED = SIGNAL_NAMES.index("M12"), SIGNAL_NAMES.index("M_NC")
CV956, CV952, CV953 = (STATE_NAMES.index(name) for name in ("CV956", "CV952", "CV953"))
BLOCKED_SHARES: Final = len(INPUT_NAMES) + len(DISTURBANCE_NAMES)
ACTED: Final = BLOCKED_SHARES + ACTING - BLOCKED
MODE: Final = 0
ALARMS: Final = 1
LEAST_FLOW: Final = 0.1  # g/s through the compressors, below which none of it counts as taken by the cold box


class RefrigeratorMemory(NamedTuple):
    """State of a refrigerator, which a tick changes."""

    x: RealArray
    """States, shape (48,)."""
    y: RealArray
    """Outputs of the cold box, without noise, shape (22,)."""
    signals: RealArray
    """Signals of the station and the nitrogen bath, shape (19,)."""
    commands: RealArray
    """Openings asked of the warm valves, %, shape (4,)."""
    integrals: RealArray
    """Integrals of the controller, shape (5,): `control_station`."""
    equipment: RealArray
    """Memory of the machinery, shape (14,), from `START` on."""
    status: NDArray[np.int64]
    """Its mode and alarms, shape (2,)."""
    slope: RealArray
    """dx/dt as the sensors were read, shape (48,); the next tick begins with it where the same acts."""
    cells: RealArray
    """`coldloop_refrigerator.high_pressure.Filling.cells` then."""
    acted: RealArray
    """Inputs, disturbances and blocked shares of the exchangers at that time, shape (13,); NaN before any reading."""


def begin_memory(x: RealArray, v: RealArray, equipment: RealArray) -> RefrigeratorMemory:
    """Return a memory at the state `x`, with openings `v` asked and `equipment` as it is; nothing is read yet."""
    return RefrigeratorMemory(
        x, np.zeros(len(OUTPUT_NAMES)), np.zeros(physics.SIGNALS), v, np.zeros(station_control.MEMORY_SIZE), equipment,
        np.zeros(2, np.int64), np.zeros_like(x), np.zeros((physics.COIL + 1, COLUMNS)), np.full(ACTED, np.nan),
    )  # fmt: skip


@kernel
def control_tick(m: RefrigeratorMemory, d: RealArray, law: StationLaw) -> None:
    """Let the controller answer what its sensors show; `d` (16,) holds from the tick on that begins."""
    x, signals, equipment = m.x, m.signals, m.equipment
    measured = station_control.StationMeasurement(
        signals[HP] + d[HP_NOISE], signals[LP] + d[LP_NOISE], signals[BUFFER], x[CV956], x[CV952], x[CV953],
        signals[NITROGEN], signals[LOST], m.y[P1], d[NC1] != 0.0 and equipment[START] >= 0.0,
        d[NC2] != 0.0 and equipment[START + 1] >= 0.0,
        loaded_compressors(equipment, d), d[TURBINE] != 0.0 and equipment[TRIPPED] == 0.0, equipment[TRIPPED] != 0.0,
        equipment[DEVIATING] != 0.0, min(equipment[START], equipment[START + 1]) < 0.0,
    )  # fmt: skip
    m.status[ALARMS] = station_control.raised_alarms(law, measured)
    commands, m.status[MODE] = station_control.control_station(law, m.integrals, measured)
    for i in range(len(commands)):
        m.commands[i] = commands[i]


@kernel
def read_tick(m: RefrigeratorMemory, acting: Acting, helium: Helium) -> None:
    """Write what the sensors show at the state, and how the state moves."""
    u, d = acting.u, acting.d
    crossing = physics.evaluate_refrigerator(m.x, u, m.commands, d, acting.plant, helium, m.slope, m.y, m.signals)
    m.cells[:] = crossing.filling.cells
    m.acted[:] = what_acts(m, acting)


@kernel
def what_acts(m: RefrigeratorMemory, acting: Acting) -> RealArray:
    """Return what the rates of a state depend on besides the commands, shape (13,)."""
    acts = np.empty(ACTED)
    acts[:3], acts[3:BLOCKED_SHARES] = acting.u, acting.d[: BLOCKED_SHARES - 3]
    acts[BLOCKED_SHARES:] = m.equipment[BLOCKED:ACTING]
    return acts


@kernel
def advance_tick(
    m: RefrigeratorMemory, u: RealArray, d: RealArray, ahead: RealArray, plant: Refrigerator, helium: Helium,
    law: StationLaw,
) -> None:  # fmt: skip
    """Go one tick forward, with inputs `u` (3) and `d` (16, `GIVEN_NAMES`) given; `ahead` is d a tick later."""
    taken = m.signals[TO_BOX] / max(m.signals[COMPRESSED], LEAST_FLOW)
    acting = act(law.equipment, m.equipment, u, d, m.signals[LP], taken, m.y[V1], plant)
    if np.all(what_acts(m, acting) == m.acted):
        physics.move_valves(m.x, m.commands, acting.plant, m.slope)
    else:
        read_tick(m, acting, helium)
    P = PA_PER_BAR * m.signals[HP]
    m.x[:] = physics.advance_along(
        m.x, m.slope, m.cells, P, acting.u, m.commands, acting.d, TICK_S, acting.plant, helium
    )
    read_tick(m, acting, helium)
    control_tick(m, ahead, law)


@kernel
def advance_program_tick(
    m: RefrigeratorMemory, u: RealArray, d: RealArray, ahead: RealArray, plant: PlainTuples, helium: PlainTuples,
    law: PlainTuples,
) -> None:  # fmt: skip
    """Do `advance_tick`; parameters, tables and law come as `plain_tuples`."""
    advance_tick(m, u, d, ahead, named(Refrigerator, plant), named(Helium, borrowed(helium)), named(StationLaw, law))
