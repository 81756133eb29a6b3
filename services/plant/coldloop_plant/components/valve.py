"""Control valve with a linear characteristic and incompressible flow; `gas_valve` has the compressible ones."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined
from coldloop_plant.numeric import at_least, at_most


class Valve(NamedTuple):
    """A control valve."""

    flow_area: float
    """Effective area when fully open, m2."""


@inlined
def effective_area(valve: Valve, opening: float) -> float:
    """Return the effective area (m2) at `opening` (%), which saturates at 0 and 100 %."""
    return valve.flow_area * at_most(at_least(opening, 0.0), 100.0) / 100.0


@inlined
def valve_mass_flow(valve: Valve, opening: float, density: float, P_in: float, P_out: float) -> float:
    """Return m = K u sqrt(2 rho (P_in - P_out)) in kg/s; no flow against the pressure."""
    mass_flux: float = np.sqrt(2.0 * density * at_least(P_in - P_out, 0.0))
    return effective_area(valve, opening) * mass_flux
