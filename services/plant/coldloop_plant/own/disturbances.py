"""Disturbances beside the load: what of them the simulated plant meets, and how its equations are given them."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from coldloop.errors import ColdloopError
from coldloop.foreign import foreign
from coldloop.process.load_profile import LoadProfile
from coldloop_plant.numeric import RealArray
from coldloop_plant.program import PlantProgram


def outside(w: RealArray) -> float | RealArray:
    """Return what equations are given as w: the load, or load and other disturbances where there are such."""
    return w if len(w) > 1 else float(w[0])


@dataclass(frozen=True)
class Disturbances:
    """Their courses over time, steps held; each is a state of the process, and an output where it is measured."""

    courses: tuple[LoadProfile, ...] = ()
    measured: tuple[bool, ...] = ()

    @classmethod
    def of(cls, documents: Sequence[Mapping[str, Any]]) -> Self:
        """Return the disturbances of a model file."""
        courses = (LoadProfile(tuple(each["ticks"]), tuple(each["values"])) for each in documents)
        return cls(tuple(courses), tuple(each["measured"] for each in documents))

    def at(self, tick: int) -> RealArray:
        """Return what they are from `tick` to the next, shape (k,)."""
        return np.array([course.value(tick) for course in self.courses])

    def ahead(self, tick: int, ticks: int) -> RealArray:
        """Return what they are at `ticks` ticks from `tick` on, and at the one behind them, shape (ticks + 1, k)."""
        return np.array([[each.value(tick + later) for each in self.courses] for later in range(ticks + 1)])

    def shown(self, tick: int) -> RealArray:
        """Return those that are measured."""
        return np.array([course.value(tick) for course, seen in zip(self.courses, self.measured, strict=True) if seen])


NO_DISTURBANCES: Final = Disturbances()


class DisturbedPlant(PlantProgram):
    """A plant with disturbances as its last states and outputs; the others are its kind's.

    Args:
        disturbances: The disturbances.
        arguments: Of `PlantProgram`.
    """

    whose = "the plant"  # in messages

    def __init__(self, disturbances: Disturbances, **arguments: Any) -> None:  # noqa: ANN401 of the base
        self.disturbances = disturbances
        super().__init__(**arguments)

    @property
    def _own(self) -> RealArray:
        """States without the disturbances."""
        return self._x[: len(self._x) - len(self.disturbances.courses)]

    def _own_outputs(self, w: RealArray) -> RealArray:
        """Return the outputs without the disturbances; `w` is load and disturbances."""
        raise NotImplementedError

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        """Return states and outputs one tick ahead, without the disturbances."""
        raise NotImplementedError

    def _calling(self) -> AbstractContextManager[None]:
        return foreign(f"{self.whose} fails at tick {self.tick}", "the simulated plant ends there", kind=ColdloopError)

    def _outside(self, w: float) -> RealArray:
        return np.append(w, self.disturbances.at(self.tick))

    def _read(self, w: float) -> RealArray:
        with self._calling():
            own = self._own_outputs(self._outside(w))
        return np.append(own, self.disturbances.shown(self.tick))

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        with self._calling():
            x, y = self._own_step(self._outside(w))
        met, next_tick = self.disturbances, self.tick + 1
        return np.append(x, met.at(next_tick)), np.append(y, met.shown(next_tick))

    def _saved(self) -> dict[str, Any] | None:
        """Return what the plant hides beside its states, as plain data; None if nothing, or if it cannot be saved."""
        return None

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        """Return to what `_saved` returned (ValueError or KeyError if it is not of this plant)."""
        if saved is not None:
            raise ValueError("the retained state is that of another plant")

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        saved = self._saved()
        return super().retained() | ({} if saved is None else {"own": saved})

    def resume(self, *retained: Any, own: Mapping[str, Any] | None = None, **named: Any) -> None:  # noqa: ANN401
        """Resume from what `retained` returned (ValueError or KeyError if it is not of this plant)."""
        self._return_to(own)
        super().resume(*retained, **named)
