"""One tick of the whole refrigerator with its station's controller, on arrays that are overwritten."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.process.signals import OUTPUT_NAMES, TICK_S
from plant.helium.properties import Helium, helium_of
from plant.numeric import RealArray
from plant.refrigerator.equipment import (
    DEVIATING,
    HP_NOISE,
    LP_NOISE,
    NC1,
    NC2,
    TRIPPED,
    TURBINE,
    Acting,
    act,
    loaded_compressors,
)
from plant.refrigerator.physics import (
    SIGNAL_NAMES,
    STATE_NAMES,
    Refrigerator,
    advance_refrigerator,
    evaluate_refrigerator,
    refrigerator_of,
)
from plant.refrigerator.station_law import StationLaw, StationMeasurement, control_station, raised_alarms

HP, LP, BUFFER, NITROGEN, LOST = (SIGNAL_NAMES.index(name) for name in ("P12", "P11", "P13", "L_N2", "lost"))
TO_BOX, COMPRESSED = SIGNAL_NAMES.index("M12"), SIGNAL_NAMES.index("M_NC")
CV956, CV952, CV953 = (STATE_NAMES.index(name) for name in ("CV956", "CV952", "CV953"))
P1, V1 = OUTPUT_NAMES.index("P1"), OUTPUT_NAMES.index("V1")
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
    """Of the controller, shape (5,): `plant.refrigerator.station_law.control_station`."""
    equipment: RealArray
    """Memory of the machinery, shape (14,): `plant.refrigerator.equipment`."""
    status: NDArray[np.int64]
    """Its mode and alarms, shape (2,)."""


@kernel
def control_tick(m: RefrigeratorMemory, d: RealArray, law: StationLaw) -> None:
    """Let the controller answer what its sensors show; `d` (16,) holds from the tick on that begins."""
    x, signals, equipment = m.x, m.signals, m.equipment
    measured = StationMeasurement(
        signals[HP] + d[HP_NOISE], signals[LP] + d[LP_NOISE], signals[BUFFER], x[CV956], x[CV952], x[CV953],
        signals[NITROGEN], signals[LOST], m.y[P1], d[NC1] != 0.0, d[NC2] != 0.0,
        loaded_compressors(equipment, d), d[TURBINE] != 0.0 and equipment[TRIPPED] == 0.0, equipment[TRIPPED] != 0.0,
        equipment[DEVIATING] != 0.0,
    )  # fmt: skip
    m.status[ALARMS] = raised_alarms(law.alarms, measured)
    commands, m.status[MODE] = control_station(law, m.integrals, measured)
    for i in range(len(commands)):
        m.commands[i] = commands[i]


@kernel
def read_tick(m: RefrigeratorMemory, acting: Acting, helium: Helium) -> None:
    """Write what the sensors show at the state."""
    dx = np.empty_like(m.x)
    evaluate_refrigerator(m.x, acting.u, m.commands, acting.d, acting.plant, helium, dx, m.y, m.signals)


@kernel
def advance_tick(
    m: RefrigeratorMemory, u: RealArray, d: RealArray, ahead: RealArray, plant: Refrigerator, helium: Helium,
    law: StationLaw,
) -> None:  # fmt: skip
    """Go one tick forward.

    Args:
        m: State, overwritten.
        u: Inputs of the cold box, shape (3,).
        d: What is given during the tick, shape (16,): `plant.refrigerator.equipment.GIVEN_NAMES`.
        ahead: Those of the next tick.
        plant: Parameters.
        helium: Tables.
        law: Of the station's controller.
    """
    taken = m.signals[TO_BOX] / max(m.signals[COMPRESSED], LEAST_FLOW)
    acting = act(law.equipment, m.equipment, u, d, m.signals[LP], taken, m.y[V1], plant)
    m.x[:] = advance_refrigerator(m.x, acting.u, m.commands, acting.d, TICK_S, acting.plant, helium)
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
    law: StationLaw,
) -> None:
    """Do `advance_tick`; parameters and tables come as `plain_tuples`."""
    advance_tick(m, u, d, ahead, refrigerator_of(plant), helium_of(helium), law)
