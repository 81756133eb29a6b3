"""What rules of the updating period are worth when the plant is not the model, nor its sensors the plant."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from rig.studies.drawing import ratio_rows
from rig.studies.intervals import Interval, mean_ratio
from rig.studies.paper.updating_period import ADAPTIVE, INTERRUPT, RULE
from rig.studies.request import RunRequest, Series
from rig.studies.study import NOISE, PROGRAM, Load, Outcomes, StudyOptions, StudyResult, loads
from rig.text_tables import markdown_table

MISMATCH: Final = "plant.mismatch."
OFF: Final = (0.8, 0.9, 1.1, 1.2)
PARAMETERS: Final = {
    "UA": ("heat_transfer",),
    "turbine efficiency": ("turbine_efficiency",),
    "valves": ("jt_valve", "turbine_valve"),
}
ESTIMATED: Final = "load estimated"
CONDITIONS: Final = {
    "as its model": (),
    **{
        f"{name} {100 * (factor - 1):+.0f} %": tuple(f"{MISMATCH}{key}={factor}" for key in keys)
        for name, keys in PARAMETERS.items() for factor in OFF
    },
    "sensor noise": NOISE,
    "sensor bias": (
        "plant.sensors.level_bias=0.2", "plant.sensors.temperature_bias=0.2", "plant.sensors.pressure_bias=0.005",
    ),
    ESTIMATED: (f"{PROGRAM}estimator.load_known=false", f"{PROGRAM}estimator.load_walk_w=30"),
    "rate limit by elapsed time": ("limits.rate_reference=elapsed",),
}  # fmt: skip
"""What differs from what the controller believes. Bias: 0.2 % of level, 0.2 K, 5 mbar."""
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


class RobustnessStudy:
    """Fixed periods, Algorithm 1 and this project's rule on plants that are off."""

    name = "robustness"
    title = "Beyond the paper: plants that differ from their model"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every policy under every condition and load."""
        return [_request(*one) for one in _cases(options)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare both costs with those of a fixed period under the same condition."""
        result = StudyResult(("condition", "load", "policy", "J per time", "J_BF"), [], {})
        costs: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for condition, policy, load in _cases(options):
            run = outcomes[_request(condition, policy, load)].indicators
            result.rows.append((condition, load.name, policy, run.J_open_mean, run.J_BF))
            costs.setdefault((condition, policy), []).append((run.J_BF, run.J_open_mean))
        tables = {key: np.array(values) for key, values in costs.items()}
        for column, cost in enumerate(COSTS):
            ratios = ratio_table({key: values[:, column] for key, values in tables.items()})
            result.figures[f"policies under {COSTS[cost]}"] = _figure(ratios, COSTS[cost])
            result.remarks.append(_table(ratios, COSTS[cost], {key: v[:, column] for key, v in tables.items()}))
        result.remarks.append(
            f"Under '{ESTIMATED}' no period can be interrupted: rules run without. Costs are of true values under "
            "bias, and of measured ones, which are noisy, under noise."
        )
        return result


def _cases(options: StudyOptions) -> Iterator[tuple[str, str, Load]]:
    options = replace(options, ticks=options.ticks or USUAL_TICKS)
    hours = loads(options, *options.hours, usual=1)
    return ((condition, policy, load) for condition in CONDITIONS for policy in POLICIES for load in hours)


def _request(condition: str, policy: str, load: Load) -> RunRequest:
    period_s, assignments = POLICIES[policy]
    if condition == ESTIMATED:
        assignments = tuple(one for one in assignments if one != INTERRUPT)
    return load.request(period_s, *CONDITIONS[condition], *assignments)


Ratios = dict[str, dict[str, Interval]]


def ratio_table(costs: dict[tuple[str, str], Series]) -> Ratios:
    """Return the costs of each policy over those of the reference under the same condition, by condition and policy."""
    return {
        condition: {policy: mean_ratio(costs[condition, policy], costs[condition, REFERENCE]) for policy in POLICIES}
        for condition in CONDITIONS
    }


def _table(ratios: Ratios, cost: str, costs: dict[tuple[str, str], Series]) -> str:
    others = [policy for policy in POLICIES if policy != REFERENCE]
    nominal = next(iter(CONDITIONS))
    hours = len(costs[nominal, REFERENCE])
    caption = (
        f"**{cost}** over that of {REFERENCE} under the same condition, geometric mean of {hours} runs with its "
        f"95 % interval; before it, that of {REFERENCE} over its own without mismatch."
    )
    rows = []
    for condition, row in ratios.items():
        own = mean_ratio(costs[condition, REFERENCE], costs[nominal, REFERENCE])
        rows.append((condition, own.text(2), *(row[policy].text() for policy in others)))
    return markdown_table(("condition", REFERENCE, *others), rows, caption)


def _figure(ratios: Ratios, cost: str) -> Figure:
    by_policy = {policy: {condition: row[policy] for condition, row in ratios.items()} for policy in POLICIES}
    return ratio_rows(by_policy, f"{cost} over that of {REFERENCE} (1)", (9.0, 6.5), 0.13, 3)
