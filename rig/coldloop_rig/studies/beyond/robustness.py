"""What controllers and rules of the updating period are worth on plants that differ from the model."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from coldloop.process.cold_box import TICK_S
from coldloop_rig.results.indicators import Indicators
from coldloop_rig.studies.beyond.conditions import CONDITIONS, ESTIMATED, NOMINAL
from coldloop_rig.studies.beyond.robust_controllers import (
    Case,
    HoursUnder,
    controller_cases,
    controllers_figure,
    controllers_remarks,
)
from coldloop_rig.studies.drawing import ratio_rows
from coldloop_rig.studies.intervals import Interval, mean_ratio
from coldloop_rig.studies.paper.updating_period import ADAPTIVE, INTERRUPT, RULE
from coldloop_rig.studies.request import RunRequest, Series
from coldloop_rig.studies.study import Outcomes, StudyOptions, StudyResult, loads
from coldloop_rig.text_tables import markdown_table

RULE_CONDITIONS: Final = {**CONDITIONS, "rate limit by elapsed time": ("limits.rate_reference=elapsed",)}
REFERENCE: Final = "fixed 2.5 s"
POLICIES: Final = {
    "fixed 1 s": (1.0, ()),
    REFERENCE: (2.5, ()),
    "fixed 5 s": (5.0, ()),
    "fixed 1.5 s, interrupt": (1.5, (INTERRUPT,)),
    "Algorithm 1": (ADAPTIVE, ()),
    "contraction rule, interrupt": (ADAPTIVE, (f"{RULE}contraction", INTERRUPT)),
}
COSTS: Final = {"J_BF": "J_BF", "J_open_mean": "open loop"}
USUAL_TICKS: Final = 3600
"""Fifteen minutes a run, unless another duration is given."""
COLUMNS: Final = (
    "condition", "load", "controller or rule", "minutes", "J per time", "L1 outside (%)", "T5 outside (%)", "J_BF",
)  # fmt: skip


class RobustnessStudy:
    """Controllers on plants that are off; on the same ones fixed periods and rules, under the paper's preset."""

    name = "robustness"
    title = "Beyond the paper: plants that differ from their model"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every controller, and every policy, under every condition and load."""
        return [request for *_, request in _cases(options)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Say what controllers hold; compare costs of policies with those of a fixed period."""
        result = StudyResult(COLUMNS, [], {})
        runs: dict[tuple[str, str], list[Indicators]] = {}
        for condition, name, load, request in _cases(options):
            run, minutes = outcomes[request].indicators, load.ticks * TICK_S / 60
            outside = tuple(run.outside_band_pct.values())
            result.rows.append((condition, load.name, name, minutes, run.J_open_mean, *outside, run.J_BF))
            runs.setdefault((condition, name), []).append(run)
        found = {key: HoursUnder.of(some) for key, some in runs.items()}
        result.figures["controllers on plants that are off"] = controllers_figure(found)
        result.remarks += controllers_remarks(options, found)
        tables = {key: np.array([(run.J_BF, run.J_open_mean) for run in some]) for key, some in runs.items()}
        for column, cost in enumerate(COSTS):
            ratios = ratio_table({key: values[:, column] for key, values in tables.items()})
            result.figures[f"policies under {COSTS[cost]}"] = _figure(ratios, COSTS[cost])
            result.remarks.append(_table(ratios, COSTS[cost], {key: v[:, column] for key, v in tables.items()}))
        return result


def _cases(options: StudyOptions) -> Iterator[Case]:
    yield from controller_cases(options)
    options = replace(options, ticks=options.ticks or USUAL_TICKS)
    hours = loads(options, *options.hours, usual=1)
    for condition, changes in RULE_CONDITIONS.items():
        for policy, (period_s, assignments) in POLICIES.items():
            own = [one for one in assignments if one != INTERRUPT or condition != ESTIMATED]
            for load in hours:
                yield condition, policy, load, load.request(period_s, *changes, *own)


Ratios = dict[str, dict[str, Interval]]


def ratio_table(costs: dict[tuple[str, str], Series]) -> Ratios:
    """Return the costs of each policy over those of the reference under the same condition, by condition and policy."""
    return {
        condition: {policy: mean_ratio(costs[condition, policy], costs[condition, REFERENCE]) for policy in POLICIES}
        for condition in RULE_CONDITIONS
    }


def _table(ratios: Ratios, cost: str, costs: dict[tuple[str, str], Series]) -> str:
    others = [policy for policy in POLICIES if policy != REFERENCE]
    hours = len(costs[NOMINAL, REFERENCE])
    caption = (
        f"**Preset `paper`: {cost}** over that of {REFERENCE} under the same condition, geometric mean of "
        f"{hours} runs with its 95 % interval; before it, that of {REFERENCE} over its own without mismatch."
    )
    rows = []
    for condition, row in ratios.items():
        own = mean_ratio(costs[condition, REFERENCE], costs[NOMINAL, REFERENCE])
        rows.append((condition, own.text(2), *(row[policy].text() for policy in others)))
    return markdown_table(("condition", REFERENCE, *others), rows, caption)


def _figure(ratios: Ratios, cost: str) -> Figure:
    by_policy = {policy: {condition: row[policy] for condition, row in ratios.items()} for policy in POLICIES}
    return ratio_rows(by_policy, f"{cost} over that of {REFERENCE} (1)", 6.5, 0.13, 3)
