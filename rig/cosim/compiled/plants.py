"""The plants in the compiled loop: the tick of each, and what their programs hand over before and after.

Each plant has its own types of constants and state, and numba makes a loop for each.
"""

from typing import Any

import numpy as np
from numba.extending import overload

from coldloop.kernels.compiled import kernel
from coldloop.process.signals import TICK_S
from plant.cold_box.physics import evaluate
from plant.cold_box.program import ColdBoxProgram
from plant.helium.properties import load_helium
from plant.integrator import advance_along
from plant.refrigerator.physics import BOX_STATES, SIGNALS
from plant.refrigerator.program import RefrigeratorProgram
from plant.refrigerator.tick import ALARMS, MODE, RefrigeratorMemory, advance_tick
from rig.cosim.compiled.records import (
    Array,
    BoxConstants,
    BoxState,
    PlantConstants,
    PlantState,
    RefrigeratorConstants,
    RefrigeratorState,
)


def advance_plant(c: PlantConstants, plant: PlantState, u: Array, load: float, row: int) -> None:
    """Go one tick forward from the one whose row in the trace is `row`, with u (3,) held and without noise on y."""
    raise NotImplementedError("kernels alone call it")


@overload(advance_plant, jit_options={"error_model": "numpy"}, strict=False)
def _advance_plant(c: Any, plant: Any, u: Any, load: Any, row: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    if c.instance_class is RefrigeratorConstants:
        return lambda c, plant, u, load, row: advance_whole(c, plant, u, load, row)  # noqa: PLW0108 no dispatcher
    return lambda c, plant, u, load, row: advance_box(c, plant, u, load)  # noqa: ARG005 the signature is given


@kernel
def advance_box(c: BoxConstants, plant: BoxState, u: Array, load: float) -> None:
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


def constants_of(program: ColdBoxProgram) -> PlantConstants:
    """Return what does not change in a session."""
    if isinstance(program, RefrigeratorProgram):
        return RefrigeratorConstants(program.plant, load_helium(), program.law)
    return BoxConstants(program.box, load_helium())


def state_of(program: ColdBoxProgram, noise: Array, ticks: int) -> PlantState:
    """Return the present state, and what the next `ticks` ticks bring."""
    y = np.array(program.measure())
    if isinstance(program, RefrigeratorProgram):
        memory = program.memory
        station = np.empty(SIGNALS + 2)
        show_station(memory, station)
        return RefrigeratorState(memory.x[:BOX_STATES], y, station, noise, memory, program.ahead(ticks))
    x, slope, held = program.between_ticks()
    return BoxState(x, y, np.empty(0), noise, slope, held)


def restore(program: ColdBoxProgram, state: PlantState, tick: int, u: Array) -> None:
    """Resume the program at `tick`, up to which the inputs `u` were held."""
    if isinstance(state, BoxState):
        program.take_over(tick, state.x, state.slope, state.held, state.y)
    elif isinstance(program, RefrigeratorProgram):
        program.take_over_whole(tick, u, state.memory, state.y)
