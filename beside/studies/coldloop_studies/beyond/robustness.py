"""Comparison of controllers and rules of the updating period on plants and sensors that differ from the model."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple, Self

import numpy as np

from coldloop.process.cold_box import TICK_S
from coldloop_rig.plc_sizing.intervals import Interval, interval_of_mean, mean_ratio
from coldloop_rig.results.indicators import Indicators
from coldloop_rig.text_tables import markdown_table
from coldloop_studies.drawing import ratio_rows
from coldloop_studies.paper.updating_period import ADAPTIVE, INTERRUPT, RULE
from coldloop_studies.request import Procedure, RunRequest, Series
from coldloop_studies.study import NOISE, PROGRAM, TUNED, Load, Outcomes, StudyOptions, StudyResult, loads, noise

MISMATCH: Final = "plant.mismatch."
OFF: Final = (0.8, 0.9, 1.1, 1.2)
PARAMETERS: Final = {
    "UA": ("heat_transfer",),
    "turbine efficiency": ("turbine_efficiency",),
    "valves": ("jt_valve", "turbine_valve"),
}
NOMINAL: Final = "as its model"
ESTIMATED: Final = "load estimated"
CONDITIONS: Final = {
    NOMINAL: (),
    **{
        f"{name} {100 * (factor - 1):+.0f} %": tuple(f"{MISMATCH}{key}={factor}" for key in keys)
        for name, keys in PARAMETERS.items() for factor in OFF
    },
    "sensor noise": NOISE,
    "sensor noise doubled": noise(2.0),
    "sensor bias": (
        "plant.sensors.level_bias=0.2", "plant.sensors.temperature_bias=0.2", "plant.sensors.pressure_bias=0.005",
    ),
    ESTIMATED: (f"{PROGRAM}estimator.load_known=false",),
}  # fmt: skip
"""Assignments by which plant and sensors differ from the controller's model. Bias: 0.2 % of level, 0.2 K, 5 mbar."""
_OTHERS: Final = {"heater": ("heater", 0.2), "load as announced": ("load", 0.05), "level gauge": ("level_gauge", 0.01)}
BESIDE_THE_BOX: Final = {
    **{
        f"{name} {100 * part:+.0f} %": (f"{MISMATCH}{key}={1 + part}",)
        for name, (key, size) in _OTHERS.items() for part in (-size, size)
    },
    **{f"delay of {ticks} ticks": (f"{MISMATCH}delay_ticks={ticks}",) for ticks in (1, 2)},
}  # fmt: skip
"""Assignments of deviations of heater, load, gauge and actuators, for which no loop is compiled."""
_LOADS: Final = {
    ESTIMATED: CONDITIONS[ESTIMATED], "load 5 % above its measurement": BESIDE_THE_BOX["load as announced +5 %"],
}  # fmt: skip
_PLANTS: Final = (*(f"{name} {sign}10 %" for name in PARAMETERS for sign in "-+"), "sensor bias")
UNKNOWN_LOADS: Final = {
    f"{plant}, {load}, noise": (*CONDITIONS[plant], *changes, *NOISE)
    for plant in _PLANTS for load, changes in _LOADS.items()
}  # fmt: skip
"""Conditions that combine a deviating plant, an unmeasured load and noise; those above have one of them alone."""
LINEAR: Final = {
    "linear plant": (), "linear plant, sensor noise": NOISE, "linear plant, sensor bias": CONDITIONS["sensor bias"],
}  # fmt: skip
"""Controls: the model itself in the place of the plant."""
LEFT_OUT: Final = (
    "Sensors that fail are not tried; of several errors at once a plant that is off with a load that is not known. "
    "The load of the cold box is never forecast. "
    "Costs and bands are of true values under bias, and of measured ones, which are noisy, under noise. "
    f"Under '{ESTIMATED}' no period can be interrupted: rules run without."
)


CONTROLLER_CONDITIONS: Final = {**CONDITIONS, **BESIDE_THE_BOX, **UNKNOWN_LOADS, **LINEAR}
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
    """Results of one controller under one condition, hour by hour; shape (n,) each."""

    costs: Series
    """J_BF."""
    level_pct: Series
    """Share of the time that L1 is outside its band."""
    temperature_pct: Series
    """Share of the time that T5 is outside its band."""

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
"""Results by condition and controller."""


def controllers_remarks(options: StudyOptions, found: Found) -> list[str]:
    """Return what the controllers hold and at which cost, and the tables of it."""
    names = [load.name for load in loads(options, *options.hours, usual=1)]
    return [holding(found), comparison(found), LEFT_OUT, _costs(found), _own_ratios(found, names)]


def holding(found: Found) -> str:
    """Say which bands each controller holds, and under which conditions it does not."""
    lines = []
    for controller in CONTROLLERS:
        lost = [f"{condition} ({found[condition, controller].outside})" for condition in CONTROLLER_CONDITIONS
                if not found[condition, controller].holds]  # fmt: skip
        held = f"- `{controller}` in {len(CONTROLLER_CONDITIONS) - len(lost)} of {len(CONTROLLER_CONDITIONS)}"
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
            for condition in CONTROLLER_CONDITIONS
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
    for condition in CONTROLLER_CONDITIONS:
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


def _own_ratios(found: Found, names: list[str]) -> str:
    rows = []
    for condition in CONTROLLER_CONDITIONS:
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
        over = {
            controller: {condition: over_own(found, condition, controller)[0] for condition in CONTROLLER_CONDITIONS}
            for controller in CONTROLLERS
        }
        what = f"J_BF over that of the same controller on the plant {NOMINAL} (1)"
        result.figures["controllers on plants that are off"] = ratio_rows(over, what, 8.0, 0.27, 3)
        result.remarks += controllers_remarks(options, found)
        tables = {key: np.array([(run.J_BF, run.J_open_mean) for run in some]) for key, some in runs.items()}
        for column, cost in enumerate(("J_BF", "open loop")):
            costs = {key: values[:, column] for key, values in tables.items()}
            ratios = _over_reference(costs)
            by_policy = {policy: {condition: row[policy] for condition, row in ratios.items()} for policy in POLICIES}
            what = f"{cost} over that of {REFERENCE} (1)"
            result.figures[f"policies under {cost}"] = ratio_rows(by_policy, what, 6.5, 0.13, 3)
            result.remarks.append(_table(ratios, cost, costs))
        return result


def _cases(options: StudyOptions) -> Iterator[Case]:
    hours = loads(options, *options.hours, usual=1)
    for controller, (period_s, assignments) in CONTROLLERS.items():
        for condition, changes in CONTROLLER_CONDITIONS.items():
            procedure = Procedure.LINEAR_PLANT if condition in LINEAR else Procedure.CONFIGURED
            for load in hours:
                request = load.request(period_s, *assignments, *changes, procedure=procedure)
                yield condition, controller, load, request
    options = replace(options, ticks=options.ticks or 3600)  # fifteen minutes
    hours = loads(options, *options.hours, usual=1)
    for condition, changes in RULE_CONDITIONS.items():
        for policy, (period_s, assignments) in POLICIES.items():
            own = [one for one in assignments if one != INTERRUPT or condition != ESTIMATED]
            for load in hours:
                yield condition, policy, load, load.request(period_s, *changes, *own)


Ratios = dict[str, dict[str, Interval]]


def _over_reference(costs: dict[tuple[str, str], Series]) -> Ratios:
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
