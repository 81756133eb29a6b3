"""What controllers hold on plants that are off: the default, the paper's estimator, and a fixed updating period."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple, Self

import numpy as np
from matplotlib.figure import Figure

from coldloop_rig.results.indicators import Indicators
from coldloop_rig.studies.beyond import conditions
from coldloop_rig.studies.beyond.conditions import LEFT_OUT, LINEAR, NOMINAL
from coldloop_rig.studies.drawing import ratio_rows
from coldloop_rig.studies.intervals import Interval, interval_of_mean, mean_ratio
from coldloop_rig.studies.paper.updating_period import ADAPTIVE
from coldloop_rig.studies.request import Procedure, RunRequest, Series
from coldloop_rig.studies.study import TUNED, Load, StudyOptions, loads
from coldloop_rig.text_tables import markdown_table

CONDITIONS: Final = {**conditions.CONDITIONS, **conditions.BESIDE_THE_BOX, **conditions.UNKNOWN_LOADS, **LINEAR}
DEFAULT: Final = "tuned, adaptive"
CONTROLLERS: Final = {
    DEFAULT: (ADAPTIVE, (TUNED,)),
    "paper, Algorithm 1": (ADAPTIVE, ()),
    "tuned, fixed 2.5 s": (2.5, (TUNED,)),
}
"""Updating period and settings; each preset has its solver."""
HELD_PCT: Final = 1.0
"""Mean share of the time outside a band up to which a controller holds it."""


class HoursUnder(NamedTuple):
    """What one controller did under one condition, hour by hour; shape (n,) each."""

    costs: Series
    """J_BF."""
    level_pct: Series
    """Share of the time that L1 is outside its band."""
    temperature_pct: Series
    """The same of T5."""

    @classmethod
    def of(cls, runs: Sequence[Indicators]) -> Self:
        """Gather them from the runs, one for each hour."""
        return cls(*np.array([(run.J_BF, *run.outside_band_pct.values()) for run in runs]).T)

    @property
    def outside(self) -> str:
        """Mean shares of the time outside, of L1 and of T5."""
        return f"{self.level_pct.mean():.1f} / {self.temperature_pct.mean():.1f}"

    @property
    def holds(self) -> bool:
        """Whether both outputs are in their bands but for `HELD_PCT` of the time."""
        return max(float(self.level_pct.mean()), float(self.temperature_pct.mean())) <= HELD_PCT


Case = tuple[str, str, Load, RunRequest]
"""Condition, controller, load and request of a run."""
Found = Mapping[tuple[str, str], HoursUnder]
"""By condition and controller."""


def controller_cases(options: StudyOptions) -> Iterator[Case]:
    """Yield every controller under every condition and load."""
    hours = loads(options, *options.hours, usual=1)
    for controller, (period_s, assignments) in CONTROLLERS.items():
        for condition, changes in CONDITIONS.items():
            procedure = Procedure.LINEAR_PLANT if condition in LINEAR else Procedure.CONFIGURED
            for load in hours:
                request = load.request(period_s, *assignments, *changes, procedure=procedure)
                yield condition, controller, load, request


def controllers_remarks(options: StudyOptions, found: Found) -> list[str]:
    """Return what the controllers hold and at which cost, and the tables of it."""
    names = [load.name for load in loads(options, *options.hours, usual=1)]
    return [holding(found), comparison(found), LEFT_OUT, _costs(found), _ratios(found, names)]


def holding(found: Found) -> str:
    """Say which bands each controller holds, and under which conditions it does not."""
    lines = []
    for controller in CONTROLLERS:
        lost = [f"{condition} ({found[condition, controller].outside})" for condition in CONDITIONS
                if not found[condition, controller].holds]  # fmt: skip
        held = f"- `{controller}` in {len(CONDITIONS) - len(lost)} of {len(CONDITIONS)}"
        lines.append(f"{held}; not under {', '.join(lost)}." if lost else f"{held}.")
    return (
        f"**L1 and T5 are outside their bands for at most {HELD_PCT:g} % of the time each**, in the mean of the hours "
        "(in brackets %, L1 / T5):\n\n" + "\n".join(lines)
    )


def comparison(found: Found) -> str:
    """Say where the default costs less or more than the others, hour by hour under the same condition."""
    lines = []
    for other in CONTROLLERS:
        if other == DEFAULT:
            continue
        ratios = {
            condition: mean_ratio(found[condition, DEFAULT].costs, found[condition, other].costs)
            for condition in CONDITIONS
        }
        less = [f"{condition} ({one.value:.3g})" for condition, one in ratios.items() if one.high < 1.0]
        more = [f"{condition} ({one.value:.3g})" for condition, one in ratios.items() if one.low > 1.0]
        lines.append(
            f"- of `{other}`: less under {', '.join(less) or 'no condition'}; more under "
            f"{', '.join(more) or 'no condition'}; undecided in {len(ratios) - len(less) - len(more)} of {len(ratios)}."
        )
    return (
        f"**J_BF of `{DEFAULT}` over that** (geometric mean of the hours; less or more where its 95 % interval "
        "does not contain 1)\n\n" + "\n".join(lines)
    )


def _costs(found: Found) -> str:
    rows = []
    for condition in CONDITIONS:
        under = [found[condition, controller] for controller in CONTROLLERS]
        means = [interval_of_mean(one.costs.tolist(), 0.0).brief() for one in under]
        rows.append((condition, *(f"{mean}; {one.outside}" for mean, one in zip(means, under, strict=True))))
    caption = (
        f"**J_BF; share of the time outside the bands (%: L1 / T5)**, means of {len(found[NOMINAL, DEFAULT].costs)} "
        "runs, J_BF with its 95 % interval."
    )
    return markdown_table(("condition", *CONTROLLERS), rows, caption)


def over_own(found: Found, condition: str, controller: str) -> tuple[Interval, Series]:
    """Return the J_BF of a controller over its own on the plant as its model: geometric mean, and hour by hour."""
    costs, own = found[condition, controller].costs, found[NOMINAL, controller].costs
    return mean_ratio(costs, own), costs / own


def _ratios(found: Found, names: list[str]) -> str:
    rows = []
    for condition in CONDITIONS:
        cells = []
        for controller in CONTROLLERS:
            mean, by_hour = over_own(found, condition, controller)
            cells.append(f"{mean.brief()} ({by_hour.max():.3g}: {names[int(by_hour.argmax())]})")
        rows.append((condition, *cells))
    caption = (
        f"**J_BF over that of the same controller on the plant {NOMINAL}**, geometric mean of the hours with its 95 % "
        "interval; in brackets the worst hour."
    )
    return markdown_table(("condition", *CONTROLLERS), rows, caption)


def controllers_figure(found: Found) -> Figure:
    """Draw what being off costs each controller."""
    ratios = {
        controller: {condition: over_own(found, condition, controller)[0] for condition in CONDITIONS}
        for controller in CONTROLLERS
    }
    return ratio_rows(ratios, f"J_BF over that of the same controller on the plant {NOMINAL} (1)", 8.0, 0.27, 3)
