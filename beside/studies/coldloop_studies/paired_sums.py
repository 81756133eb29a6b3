"""Sums over problems that several solvers have had, at several powers of the PLC."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import StudyError
from coldloop_rig.plc_sizing.intervals import Interval, crossing, interval_of_mean, jackknife
from coldloop_studies.request import Outcome, RunRequest, Series
from coldloop_studies.study import Load, Outcomes

S = TypeVar("S", bound=Hashable)

BELOW: Final = 1e-9
"""Share of the lowest cost, or of 1, by which rounding may let a cost be below it."""


class Sums(NamedTuple):
    """Summed costs and violations of one solver at one power on the problems of one draw."""

    J_dev: float
    J_cst: float
    c1: float
    c2: float
    lowest: float

    @property
    def J_total(self) -> float:
        """Cost that is compared with the lowest one: J_dev + J_cst."""
        return self.J_dev + self.J_cst

    @classmethod
    def of(cls, run: Outcome, what: str) -> "Sums":
        """Return the sums of a run; `what` is for the message.

        Raises:
            StudyError: A profile costs less than the optimum: the study, or the optimum, is wrong.
        """
        watch(run, "lowest", run.column("j_dev") + run.column("j_cst"), what)
        i = run.indicators
        return cls(i.J_dev, i.J_cst, i.c1, i.c2, float(run.column("lowest").sum()))


class PairedSums(Generic[S]):
    """Sums of all draws, by solver, power (rising) and draw, of the outcomes of the requests that `request` makes.

    Raises:
        StudyError: A profile costs less than the optimum.
    """

    def __init__(
        self, loads: Sequence[Load], powers: Mapping[S, Sequence[float]],
        request: Callable[[Load, S, float], RunRequest], label: Callable[[S], str], outcomes: Outcomes,
    ) -> None:  # fmt: skip
        self.loads = loads
        self.powers = powers
        self.sums: dict[tuple[S, float], list[Sums]] = {
            (solver, power): [
                Sums.of(outcomes[request(load, solver, power)], f"{label(solver)} at P = {power:g}, load {load.name}")
                for load in loads
            ]
            for solver, some in powers.items() for power in some
        }  # fmt: skip

    def table(self, draw: int) -> dict[S, dict[str, Series]]:
        """Return J_dev, J_cst, J_total, c1, c2 and the lowest of a draw against power, by solver."""
        names = (*Sums._fields, "J_total")
        return {
            solver: {name: np.array([getattr(self.sums[solver, p][draw], name) for p in some]) for name in names}
            for solver, some in self.powers.items()
        }

    def over_lowest(self, solver: S, power: float, which: Sequence[int]) -> float:
        """Return the total cost of some draws together over the lowest there is."""
        some = [self.sums[solver, power][draw] for draw in which]
        return sum(one.J_total for one in some) / sum(one.lowest for one in some)

    def interval(self, solver: S, power: float) -> Interval:
        """Return the interval of `over_lowest`."""
        return jackknife(partial(self.over_lowest, solver, power), len(self.loads), above=1.0)

    def over_converged(self, part: str, solver: S, power: float, reference: S) -> Interval:
        """Return the interval of a part of the cost over that of a reference at its largest power."""
        converged = self.sums[reference, self.powers[reference][-1]]

        def ratio(which: Sequence[int]) -> float:
            mine, theirs = (
                sum(getattr(sums[draw], part) for draw in which) for sums in (self.sums[solver, power], converged)
            )
            return float(mine / theirs) if theirs else np.nan

        return jackknife(ratio, len(self.loads), above=0.0)

    def mean(self, what: str, solver: S, power: float) -> Interval:
        """Return the interval of the mean over the draws of c1 or c2."""
        return interval_of_mean([getattr(one, what) for one in self.sums[solver, power]], above=0.0)

    def crossing(self, one: S, other: S) -> Interval:
        """Return from which power on `one` costs no more than `other`, all draws together."""
        return jackknife(partial(self._crossing, one, other), len(self.loads), above=0.0)

    def crossings(self, one: S, other: S) -> list[float]:
        """Return the same of each draw by itself."""
        return [self._crossing(one, other, [draw]) for draw in range(len(self.loads))]

    def _crossing(self, one: S, other: S, which: Sequence[int]) -> float:
        common = [power for power in self.powers[one] if power in self.powers[other]]
        curves = (np.array([self.over_lowest(solver, power, which) for power in common]) for solver in (one, other))
        return crossing(np.array(common), *curves)


def watch(run: Outcome, lowest: str, cost: Series, what: str) -> None:
    """Make sure that no profile costs less than the best one that can be played. Raises StudyError if one does."""
    bound = run.column(lowest)
    below: NDArray[np.intp] = np.flatnonzero(cost < bound - BELOW * (1.0 + np.abs(bound)))
    if len(below):
        raise StudyError(
            f"{what}: problem {below[0]} costs {cost[below[0]]:.9g}, less than the optimum of {bound[below[0]]:.9g}; "
            "its costs cannot be compared"
        )
