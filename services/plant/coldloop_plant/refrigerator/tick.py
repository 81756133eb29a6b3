"""One tick of the whole refrigerator with its station's controller, on arrays that are overwritten."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.borrowing import borrowed
from coldloop.kernels.compiled import kernel
from coldloop.kernels.named import named
from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES, P1, TICK_S, V1
from coldloop_plant.components.passes import COLUMNS
from coldloop_plant.helium.properties import Helium
from coldloop_plant.numeric import PA_PER_BAR, RealArray
from coldloop_plant.refrigerator.equipment import (
    ACTING,
    BLOCKED,
    DEVIATING,
    HP_NOISE,
    LP_NOISE,
    NC1,
    NC2,
    START,
    TRIPPED,
    TURBINE,
    Acting,
    act,
    loaded_compressors,
)
from coldloop_plant.refrigerator.physics import (
    COIL,
    DISTURBANCE_NAMES,
    SIGNAL_NAMES,
    SIGNALS,
    STATE_NAMES,
    Refrigerator,
    advance_along,
    evaluate_refrigerator,
    move_valves,
)
from coldloop_plant.refrigerator.station_law import (
    MEMORY_SIZE,
    StationLaw,
    StationMeasurement,
    control_station,
    raised_alarms,
)

HP, LP, BUFFER, NITROGEN, LOST = (SIGNAL_NAMES.index(name) for name in ("P12", "P11", "P13", "L_N2", "lost"))
TO_BOX, COMPRESSED = SIGNAL_NAMES.index("M12"), SIGNAL_NAMES.index("M_NC")
CV956, CV952, CV953 = (STATE_NAMES.index(name) for name in ("CV956", "CV952", "CV953"))
BLOCKED_SHARES: Final = len(INPUT_NAMES) + len(DISTURBANCE_NAMES)
ACTED: Final = BLOCKED_SHARES + ACTING - BLOCKED
MODE: Final = 0
ALARMS: Final = 1
LEAST_FLOW: Final = 0.1
"""g/s through the compressors, below which none of it counts as taken by the cold box."""


class RefrigeratorMemory(NamedTuple):
    """What a tick changes."""

    x: RealArray
    """States, shape (48,)."""
    y: RealArray
    """Outputs of the cold box, without noise, shape (22,)."""
    signals: RealArray
    """Of the station and the nitrogen bath, shape (19,)."""
    commands: RealArray
    """Openings asked of the warm valves, %, shape (4,)."""
    integrals: RealArray
    """Of the controller, shape (5,): `coldloop_plant.refrigerator.station_law.control_station`."""
    equipment: RealArray
    """Memory of the machinery, shape (14,): `coldloop_plant.refrigerator.equipment`."""
    status: NDArray[np.int64]
    """Its mode and alarms, shape (2,)."""
    slope: RealArray
    """dx/dt as the sensors were read, shape (48,); the next tick begins with it where the same acts."""
    cells: RealArray
    """`coldloop_plant.refrigerator.high_pressure.Filling.cells` then."""
    acted: RealArray
    """What acted then, shape (13,): inputs, disturbances, blocked shares of the exchangers; NaN before any reading."""


def begin_memory(x: RealArray, v: RealArray, equipment: RealArray) -> RefrigeratorMemory:
    """Return a memory at the state `x`, with openings `v` asked and `equipment` as it is; nothing is read yet."""
    return RefrigeratorMemory(
        x, np.zeros(len(OUTPUT_NAMES)), np.zeros(SIGNALS), v, np.zeros(MEMORY_SIZE), equipment, np.zeros(2, np.int64),
        np.zeros_like(x), np.zeros((COIL + 1, COLUMNS)), np.full(ACTED, np.nan),
    )  # fmt: skip


@kernel
def control_tick(m: RefrigeratorMemory, d: RealArray, law: StationLaw) -> None:
    """Let the controller answer what its sensors show; `d` (16,) holds from the tick on that begins."""
    x, signals, equipment = m.x, m.signals, m.equipment
    measured = StationMeasurement(
        signals[HP] + d[HP_NOISE], signals[LP] + d[LP_NOISE], signals[BUFFER], x[CV956], x[CV952], x[CV953],
        signals[NITROGEN], signals[LOST], m.y[P1], d[NC1] != 0.0 and equipment[START] >= 0.0,
        d[NC2] != 0.0 and equipment[START + 1] >= 0.0,
        loaded_compressors(equipment, d), d[TURBINE] != 0.0 and equipment[TRIPPED] == 0.0, equipment[TRIPPED] != 0.0,
        equipment[DEVIATING] != 0.0, min(equipment[START], equipment[START + 1]) < 0.0,
    )  # fmt: skip
    m.status[ALARMS] = raised_alarms(law.alarms, measured)
    commands, m.status[MODE] = control_station(law, m.integrals, measured)
    for i in range(len(commands)):
        m.commands[i] = commands[i]


@kernel
def read_tick(m: RefrigeratorMemory, acting: Acting, helium: Helium) -> None:
    """Write what the sensors show at the state, and how the state moves."""
    u, d = acting.u, acting.d
    crossing = evaluate_refrigerator(m.x, u, m.commands, d, acting.plant, helium, m.slope, m.y, m.signals)
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
    """Go one tick forward.

    Args:
        m: State, overwritten.
        u: Inputs of the cold box, shape (3,).
        d: What is given during the tick, shape (16,): `coldloop_plant.refrigerator.equipment.GIVEN_NAMES`.
        ahead: Those of the next tick.
        plant: Parameters.
        helium: Tables.
        law: Of the station's controller.
    """
    taken = m.signals[TO_BOX] / max(m.signals[COMPRESSED], LEAST_FLOW)
    acting = act(law.equipment, m.equipment, u, d, m.signals[LP], taken, m.y[V1], plant)
    if np.all(what_acts(m, acting) == m.acted):
        move_valves(m.x, m.commands, acting.plant, m.slope)
    else:
        read_tick(m, acting, helium)
    P = PA_PER_BAR * m.signals[HP]
    m.x[:] = advance_along(
        m.x, m.slope, m.cells, P, acting.u, m.commands, acting.d, TICK_S, acting.plant, helium
    )  # fmt: skip
    read_tick(m, acting, helium)
    control_tick(m, ahead, law)


@kernel
def advance_program_tick(
    m: RefrigeratorMemory,
    u: RealArray,
    d: RealArray,
    ahead: RealArray,
    plant: Any,  # noqa: ANN401 - any nesting of tuples
    helium: Any,  # noqa: ANN401 - any nesting of tuples
    law: Any,  # noqa: ANN401 - any nesting of tuples
) -> None:
    """Do `advance_tick`; parameters, tables and law come as `plain_tuples`."""
    advance_tick(m, u, d, ahead, named(Refrigerator, plant), named(Helium, borrowed(helium)), named(StationLaw, law))
