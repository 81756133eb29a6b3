"""The plants in the compiled loop: the tick of each, and what their programs hand over before and after.

Each plant has its own types of constants and state, and numba makes a loop for each.
"""

from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
from numba.extending import overload

from coldloop.kernels.compiled import kernel
from coldloop.kernels.intrinsics import Implementations
from coldloop_plant.cold_box import ColdBox, ColdBoxProgram, advance_tick
from coldloop_plant.helium import Helium, load_helium
from coldloop_plant.program import PlantProgram
from coldloop_rig.cosim.compiled.records import Array, PlantState


class CompiledPlant(Protocol):
    """The program of a plant whose ticks are compiled."""

    @property
    def constants(self) -> Any:  # noqa: ANN401 differs by kind
        """Constants of the plant in a session."""

    def state(self, noise: Array, ticks: int) -> PlantState:
        """Return the present state, and what the next `ticks` ticks bring."""

    def restore(self, state: PlantState, tick: int, u: Array) -> None:
        """Resume the program at `tick`, up to which the inputs `u` were held."""


Advance = Callable[[Any, PlantState, Array, float, int], None]
A = TypeVar("A", bound=Advance)

TICKS: Final[Implementations[Advance]] = Implementations("advance_plant")
"""The kernel of each plant, by the type of its constants."""


def advances(constants: type) -> Callable[[A], A]:
    """Register a kernel as the tick of the plant whose constants are of this type."""

    def register(kernel: A) -> A:
        TICKS[constants] = kernel
        return kernel

    return register


def advance_plant(c: Any, plant: PlantState, u: Array, load: float, row: int) -> None:  # noqa: ANN401 of each kind
    """Go one tick forward from the one whose row in the trace is `row`, with u (3,) held and without noise on y."""
    raise NotImplementedError("kernels alone call it")


@overload(advance_plant, jit_options={"error_model": "numpy"}, strict=False)
def _advance_plant(c: Any, plant: Any, u: Any, load: Any, row: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    advance = TICKS[c.instance_class]
    return lambda c, plant, u, load, row: advance(c, plant, u, load, row)  # noqa: PLW0108 no dispatcher


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
    acting = np.empty(4)
    acting[:3], acting[3] = u, load
    advance_tick(plant.x, plant.slope, plant.held, acting, plant.y, c.box, c.helium)


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


def compiled_plant(program: PlantProgram) -> CompiledPlant | None:
    """Return a program as the loop takes it; None where its ticks are not compiled."""
    own: CompiledPlant | None = program.compiled()
    if own is not None:
        return own
    if program.process.has_station:  # not where it is mismatched beside its box, or linear
        return CompiledBox(program) if type(program) is ColdBoxProgram else None
    from coldloop_rig.cosim.compiled import own_plants  # noqa: PLC0415 a cold box starts without it

    return own_plants.CompiledOwn(program) if isinstance(program, own_plants.Linear) else None
