"""The refrigerator's operating point: the state at rest at given pressures, levels and inputs.

Unknown beside the states are the load, the opening of the bypass and that of the nitrogen feed; in their place the
levels, the two pressures and the buffer's content are given; the mass of the high-pressure side follows from its
pressure and the temperatures of the passes. The mass of the whole circuit is constant, so one equation follows from the
others, and the steps of Newton's method are those of least squares.
"""

from math import isfinite
from typing import Final, NamedTuple

import numpy as np

from coldloop.process.cold_box import OUTPUT_NAMES
from coldloop_plant.cold_box.equilibrium import Equilibrium, NoEquilibriumError
from coldloop_plant.components.gas_volume import GasVolume, gas_mass
from coldloop_plant.components.nitrogen_bath import LIQUID_DENSITY
from coldloop_plant.helium.properties import Helium
from coldloop_plant.numeric import RealArray
from coldloop_plant.refrigerator.linearisation import jacobian, rate_scales
from coldloop_plant.refrigerator.physics import (
    COMMAND_NAMES,
    DISTURBANCE_NAMES,
    SIGNAL_NAMES,
    STATE_NAMES,
    Refrigerator,
    advance_refrigerator,
    high_pressure_mass,
    rates,
    read,
)

P_BUFFER: Final = 6e5
AMBIENT: Final = 300.0
NITROGEN_LEVEL: Final = 60.0
TOLERANCE: Final = 1e-10
MAX_STEPS: Final = 60
LONGEST_STEP_K: Final = 10.0
RELAXATION_S, RELAXATION_STEP_S = 5000.0, 0.25
LARGE_LINE: Final = GasVolume(1e6)
"""In which nothing changes the pressure."""

V_L, M_HP, M_LP, M_BUFFER, M_LOST, M_N2 = (
    STATE_NAMES.index(name) for name in ("V_l", "M_HP", "M_LP", "M_buffer", "M_lost", "M_N2")
)
CV956, CV167 = STATE_NAMES.index("CV956"), STATE_NAMES.index("CV167")
AS_ASKED: Final = tuple(STATE_NAMES.index(name) for name in ("NC1", "NC2", "CV952", "CV953"))
"""Compressors run, and both valves of the buffer are shut, to the bit."""
GIVEN: Final = (V_L, M_LP, M_BUFFER, M_LOST, M_N2, *AS_ASKED)
P12: Final = len(STATE_NAMES) + len(OUTPUT_NAMES) + SIGNAL_NAMES.index("P12")
"""Row of the Jacobian that is that of the high pressure."""
BYPASS_FLOW: Final = SIGNAL_NAMES.index("M_CV956")


class Rest(NamedTuple):
    """The refrigerator at rest."""

    x: RealArray
    """Shape (48,)."""
    u: RealArray
    """Shape (3,)."""
    v: RealArray
    """Shape (4,)."""
    d: RealArray
    """Shape (6,)."""
    y: RealArray
    """Shape (22,)."""
    signals: RealArray
    """Shape (19,)."""
    residual: float
    """Largest |dx/dt| in units of `rate_scales`, per second."""


