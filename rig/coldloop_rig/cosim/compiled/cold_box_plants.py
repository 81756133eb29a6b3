"""The cold box alone in the compiled loop."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop.process.cold_box import TICK_S
from coldloop_plant.cold_box import ColdBox, ColdBoxProgram, advance_along, evaluate
from coldloop_plant.helium import Helium, load_helium
from coldloop_plant.program import PlantProgram
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


def of_cold_box(program: PlantProgram) -> CompiledPlant | None:
    """Return a program as the loop takes it; None for a plant that is mismatched beside its box, or linear."""
    return CompiledBox(program) if type(program) is ColdBoxProgram else None
