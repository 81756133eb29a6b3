"""The operating point: the state at rest for given inputs and level, and the load that goes with it."""

from typing import NamedTuple

import numpy as np

from coldloop_plant.cold_box.linearisation import state_and_load_jacobian, state_scales
from coldloop_plant.cold_box.physics import ColdBox, derivative, outputs
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.helium.properties import Helium
from coldloop_plant.integrator import advance
from coldloop_plant.numeric import RealArray

RELAXATION_S = 3000.0
RELAXATION_STEP_S = 0.5
LEVEL_GAIN = 100.0  # W of load per % of level, while relaxing, for the CV155 of the reference plant
TOLERANCE = 1e-10  # scaled units per second
MAX_NEWTON_STEPS = 30


class Equilibrium(NamedTuple):
    """A state at rest."""

    x: RealArray
    """Shape (28,)."""
    u: RealArray
    """Shape (3,)."""
    w: float
    """W."""
    y: RealArray
    """Shape (22,)."""
    residual: float
    """Largest |dx/dt|, in units of 2 kPa, 1 % of level and 1 K, per second."""


class NoEquilibriumError(ValueError):
    """The cold box does not come to rest under these inputs."""


def find_equilibrium(u: RealArray, level: float, box: ColdBox, helium: Helium) -> Equilibrium:
    """Return the state at which the cold box rests under `u` with the bath at `level` (%).

    The load is the unknown that replaces the liquid volume. The plant first relaxes in simulated time, with the load
    holding the level; Newton's method does the rest.

    Raises:
        NoEquilibriumError: Newton's method does not converge, for instance beyond the capacity maximum.
    """
    x, w = relaxed(u, level, box, helium)
    return rest_near(x, w, u, box, helium)


def rest_near(x: RealArray, w: float, u: RealArray, box: ColdBox, helium: Helium) -> Equilibrium:
    """Return the state of rest under `u` that Newton's method finds from (x, w), with the level of x.

    Raises:
        NoEquilibriumError: It does not converge.
    """
    scales = state_scales(box)
    for _ in range(MAX_NEWTON_STEPS):
        dx = derivative(x, u, w, box, helium)
        residual = float(np.max(np.abs(dx / scales)))
        if residual < TOLERANCE:
            return Equilibrium(x, u, w, outputs(x, u, w, box, helium), residual)
        by_state, by_load = state_and_load_jacobian(x, u, w, box, helium)
        by_state[:, 1] = by_load  # the level is given, the load is not
        try:
            step = np.linalg.solve(by_state, -dx)
        except np.linalg.LinAlgError:
            break
        w += float(step[1])
        step[1] = 0.0
        x = x + step
    raise NoEquilibriumError(f"no equilibrium at u = {u.tolist()}: the residual stays at {residual:.2g} per second")


def relaxed(
    u: RealArray, level: float, box: ColdBox, helium: Helium, start: RealArray | None = None
) -> tuple[RealArray, float]:
    """Return a state near the equilibrium under `u` with the bath at `level` (%), and its load (W)."""
    x = first_guess(level, box) if start is None else start
    volume = level / 100.0 * box.separator.volume
    size = box.jt_valve.flow_area / REFERENCE.jt_valve.flow_area
    w = 0.0
    for _ in range(round(RELAXATION_S / RELAXATION_STEP_S)):
        w = size * (LEVEL_GAIN * 100.0 * (x[1] - volume) / box.separator.volume + 400.0)
        x = advance(x, u, w, RELAXATION_STEP_S, box, helium)
    x[1] = volume
    return x, float(w)


def first_guess(level: float, box: ColdBox) -> RealArray:
    """Return the state from which the search sets out, with the bath at `level` (%)."""
    nef1 = np.linspace(9.5, 4.5, box.nef1.cells)
    nef2 = np.linspace(18.0, 10.0, box.nef2.cells)
    nef34 = np.linspace(box.T_in - 5.0, 19.0, box.nef34.cells)
    return np.concatenate([[box.P_LP + 0.18e5, level / 100.0 * box.separator.volume], nef1, nef2, nef34])
