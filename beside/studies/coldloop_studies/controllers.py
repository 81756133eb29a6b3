"""Controllers in the closed loop: the classical loops as the baseline, solvers and rules, plants that are off.

The classical loops stand beside MPC; solvers under fixed periods and under rules are compared with each other, and
controllers and rules on plants and sensors that differ from the model.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple, Self

import numpy as np

from coldloop.process.cold_box import TICK_S
from coldloop_rig.plc_sizing.intervals import Interval, interval_of_mean, mean_ratio
from coldloop_rig.results.recording import Indicators
from coldloop_rig.text_tables import markdown_table
from coldloop_studies import drawing, study
from coldloop_studies.request import Procedure, RunRequest, Series
from coldloop_studies.study import NOISE, PROGRAM, TUNED, Load, Outcomes, Study, StudyOptions, StudyResult, loads
from coldloop_studies.updating_period import ADAPTIVE, INTERRUPT, RULE, Policy

CASES: Final = {
    "classical loops": (2.5, ("control_plc.driver=classical",)),
    "MPC, 2.5 s": (2.5, ()),
    "MPC, adaptive": (0.0, ()),
}


def _classical_runs(load: Load) -> dict[str, RunRequest]:
    return {label: load.request(period, *assignments) for label, (period, assignments) in CASES.items()}


def _classical(found: study.Found[str]) -> StudyResult:
    result = StudyResult(("load", "case", "J_BF", "L1 outside (%)", "T5 outside (%)"), [], {})
    table = []
    for load, runs in found:
        rows = [(run.indicators.J_BF, *run.indicators.outside_band_pct.values()) for run in runs.values()]
        result.rows += [(load.name, label, *row) for label, row in zip(CASES, rows, strict=True)]
        table.append((load.name, *(f"{cost:,.0f} ({L1:.1f} / {T5:.1f})" for cost, L1, T5 in rows)))
        result.note("J_BF of the classical loops over MPC at 2.5 s", rows[0][0] / rows[1][0])
    result.figures["closed-loop cost"] = drawing.cost_bars(result, CASES, 0.25, logarithmic=True)
    caption = "**J_BF (time outside the bands, %: L1 / T5)**"
    result.remarks.append(markdown_table(("hour", *CASES), table, caption))
    return result


CLASSICAL: Final = study.study_of_loads(
    "classical",
    "The classical loops as a baseline (section IV-A)",
    lambda options: loads(options, *"abcdef"),
    _classical_runs,
    _classical,
)
"""Two PI loops against MPC."""
SOLVERS: Final = {
    "ODE": (),
    "ODE as printed": (f"{PROGRAM}preset=as-printed",),
    "interior point": (f"{PROGRAM}solver=interior-point",),
    "hybrid": (f"{PROGRAM}solver=hybrid",),
    "hybrid as printed": (f"{PROGRAM}solver=hybrid", f"{PROGRAM}preset=as-printed"),
}
WAYS: Final = (
    Policy("Algorithm 1", ADAPTIVE),
    Policy("Algorithm 1, interrupt", ADAPTIVE, (INTERRUPT,)),
    Policy("contraction rule, interrupt", ADAPTIVE, (f"{RULE}contraction", INTERRUPT)),
    *(Policy(f"fixed {period:g} s", period) for period in (1.0, 1.5, 2.5, 5.0)),
    Policy("fixed 1.5 s, interrupt", 1.5, (INTERRUPT,)),
)
REFERENCE: Final = ("ODE", "Algorithm 1")
"""Solver and way that the others are compared with."""


def _contest(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
    """Compare both costs with those of the ODE-based solver under Algorithm 1, hour by hour."""
    result = StudyResult(("load", "solver", "way", "tau_u mean (s)", "J per time", "J_BF"), [], {})
    over = f"over that of {' under '.join(REFERENCE)}"
    for title, hours in _groups(options).items():
        found = {
            (solver, way.label): [outcomes[request].indicators for request in _under(hours, solver, way)]
            for solver in SOLVERS for way in WAYS
        }  # fmt: skip
        result.rows += [
            (load.name, *key, runs[place].tau_u_mean, runs[place].J_open_mean, runs[place].J_BF)
            for place, load in enumerate(hours) for key, runs in found.items()
        ]  # fmt: skip
        for indicator, cost in (("J_BF", "J_BF"), ("J_open_mean", "mean open-loop cost")):
            costs = {key: np.array([getattr(run, indicator) for run in runs]) for key, runs in found.items()}
            means = {key: mean_ratio(values, costs[REFERENCE]) for key, values in costs.items()}
            worst = {key: float((values / costs[REFERENCE]).max()) for key, values in costs.items()}
            keys = {way.label: [(solver, way.label) for solver in SOLVERS] for way in WAYS}
            rows = [(label, *(f"{means[key].text()} ({worst[key]:.2f})" for key in row)) for label, row in keys.items()]
            caption = (
                f"**{title}, {cost}** {over}, geometric mean of {len(hours)} hours with its 95 % interval; in "
                "brackets the worst hour."
            )
            result.remarks.append(markdown_table(("way", *SOLVERS), rows, caption))
            drawn = {solver: {way.label: means[solver, way.label] for way in WAYS} for solver in SOLVERS}
            result.figures[f"{title}, {cost}"] = drawing.ratio_rows(
                drawn, f"{cost} {over} (1)", 4.0, 0.16, len(SOLVERS)
            )
            for key, mean in means.items():
                result.values[f"{cost} over ODE, Algorithm 1, {title}: {', '.join(key)}"] = [mean.value]
    return result


CONTEST: Final = Study(
    "contest",
    "Beyond the paper: solvers and rules in the closed loop",
    lambda options: [
        request
        for solver in SOLVERS
        for way in WAYS
        for hours in _groups(options).values()
        for request in _under(hours, solver, way)
    ],
    _contest,
)
"""Every solver under every way to choose the updating period."""


def _groups(options: StudyOptions) -> dict[str, list[Load]]:
    """Return the first draws, and those that no constant was chosen on."""
    return study.first_and_fresh(loads(options, *options.hours, usual=6))


def _under(hours: Sequence[Load], solver: str, way: Policy) -> list[RunRequest]:
    return [load.request(way.period_s, *SOLVERS[solver], *way.assignments) for load in hours]


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
    "sensor noise doubled": study.noise(2.0),
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
    costs, ratios = [], []
    for condition in CONTROLLER_CONDITIONS:
        under = [found[condition, controller] for controller in CONTROLLERS]
        means = (interval_of_mean(one.costs.tolist(), 0.0).brief() for one in under)
        costs.append((condition, *(f"{mean}; {one.outside}" for mean, one in zip(means, under, strict=True))))
        own = (over_own(found, condition, controller) for controller in CONTROLLERS)
        worst = ((mean.brief(), by_hour.max(), names[int(by_hour.argmax())]) for mean, by_hour in own)
        ratios.append((condition, *(f"{mean} ({most:.3g}: {name})" for mean, most, name in worst)))
    header = ("condition", *CONTROLLERS)
    what_costs = (
        f"**J_BF; share of the time outside the bands (%: L1 / T5)**, means of {len(found[NOMINAL, DEFAULT].costs)} "
        "runs, J_BF with its 95 % interval."
    )
    what_ratios = (
        f"**J_BF over that of the same controller on the plant {NOMINAL}**, geometric mean of the hours with its 95 % "
        "interval; in brackets the worst hour."
    )
    tables = markdown_table(header, costs, what_costs), markdown_table(header, ratios, what_ratios)
    return [holding(found), comparison(found), LEFT_OUT, *tables]


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


def over_own(found: Found, condition: str, controller: str) -> tuple[Interval, Series]:
    """Return the J_BF of a controller over its own on the plant as its model: geometric mean, and hour by hour."""
    costs, own = found[condition, controller].costs, found[NOMINAL, controller].costs
    return mean_ratio(costs, own), costs / own


RULE_CONDITIONS: Final = {**CONDITIONS, "rate limit by elapsed time": ("limits.rate_reference=elapsed",)}
USUAL: Final = "fixed 2.5 s"
"""Policy that the others are compared with."""
POLICIES: Final = {
    "fixed 1 s": (1.0, ()),
    USUAL: (2.5, ()),
    "fixed 5 s": (5.0, ()),
    "fixed 1.5 s, interrupt": (1.5, (INTERRUPT,)),
    "Algorithm 1": (ADAPTIVE, ()),
    "contraction rule, interrupt": (ADAPTIVE, (f"{RULE}contraction", INTERRUPT)),
}
COLUMNS: Final = (
    "condition", "load", "controller or rule", "minutes", "J per time", "L1 outside (%)", "T5 outside (%)", "J_BF",
)  # fmt: skip


def _robustness(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
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
    result.figures["controllers on plants that are off"] = drawing.ratio_rows(over, what, 8.0, 0.27, 3)
    result.remarks += controllers_remarks(options, found)
    for indicator, cost in (("J_BF", "J_BF"), ("J_open_mean", "open loop")):
        costs = {key: np.array([getattr(run, indicator) for run in some]) for key, some in runs.items()}
        ratios = {
            policy: {each: mean_ratio(costs[each, policy], costs[each, USUAL]) for each in RULE_CONDITIONS}
            for policy in POLICIES
        }
        what = f"{cost} over that of {USUAL} (1)"
        result.figures[f"policies under {cost}"] = drawing.ratio_rows(ratios, what, 6.5, 0.13, 3)
        result.remarks.append(_policy_table(ratios, cost, costs))
    return result


ROBUSTNESS: Final = Study(
    "robustness",
    "Beyond the paper: plants that differ from their model",
    lambda options: [request for *_, request in _cases(options)],
    _robustness,
)
"""Controllers on plants that are off; on the same ones fixed periods and rules, under the paper's preset."""


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


def _policy_table(
    ratios: Mapping[str, Mapping[str, Interval]], cost: str, costs: Mapping[tuple[str, str], Series]
) -> str:
    others = [policy for policy in POLICIES if policy != USUAL]
    caption = (
        f"**Preset `paper`: {cost}** over that of {USUAL} under the same condition, geometric mean of "
        f"{len(costs[NOMINAL, USUAL])} runs with its 95 % interval; before it, that of {USUAL} over its own without "
        "mismatch."
    )
    rows = []
    for condition in RULE_CONDITIONS:
        own = mean_ratio(costs[condition, USUAL], costs[NOMINAL, USUAL])
        rows.append((condition, own.text(2), *(ratios[policy][condition].text() for policy in others)))
    return markdown_table(("condition", USUAL, *others), rows, caption)
