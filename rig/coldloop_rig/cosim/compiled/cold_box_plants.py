"""The cold box alone and the whole refrigerator in the compiled loop."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop.process.cold_box import TICK_S
from coldloop_plant.cold_box.physics import ColdBox, advance_along, evaluate
from coldloop_plant.cold_box.program import ColdBoxProgram
from coldloop_plant.helium.properties import Helium, load_helium
from coldloop_plant.program import PlantProgram
from coldloop_plant.refrigerator.physics import BOX_STATES, SIGNALS, Refrigerator
from coldloop_plant.refrigerator.program import RefrigeratorProgram
from coldloop_plant.refrigerator.station_control import StationLaw
from coldloop_plant.refrigerator.tick import ALARMS, MODE, RefrigeratorMemory, advance_tick
from coldloop_rig.cosim.compiled.plants import CompiledPlant, advances
from coldloop_rig.cosim.compiled.records import Array


class BoxConstants(NamedTuple):
    """A cold box alone."""

    box: ColdBox
    helium: Helium


class BoxState(NamedTuple):
    """A cold box alone between two ticks."""

    x: Array
    """Shape (28,)."""
    y: Array
    """Outputs, shape (22,)."""
    station: Array
    """Nothing, shape (0,)."""
    noise: Array
    """Draws for the sensors, a row for each tick of the trace, shape (N, 22) or (0, 22)."""
    slope: Array
    """dx/dt at x under `held`, shape (28,)."""
    held: Array
    """Inputs and load of the tick before, shape (4,); NaN where they are not known."""


class RefrigeratorConstants(NamedTuple):
    """The whole refrigerator and its station's controller."""

    plant: Refrigerator
    helium: Helium
    law: StationLaw


class RefrigeratorState(NamedTuple):
    """A refrigerator between two ticks."""

    x: Array
    """States of the cold box, the first 28 of `memory.x`."""
    y: Array
    """Array as in `BoxState`."""
    station: Array
    """Signals, mode and alarms of the station, shape (21,)."""
    noise: Array
    """Array as in `BoxState`."""
    memory: RefrigeratorMemory
    ahead: Array
    """Disturbances at each tick of the trace and at the one behind it, without load, shape (N + 1, 16)."""


@advances(BoxConstants)
@kernel
def advance_box(c: BoxConstants, plant: BoxState, u: Array, load: float, row: int) -> None:  # noqa: ARG001 others use it
    """Go one tick forward with a cold box alone; its slope is known where inputs and load stand."""
    held = plant.held[3] == load
    for i in range(3):
        held = held and plant.held[i] == u[i]
        plant.held[i] = u[i]
    plant.held[3] = load
    inputs = plant.held[:3]
    if not held:
        evaluate(plant.x, inputs, load, c.box, c.helium, plant.slope, plant.y)
    plant.x[:] = advance_along(plant.x, plant.slope, inputs, load, TICK_S, c.box, c.helium)
    evaluate(plant.x, inputs, load, c.box, c.helium, plant.slope, plant.y)


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


class CompiledBox:
    """A cold box alone."""

    def __init__(self, program: ColdBoxProgram) -> None:
        self._program = program
        self.constants = BoxConstants(program.box, load_helium())

    def state(self, noise: Array, ticks: int) -> BoxState:  # noqa: ARG002 nothing else comes
        """Return the present state."""
        x, slope, held = self._program.between_ticks()
        return BoxState(x, np.array(self._program.measure()), np.empty(0), noise, slope, held)

    def restore(self, state: BoxState, tick: int, u: Array) -> None:  # noqa: ARG002 `held` has it
        """Resume the program at `tick`."""
        self._program.take_over_slope(tick, state.x, state.slope, state.held, state.y)


class CompiledRefrigerator:
    """A refrigerator."""

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


def of_cold_box(program: PlantProgram) -> CompiledPlant | None:
    """Return a program as the loop takes it; None for a plant that is mismatched beside its box, or linear."""
    if isinstance(program, RefrigeratorProgram):
        return CompiledRefrigerator(program)
    return CompiledBox(program) if type(program) is ColdBoxProgram else None
