"""Statistics of some hours or draws with their 95 % intervals; sums over problems that several solvers have had."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from coldloop.errors import StudyError
from coldloop_rig.plc_sizing.certification import failure_bound
from coldloop_rig.studies.request import Outcome, RunRequest, Series
from coldloop_rig.studies.study import Load, Outcomes

TAIL: Final = 0.025
"""Probability on each side of an interval."""
MOST_CHANGE: Final = 2.0
"""Change of a logarithm when a draw is left out, up to which it is taken for smooth."""


class Interval(NamedTuple):
    """A value with its interval: NaN if there is none, infinite on a side where nothing is known."""

    value: float
    low: float
    high: float

    def text(self, digits: int = 3) -> str:
        """Write the value and the interval in brackets, which a single hour has not."""
        if np.isnan(self.low):
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"

    def in_words(self, below: str, above: str, without: str) -> str:
        """Return what it shows of a ratio: that it is below 1, above 1, neither, or that there is no interval."""
        if np.isnan(self.low):
            return without
        if self.high < 1.0:
            return below
        return above if self.low > 1.0 else "no difference is shown"

    def brief(self, digits: int = 3) -> str:
        """Write value and interval with so many significant digits."""
        value = f"{self.value:.{digits}g}" if np.isfinite(self.value) else "none"
        return value if np.isnan(self.low) else f"{value} [{self.low:.{digits}g} to {self.high:.{digits}g}]"


def jackknife(statistic: Callable[[list[int]], float], draws: int, above: float = -np.inf) -> Interval:
    """Return a statistic of draws with its interval by the jackknife and Student's t (Efron and Tibshirani, 1993).

    Its values without each draw in turn give its variance, with draws - 1 degrees of freedom. Of a mean this is
    Student's interval, and of a geometric mean that of the logarithms. With 3 to 12 log-normal draws it covers
    geometric means in 95 %, means and ratios of sums in 92 to 95 % if draws are alike, and in less if few decide
    (docs/studies.md); percentiles of a bootstrap cover 72 to 91 %.

    Args:
        statistic: Of the numbers of the draws it is computed from, 0 to `draws` - 1.
        draws: Of one draw there is no interval: it is NaN. Without limits if there is no value without some draw.
        above: The statistic cannot be less: the interval is one of the logarithm of the distance from it, unless a
            draw changes this by more than `MOST_CHANGE`; then it is cut off there.

    Raises:
        ValueError: The statistic is below `above`.
    """
    every = range(draws)
    value = statistic(list(every))
    if draws < 2 or not np.isfinite(value):
        return Interval(value, np.nan, np.nan)
    without = np.array([statistic([draw for draw in every if draw != left]) for left in every])
    if not np.isfinite(without).all():
        return Interval(value, above, np.inf)
    least = min(value, *without)
    if least < above:
        raise ValueError(f"a statistic of {least:g} that cannot be below {above:g}")
    changes = without - value
    logarithmic = -np.inf < above < least
    if logarithmic:
        logarithms = np.log((without - above) / (value - above))
        logarithmic = bool(np.abs(logarithms).max() < MOST_CHANGE)
        changes = logarithms if logarithmic else changes
    reach = float(stdtrit(draws - 1, 1.0 - TAIL) * np.sqrt((draws - 1) * changes.var()))
    if logarithmic:
        factor = float(np.exp(reach))
        return Interval(value, above + (value - above) / factor, above + (value - above) * factor)
    return Interval(value, max(value - reach, above), value + reach)


def interval_of_share(of_interest: int, hours: int) -> Interval:
    """Return a share of the hours with its Clopper-Pearson interval.

    It covers 95 to 100 %, with 3 hours 98 to 100 %: a count has few values, and no interval covers 95 % of each share.
    """
    low = 1.0 - failure_bound(hours - of_interest, hours, TAIL)
    return Interval(of_interest / hours, low, failure_bound(of_interest, hours, TAIL))


def geometric_mean(ratios: Series) -> float:
    """Return the geometric mean of positive numbers."""
    return float(np.exp(np.log(ratios).mean()))


def mean_ratio(costs: Series, reference: Series) -> Interval:
    """Return the geometric mean over the hours of costs over reference, shape (n,) each."""
    ratios = costs / reference
    return jackknife(lambda which: geometric_mean(ratios[which]), len(ratios), above=0.0)


def interval_of_mean(values: Sequence[float], above: float = -np.inf) -> Interval:
    """Return the mean of one value a draw, none less than `above`; draws without a value are left out."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return Interval(np.nan, np.nan, np.nan)
    return jackknife(lambda which: float(known[which].mean()), len(known), above)


def crossing(powers: Series, one: Series, other: Series) -> float:
    """Return the power from which on `one` is not above `other` any more; NaN if there is none."""
    above = np.log(one / other)
    if not np.isfinite(above).all():
        return float("nan")
    behind = np.flatnonzero(above > 0)
    if len(behind) == 0 or behind[-1] == len(powers) - 1:
        return float("nan") if len(behind) else float(powers[0])
    i = behind[-1]
    share = above[i] / (above[i] - above[i + 1])
    return float(np.exp(np.interp(share, [0, 1], np.log(powers[i : i + 2]))))


S = TypeVar("S", bound=Hashable)

BELOW: Final = 1e-9
"""Share of the lowest cost, or of 1, by which rounding may let a cost be below it."""


class Sums(NamedTuple):
    """Of one solver at one power on the problems of one draw."""

    J_dev: float
    J_cst: float
    c1: float
    c2: float
    lowest: float

    @property
    def J_total(self) -> float:
        """What is compared with the lowest."""
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
