"""Sums over paired problems of two presets, their variants and qpOASES, and what is computed from them."""

from collections.abc import Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from rig.studies.beyond.penalty_variants import PenaltyVariant, paired, powers_of, variants
from rig.studies.crossing import crossing
from rig.studies.intervals import Interval, interval_of_mean, over_draws
from rig.studies.paper.open_loop import paired_loads, watch
from rig.studies.study import Load, Outcomes, StudyOptions

QPOASES: Final = "qpOASES"


class Sums(NamedTuple):
    """Of one solver at one power on the problems of one draw."""

    J_dev: float
    J_cst: float
    c1: float
    c2: float
    lowest: float

    @property
    def total(self) -> float:
        """What is compared with the lowest."""
        return self.J_dev + self.J_cst


class Paired:
    """Sums of all draws, by variant (qpOASES is none), power and draw.

    Raises:
        StudyError: A profile costs less than the optimum.
    """

    def __init__(self, options: StudyOptions, outcomes: Outcomes) -> None:
        self.loads = paired_loads(options)
        self.sums: dict[tuple[PenaltyVariant | None, float], list[Sums]] = {
            (variant, power): [_sums(load, variant, power, outcomes) for load in self.loads]
            for variant in (None, *variants(options))
            for power in powers_of(variant, options)
        }

    def powers(self, variant: PenaltyVariant | None) -> list[float]:
        """Return the powers of a variant, rising."""
        return sorted(power for one, power in self.sums if one == variant)

    def over_lowest(self, variant: PenaltyVariant | None, power: float, which: Sequence[int]) -> float:
        """Return the total cost of some draws together over the lowest there is."""
        some = [self.sums[variant, power][draw] for draw in which]
        return sum(one.total for one in some) / sum(one.lowest for one in some)

    def interval(self, variant: PenaltyVariant | None, power: float) -> Interval:
        """Return the interval of `over_lowest`."""
        return over_draws(partial(self.over_lowest, variant, power), len(self.loads))

    def over_converged(self, part: str, variant: PenaltyVariant, power: float) -> Interval:
        """Return the interval of a part of the cost over that of qpOASES at the largest power."""
        converged = self.sums[None, self.powers(None)[-1]]

        def ratio(which: Sequence[int]) -> float:
            mine, theirs = (
                sum(getattr(sums[draw], part) for draw in which) for sums in (self.sums[variant, power], converged)
            )
            return float(mine / theirs) if theirs else np.nan

        return over_draws(ratio, len(self.loads))

    def mean(self, what: str, variant: PenaltyVariant, power: float) -> Interval:
        """Return the interval of the mean over the draws of c1 or c2."""
        return interval_of_mean([getattr(one, what) for one in self.sums[variant, power]])

    def crossing(self, variant: PenaltyVariant) -> Interval:
        """Return from which power on qpOASES costs no more than a preset."""
        return over_draws(partial(self._crossing, variant), len(self.loads))

    def crossings(self, variant: PenaltyVariant) -> list[float]:
        """Return the same of each draw by itself."""
        return [self._crossing(variant, [draw]) for draw in range(len(self.loads))]

    def _crossing(self, variant: PenaltyVariant, which: Sequence[int]) -> float:
        powers = self.powers(variant)
        curves = (np.array([self.over_lowest(one, power, which) for power in powers]) for one in (None, variant))
        return crossing(np.array(powers), *curves)


def _sums(load: Load, variant: PenaltyVariant | None, power: float, outcomes: Outcomes) -> Sums:
    run = outcomes[paired(load, variant, power)]
    label = variant.label if variant else QPOASES
    watch(run, "lowest", run.column("j_dev") + run.column("j_cst"), f"{label} at P = {power:g}, load {load.name}")
    i = run.indicators
    return Sums(i.J_dev, i.J_cst, i.c1, i.c2, float(run.column("lowest").sum()))