def find_refrigerator_equilibrium(
    cold: Equilibrium, plant: Refrigerator, helium: Helium, P_buffer: float = P_BUFFER
) -> Rest:
    """Return the rest of `plant` at the cold box's inputs and level, near the rest `cold` of the cold box alone.

    Supply and suction pressure are the cold box's boundaries, `P_buffer` (Pa) is that of the buffer.

    Raises:
        NoEquilibriumError: Newton's method does not converge.
    """
    start = first_guess(cold, plant, helium, P_buffer)
    d = np.array([cold.w, AMBIENT, 0.0, 1.0, 1.0, 1.0])
    v = np.array([start[CV956], 0.0, 0.0, start[CV167]])
    x = _relaxed(start.copy(), cold.u, v, d, plant, helium)
    x[CV956] = v[0] = _balancing_bypass(x, cold.u, v, d, plant, helium)
    free = [i for i in range(len(STATE_NAMES)) if i not in (*GIVEN, M_HP)]
    scales = rate_scales(plant)
    for _ in range(MAX_STEPS):
        dx = rates(x, cold.u, v, d, plant, helium) / scales
        residual = float(np.max(np.abs(dx)))
        if residual < TOLERANCE:
            return Rest(x, cold.u, v, d, *read(x, cold.u, v, d, plant, helium), residual)
        if not isfinite(residual):
            break
        J = _at_constant_pressure(jacobian(x, cold.u, v, d, plant, helium))[: len(STATE_NAMES)] / scales[:, np.newaxis]
        load = len(STATE_NAMES) + 3 + len(COMMAND_NAMES) + DISTURBANCE_NAMES.index("NCR22_HL")
        bypass, feed = len(STATE_NAMES) + 3, len(STATE_NAMES) + 6
        step = np.linalg.lstsq(J[:, [*free, load, bypass, feed]], -dx, rcond=1e-13)[0]
        temperatures = [k for k, i in enumerate(free) if STATE_NAMES[i].startswith("T_")]
        step *= min(1.0, LONGEST_STEP_K / float(np.max(np.abs(step[temperatures]))))
        x, v, d = x.copy(), v.copy(), d.copy()
        x[free] += step[:-3]
        x[M_HP] = high_pressure_mass(x, plant.box.P_HP, AMBIENT, plant, helium)
        d[0] += step[-3]
        v[0], v[3] = v[0] + step[-2], v[3] + step[-1]
    raise NoEquilibriumError(f"the refrigerator has no equilibrium: the residual stays at {residual:.2g} per second")


def _balancing_bypass(
    x: RealArray, u: RealArray, v: RealArray, d: RealArray, plant: Refrigerator, helium: Helium
) -> float:
    """Return the opening (%) with which the high-pressure side keeps its mass; else it works on the passes."""
    _, signals = read(x, u, v, d, plant, helium)
    surplus = 1e3 * rates(x, u, v, d, plant, helium)[M_HP]
    return max(0.0, float(x[CV956] * (1.0 + surplus / signals[BYPASS_FLOW])))


def _at_constant_pressure(J: RealArray) -> RealArray:
    """Return the Jacobian where the mass of the high-pressure side follows the temperatures, its pressure given."""
    follows = -J[P12] / J[P12, M_HP]
    return J + np.outer(J[:, M_HP], follows)


def _relaxed(x: RealArray, u: RealArray, v: RealArray, d: RealArray, plant: Refrigerator, helium: Helium) -> RealArray:
    """Return the state after a time in which what is given is held.

    In the place of the two lines are very large ones, so that their pressures stay whatever enters and leaves, and no
    work of the pressure warms the passes.
    """
    large = plant._replace(station=plant.station._replace(hp=LARGE_LINE, lp=LARGE_LINE))
    held = [*GIVEN, M_HP]
    in_low_pressure_line = x[M_LP]
    x[M_HP] = high_pressure_mass(x, plant.box.P_HP, AMBIENT, large, helium)
    x[M_LP] = gas_mass(LARGE_LINE, plant.box.P_LP, AMBIENT)
    given = x[held]
    for _ in range(round(RELAXATION_S / RELAXATION_STEP_S)):
        x = advance_refrigerator(x, u, v, d, RELAXATION_STEP_S, large, helium)
        x[held] = given
    x[M_LP] = in_low_pressure_line
    x[M_HP] = high_pressure_mass(x, plant.box.P_HP, AMBIENT, plant, helium)
    return x


def first_guess(cold: Equilibrium, plant: Refrigerator, helium: Helium, P_buffer: float) -> RealArray:
    """Return the state from which the search sets out."""
    station, precooler = plant.station, plant.precooler
    hot = AMBIENT + station.cooler_approach
    nitrogen = NITROGEN_LEVEL / 100.0 * precooler.nef5.volume * LIQUID_DENSITY
    masses = [
        0.0,
        gas_mass(station.lp, plant.box.P_LP, AMBIENT),
        gas_mass(station.buffer, P_buffer, AMBIENT),
    ]
    exchanger = np.linspace(hot - 25.0, 84.0, precooler.nef6.cells)
    x = np.concatenate([cold.x, exchanger, [80.0, nitrogen, 30.0], masses, [0.0, 1.0, 1.0, 25.0, 0.0, 0.0]])
    x[M_HP] = high_pressure_mass(x, plant.box.P_HP, AMBIENT, plant, helium)
    return x
