"""The whole refrigerator in the rig's compiled loop."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant.helium import Helium, load_helium
from coldloop_plant.numeric import RealArray as Array
from coldloop_refrigerator.physics import BOX_STATES, SIGNALS, Refrigerator
from coldloop_refrigerator.program import RefrigeratorProgram
from coldloop_refrigerator.station_control import StationLaw
from coldloop_refrigerator.tick import ALARMS, MODE, RefrigeratorMemory, advance_tick
from coldloop_rig.cosim.compiled.plants import advances


class RefrigeratorConstants(NamedTuple):
    """The whole refrigerator and its station's controller."""

    plant: Refrigerator
    helium: Helium
    law: StationLaw


class RefrigeratorState(NamedTuple):
    """A refrigerator between two ticks."""

    x: Array
    """States of the cold box, the first 28 of `memory.x`; outputs (22,); the station's signals, mode, alarms (21,)."""
    y: Array
    station: Array
    noise: Array
    """Draws for the sensors, a row for each tick of the trace, shape (N, 22) or (0, 22)."""
    memory: RefrigeratorMemory
    ahead: Array
    """Disturbances at each tick of the trace and at the one behind it, without load, shape (N + 1, 16)."""


@advances(RefrigeratorConstants)
@kernel
def advance_whole(c: RefrigeratorConstants, plant: RefrigeratorState, u: Array, load: float, row: int) -> None:
    """Go one tick forward with a refrigerator."""
    d, inputs = plant.ahead[row], np.empty(3)
    d[0], inputs[:] = load, u
    advance_tick(plant.memory, inputs, d, plant.ahead[row + 1], c.plant, c.helium, c.law)
    plant.y[:] = plant.memory.y
    show_station(plant.memory, plant.station)


@kernel
def show_station(m: RefrigeratorMemory, station: Array) -> None:
    """Write signals, mode and alarms side by side, shape (21,)."""
    for i in range(SIGNALS):
        station[i] = m.signals[i]
    station[SIGNALS] = m.status[MODE]
    station[SIGNALS + 1] = m.status[ALARMS]


class CompiledRefrigerator:
    """The program of a refrigerator."""

    def __init__(self, program: RefrigeratorProgram) -> None:
        self._program = program
        self.constants = RefrigeratorConstants(program.plant, load_helium(), program.law)

    def state(self, noise: Array, ticks: int) -> RefrigeratorState:
        """Return the present state, and what the next `ticks` ticks bring."""
        memory, station = self._program.memory, np.empty(SIGNALS + 2)
        show_station(memory, station)
        y, ahead = np.array(self._program.measure()), self._program.ahead(ticks)
        return RefrigeratorState(memory.x[:BOX_STATES], y, station, noise, memory, ahead)

    def restore(self, state: RefrigeratorState, tick: int, u: Array) -> None:
        """Resume the program at `tick`, up to which the inputs `u` were held."""
        self._program.take_over_whole(tick, u, state.memory, state.y)
