"""The plants in the compiled loop: the tick of each, and what their programs hand over before and after.

Each plant has its own types of constants and state, and numba makes a loop for each.
"""

from collections.abc import Callable
from typing import Any, Final, Protocol, TypeVar

from numba.extending import overload

from coldloop.kernels.intrinsics import Implementations
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


def compiled_plant(program: PlantProgram) -> CompiledPlant | None:
    """Return a program as the loop takes it; None where its ticks are not compiled."""
    own: CompiledPlant | None = program.compiled()
    if own is not None:
        return own
    if program.process.has_station:
        from coldloop_rig.cosim.compiled.cold_box_plants import of_cold_box  # noqa: PLC0415 other processes have no such signals

        return of_cold_box(program)
    from coldloop_rig.cosim.compiled.own_plants import of_process  # noqa: PLC0415

    return of_process(program)


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
