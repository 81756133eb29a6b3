"""The energy account of a refrigerator's cold part, tick by tick: what crosses its boundary, stage by stage."""

from typing import Final

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop.kernels.intrinsics import borrowed, named
from coldloop.process.cold_box import OUTPUT_NAMES
from coldloop_plant.components.phase_separator import start_account
from coldloop_plant.helium import Helium, supply_cell
from coldloop_plant.numeric import RealArray
from coldloop_refrigerator.high_pressure import FIRST, MASS
from coldloop_refrigerator.physics import (
    COIL,
    SIGNAL_NAMES,
    Refrigerator,
    advance_refrigerator,
    evaluate_refrigerator,
)
from coldloop_refrigerator.station_control import EquipmentLaw
from coldloop_refrigerator.tick import act
from tests.harness.refrigerator_energy import refrigerator_energy_rates

CROSSED, SIZE, TO_BATH, WORST = range(4)
"""Places of the sums: energy that crossed the boundary inwards and its absolute sum (J), energy that the bath's rates
brought it (J), and the largest difference between inflow and storage (W)."""
WEIGHTS: Final = np.array([0.25 / 6.0, 0.25 / 3.0, 0.25 / 3.0, 0.25 / 6.0])
AHEAD: Final = np.array([0.125, 0.125, 0.25, 0.0])
"""Steps to the next stages of a tick, s."""
LP, TO_BOX, COMPRESSED = (SIGNAL_NAMES.index(name) for name in ("P11", "M12", "M_NC"))
V1 = OUTPUT_NAMES.index("V1")


@kernel
def accounted_tick(
    x: RealArray,
    y: RealArray,
    signals: RealArray,
    equipment: RealArray,
    u: RealArray,
    v: RealArray,
    d: RealArray,
    plant: Refrigerator,
    helium: Helium,
    law: EquipmentLaw,
    sums: RealArray,
) -> RealArray:
    """Return the state after a tick; `y`, `signals` and `equipment` go on with it, and the sums (4,) of the account.

    What the line gives the passes beyond the flows of the stages crosses the boundary, too.
    """
    slope = np.empty(x.shape[0])
    taken = signals[TO_BOX] / max(signals[COMPRESSED], 0.1)
    acting = act(law, equipment, u, d, signals[LP], taken, y[V1], plant)
    stage, given = x, 0.0
    for k in range(4):
        crossing = evaluate_refrigerator(stage, acting.u, v, acting.d, acting.plant, helium, slope, y, signals)
        stored, inwards = refrigerator_energy_rates(stage, slope, crossing, d[0], acting.plant, helium)
        sums[CROSSED] += WEIGHTS[k] * inwards
        sums[SIZE] += WEIGHTS[k] * abs(inwards)
        sums[TO_BATH] += WEIGHTS[k] * start_account(crossing.bath, slope).heat
        sums[WORST] = max(sums[WORST], abs(stored - inwards))
        given -= WEIGHTS[k] * (crossing.filling.entering - crossing.high.mass_flow)
        if k == 0:
            given -= np.sum(crossing.filling.cells[FIRST:COIL, MASS])
        stage = x + AHEAD[k] * slope
    x = advance_refrigerator(x, acting.u, v, acting.d, 0.25, acting.plant, helium)
    filling = evaluate_refrigerator(x, acting.u, v, acting.d, acting.plant, helium, slope, y, signals).filling
    given += np.sum(filling.cells[FIRST:COIL, MASS])
    T_in = d[1] + plant.station.cooler_approach
    sums[CROSSED] += given * supply_cell(filling.P, T_in, helium.isobar, helium.departure)[0]
    return x


@kernel
def accounted_program_tick(
    x: RealArray,
    y: RealArray,
    signals: RealArray,
    equipment: RealArray,
    u: RealArray,
    v: RealArray,
    d: RealArray,
    plant: object,
    helium: object,
    law: EquipmentLaw,
    sums: RealArray,
) -> RealArray:
    """Do `accounted_tick`; parameters and tables come as `plain_tuples`."""
    return accounted_tick(
        x, y, signals, equipment, u, v, d, named(Refrigerator, plant), named(Helium, borrowed(helium)), law, sums
    )
