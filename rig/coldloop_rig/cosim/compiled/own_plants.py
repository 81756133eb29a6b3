"""The linear plants of other processes in the compiled loop; those of a Python class or an FMU have no kernels."""

from typing import Any, NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant import own_plants as plants
from coldloop_rig.cosim.compiled.plants import advances
from coldloop_rig.cosim.compiled.records import Array

Linear = plants.LinearPlant | plants.TransferFunctionPlant


class OwnState(NamedTuple):
    """A linear plant, or lags, between two ticks."""

    x: Array
    y: Array
    station: Array
    noise: Array
    met: Array
    """Disturbances beside the load at each tick of the trace and at the one behind it, shape (N + 1, k)."""
    memory: Any
    """Memory of the lags, shared with the program; () for other plants."""
    first: int
    """Tick of the trace's first row."""


@advances(plants.Matrices)
@kernel
def advance_undelayed(c: plants.Matrices, plant: OwnState, u: Array, load: float, row: int) -> None:
    """Go one tick forward with a linear plant."""
    plants.advance_linear(c, plant.x, u, load, plant.met[row + 1], plant.y)


@advances(plants.LagTable)
@kernel
def advance_delayed(c: plants.LagTable, plant: OwnState, u: Array, load: float, row: int) -> None:
    """Go one tick forward with lags, and with disturbances as the last states and outputs."""
    now, then, own = plant.met[row], plant.met[row + 1], plant.y.shape[0] - c.measured.shape[0]
    w = np.empty(1 + now.shape[0])
    w[0], w[1:] = load, now
    plants.advance_lags(c, plant.memory, plant.first + row, u, w, plant.y[:own])
    plant.x[plant.x.shape[0] - then.shape[0] :] = then
    for i in range(c.measured.shape[0]):
        plant.y[own + i] = then[c.measured[i]]


class CompiledOwn:
    """The program of either."""

    def __init__(self, program: Linear) -> None:
        self._program = program
        self.constants = program.constants

    def state(self, noise: Array, ticks: int) -> OwnState:
        """Return the present state, and what the next `ticks` ticks bring."""
        p = self._program
        x, y, met = np.array(p.state), np.array(p.measure()), p.disturbances.ahead(p.tick, ticks)
        memory = p.memory if isinstance(p, plants.TransferFunctionPlant) else ()
        return OwnState(x, y, np.empty(0), noise, met, memory, p.tick)

    def restore(self, state: OwnState, tick: int, u: Array) -> None:
        """Resume the program at `tick`, up to which the inputs `u` were held."""
        self._program.take_over(tick, state.x, u, state.y)
