"""Cost against updating period, fixed and adapted (paper, figure `tu_opt`), and what the literal rule needs to work."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coldloop_rig.figures.plot import ACCENT, INK, THIRD
from coldloop_rig.plc_sizing.intervals import geometric_mean
from coldloop_rig.text_tables import Cell, markdown_table
from coldloop_studies import drawing, study, trajectories
from coldloop_studies.request import Outcome, RunRequest, Series
from coldloop_studies.study import NOISE, PROGRAM, Load, Outcomes, StudyOptions, StudyResult, first_and_fresh, loads

NINE: Final = tuple(drawing.published_periods()["a"]["tau_u_s"].tolist())
"""Periods of the paper, s."""
SHORTER: Final = (0.5, 0.75)
"""Periods below the paper's, s, where the optimum of a fast solver may lie."""
FEW: Final = (1.0, 2.5, 5.0)
ADAPTIVE: Final = 0.0
RULE: Final = f"{PROGRAM}adaptive.rule="
INTERRUPT: Final = f"{PROGRAM}interrupting_load_step_w=10"


@dataclass(frozen=True)
class Policy:
    """A way to choose the updating period."""

    label: str
    period_s: float
    assignments: tuple[str, ...] = ()


LITERAL: Final = Policy("Algorithm 1", ADAPTIVE)
OWN: Final = Policy("contraction rule", ADAPTIVE, (f"{RULE}contraction",))
OWN_INTERRUPT: Final = Policy("contraction rule, interrupt", ADAPTIVE, (f"{RULE}contraction", INTERRUPT))
CONTROL: Final = Policy("fixed 2.5 s, interrupt", 2.5, (INTERRUPT,))
POLICIES: Final = (LITERAL, OWN, OWN_INTERRUPT, CONTROL, Policy("fixed 1.5 s, interrupt", 1.5, (INTERRUPT,)))
RESPONDING: Final = (LITERAL, OWN, OWN_INTERRUPT)
"""Policies whose response to load steps is reported."""


@dataclass(frozen=True)
class PolicyVariant:
    """Another setting in which rules and fixed periods are compared."""

    label: str
    assignments: tuple[str, ...]
    periods: tuple[float, ...] = FEW
    policies: tuple[Policy, ...] = (LITERAL,)


SLOW: Final = (1.0, 2.5)
AS_PRINTED: Final = PolicyVariant("as printed", (f"{PROGRAM}preset=as-printed",), NINE)
VARIANTS: Final = (
    PolicyVariant(
        "rate limit scaled by tau_u / 5 s",
        ("limits.rate_reference=elapsed",),
        policies=(LITERAL, OWN_INTERRUPT, CONTROL),
    ),
    PolicyVariant("measurement noise", NOISE, policies=(LITERAL, OWN_INTERRUPT, CONTROL)),
    PolicyVariant("fast gradient", (f"{PROGRAM}solver=fast-gradient", f"{PROGRAM}fast_gradient.tau_1_s=0.25"), SLOW),
    PolicyVariant("ODE starting slowly", (f"{PROGRAM}ode.cost_scale=1e-8", f"{PROGRAM}ode.growth=2.0"), SLOW),
    AS_PRINTED,
)


COLUMNS: Final = ("variant", "load", "policy", "tau_u mean (s)", "J per time", "J_BF", "tau_u mean per update (s)")


def _updating_period_requests(options: StudyOptions) -> list[RunRequest]:
    main: list[RunRequest] = []
    for load in loads(options, *options.hours):
        main += [*_fixed_runs(load, options).values(), *_policy_runs(load).values()]
    return main + [request for *_, runs in _variants(options) for request in runs.values()]


def _updating_period(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
    result = StudyResult(COLUMNS, [], {})
    hours: dict[str, _Hour] = {}
    for load in loads(options, *options.hours):
        fixed = {period: outcomes[run] for period, run in _fixed_runs(load, options).items()}
        policies = {label: outcomes[run] for label, run in _policy_runs(load).items()}
        hours[load.name] = _Hour(load, fixed, policies)
        labelled = {f"fixed {period:g} s": run for period, run in fixed.items()} | policies
        result.rows += [_row("", load.name, label, run) for label, run in labelled.items()]
    for variant, load, runs in _variants(options):
        result.rows += [_row(variant.label, load.name, label, outcomes[run]) for label, run in runs.items()]
    groups = first_and_fresh(hour.load for hour in hours.values())
    first, fresh = (
        {load.name: hours[load.name] for load in groups.get(title, ())} for title in ("hours", "fresh hours")
    )
    result.figures["cost against period"] = _figure(first, fresh)
    responses = {p.label: [(hour.policies[p.label], hour.load) for hour in hours.values()] for p in RESPONDING}
    result.figures["period after a load step"] = trajectories.response_figure(responses)
    _judge(result, "hours", first)
    if fresh:
        _judge(result, "fresh hours", fresh)
    if printed := [list(runs.values()) for variant, _, runs in _variants(options) if variant is AS_PRINTED]:
        costs = ([outcomes[one].indicators.J_open_mean for one in runs[: len(NINE)]] for runs in printed)
        share = _share(map(is_inside, costs))
        result.values["interior optimum from 1 to 5 s, share of hours, as printed"] = [share]
    for policy in (LITERAL, OWN_INTERRUPT):
        found = trajectories.response(responses[policy.label], policy.label)
        result.values |= {name: [value] for name, value in found.items()}
    result.remarks += [_table("Hours of the first draw", first), *([_table("Fresh hours", fresh)] if fresh else [])]
    result.remarks += [trajectories.response_table(responses), _variant_table(result)]
    return result


UPDATING_PERIOD: Final = study.Study(
    "updating-period", "Cost against updating period (figure tu_opt)", _updating_period_requests, _updating_period
)
"""Six hours, nine periods and the rules; further draws of the six families are hours never used for tuning."""


def _row(variant: str, load: str, policy: str, run: Outcome) -> tuple[Cell, ...]:
    i = run.indicators
    return variant, load, policy, i.tau_u_mean, i.J_open_mean, i.J_BF, i.tau_u_mean_per_update


def _fixed_runs(load: Load, options: StudyOptions) -> dict[float, RunRequest]:
    periods = FEW if options.quick else (*SHORTER, *NINE) if load.draw == 1 else NINE
    return {period: load.request(period) for period in periods}


def _policy_runs(load: Load) -> dict[str, RunRequest]:
    return {policy.label: load.request(policy.period_s, *policy.assignments) for policy in POLICIES}


def _variants(options: StudyOptions) -> Iterator[tuple[PolicyVariant, Load, dict[str, RunRequest]]]:
    """Yield the runs of each variant under the first draw of each hour, by policy; a quick study has none."""
    for load in () if options.quick else loads(options, *options.hours):
        for variant in VARIANTS if load.draw == 1 else ():
            policies = (*(Policy(f"fixed {period:g} s", period) for period in variant.periods), *variant.policies)
            yield (
                variant,
                load,
                {one.label: load.request(one.period_s, *variant.assignments, *one.assignments) for one in policies},
            )


class _Hour(NamedTuple):
    load: Load
    fixed: Mapping[float, Outcome]
    policies: Mapping[str, Outcome]

    def nine(self, indicator: str = "J_open_mean") -> Series:
        """Costs of the paper's periods."""
        return np.array([getattr(run.indicators, indicator) for p, run in self.fixed.items() if p in NINE])

    def cost(self, label: str) -> float:
        return self.policies[label].indicators.J_open_mean


def _judge(result: StudyResult, which: str, hours: Mapping[str, _Hour]) -> None:
    some = list(hours.values())
    values = result.values
    grids = {"1 to 5 s": [h.nine() for h in some]}
    if all(period in h.fixed for h in some for period in SHORTER):
        grids["0.5 to 5 s"] = [np.array([run.indicators.J_open_mean for run in h.fixed.values()]) for h in some]
    for grid, costs_by_hour in grids.items():
        values[f"interior optimum from {grid}, share of {which}"] = [_share(map(is_inside, costs_by_hour))]
        ends = [max(costs[0], costs[-1]) / costs.min() for costs in costs_by_hour]
        values[f"worst end over best from {grid}, smallest of {which}"] = [float(min(ends))]
    for policy in POLICIES:
        costs = np.array([h.cost(policy.label) for h in some])
        best, mean = np.array([(h.nine().min(), h.nine().mean()) for h in some]).T
        closed = np.array([h.policies[policy.label].indicators.J_BF for h in some])
        usual = np.array([h.fixed[2.5].indicators.J_BF for h in some])
        of = f"{policy.label}, {which}"
        values[f"better than the mean fixed period, share: {of}"] = [_share(costs < mean)]
        values[f"best of all, share: {of}"] = [_share(costs < best)]
        values[f"within 2 % of the best fixed period, share: {of}"] = [_share(costs <= 1.02 * best)]
        values[f"cost over that of the best fixed period, geometric mean: {of}"] = [geometric_mean(costs / best)]
        values[f"J_BF over that of fixed 2.5 s, all together: {of}"] = [float(closed.sum() / usual.sum())]
        closed_best = np.array([h.nine("J_BF").min() for h in some])
        values[f"J_BF over that of the best fixed period, geometric mean: {of}"] = [
            geometric_mean(closed / closed_best)
        ]


def is_inside(costs: Sequence[float] | Series) -> bool:
    """Return whether the least is neither the first nor the last."""
    return 0 < int(np.argmin(costs)) < len(costs) - 1


def _share(which: Iterable[bool]) -> float:
    return float(np.mean(list(which)))


def _figure(first: Mapping[str, _Hour], fresh: Mapping[str, _Hour]) -> Figure:
    """Draw each hour in % of its worst of the paper's periods, the paper's points beside it."""

    def draw(name: str, place: Axes) -> None:
        hour = first[name]
        base = hour.nine().max() / 100.0
        periods = list(hour.fixed)
        costs = [run.indicators.J_open_mean / base for run in hour.fixed.values()]
        place.plot(periods, costs, color=INK, marker=".", label="fixed, here")
        place.axhline(hour.cost(LITERAL.label) / base, color=ACCENT, linestyle="--", label="Algorithm 1, here")
        place.axhline(hour.cost(OWN_INTERRUPT.label) / base, color=THIRD, linestyle="-.",
                      label="contraction rule, interrupt")  # fmt: skip
        theirs = drawing.published_periods().get(name)
        if theirs:
            place.plot(theirs["tau_u_s"], theirs["cost_fixed_pct"], ":o", color=INK, markerfacecolor="white",
                       markersize=4, linewidth=0.8, label="fixed, paper")  # fmt: skip
            place.plot(theirs["tau_u_s"], theirs["cost_adaptive_pct"], ":", color=ACCENT, label="Algorithm 1, paper")
        others = [other for other in fresh.values() if other.load.name.startswith((f"{name}@", f"{name}#"))]
        for number, other in enumerate(others):
            label = "" if number else "fixed, other draws"
            scale = other.nine().max() / 100.0
            place.plot(list(other.fixed), [run.indicators.J_open_mean / scale for run in other.fixed.values()],
                       color=INK, alpha=0.25, linewidth=0.8, label=label)  # fmt: skip

    return drawing.hour_panels(list(first), draw, "cost (% of the worst)", (5, 10, 20, 30, 50, 75, 100), 3)


def _table(title: str, hours: Mapping[str, _Hour]) -> str:
    """Return a table: each policy's cost over the best fixed period of the hour, and its rank among the ten."""
    labels = ["fixed 2.5 s", *(policy.label for policy in POLICIES)]
    caption = (
        f"**{title}**: open-loop cost per unit time over that of the best of the nine fixed periods (rank among the "
        "nine and the policy), then J_BF over that of the best of the nine."
    )
    rows: list[tuple[Cell, ...]] = []
    for name, hour in hours.items():
        nine, closed = hour.nine(), hour.nine("J_BF")
        runs = {"fixed 2.5 s": hour.fixed[2.5], **hour.policies}
        cells = [
            f"{runs[label].indicators.J_open_mean / nine.min():.3f} "
            f"({1 + int((nine < runs[label].indicators.J_open_mean * (1 - 1e-12)).sum())}) "
            f"{runs[label].indicators.J_BF / closed.min():.3f}"
            for label in labels
        ]
        periods = [period for period in hour.fixed if period in NINE]
        best = periods[int(np.argmin(nine))]
        rows.append((name, f"{best:g}", f"{nine.mean() / nine.min():.3f}", *cells))
    return markdown_table(("hour", "best fixed (s)", "mean of nine", *labels), rows, caption)


def _variant_table(result: StudyResult) -> str:
    """Return a table of the variants: policies over the best fixed period tried, geometric means over the hours."""
    caption = (
        "**Variants** (first draws): costs over those of the best fixed period tried, geometric mean of the hours."
    )
    lines: list[tuple[Cell, ...]] = []
    rows = [row for row in result.rows if row[0]]
    for variant in dict.fromkeys(row[0] for row in rows):
        mine = [row for row in rows if row[0] == variant]
        names = list(dict.fromkeys(row[1] for row in mine))
        best = {
            (name, i): min(float(row[i]) for row in mine if row[1] == name and str(row[2]).startswith("fixed")
                           and "interrupt" not in str(row[2]))
            for name in names for i in (4, 5)
        }  # fmt: skip
        for policy in dict.fromkeys(row[2] for row in mine):
            ratios = np.array([[float(row[4]) / best[row[1], 4], float(row[5]) / best[row[1], 5], float(row[3])]
                               for row in mine if row[2] == policy])  # fmt: skip
            open_loop, closed = np.exp(np.log(ratios[:, :2]).mean(axis=0))
            lines.append((variant, policy, f"{open_loop:.3f}", f"{closed:.3f}", f"{ratios[:, 2].mean():.2f}"))
    header = ("variant", "policy", "open loop", "J_BF", "mean tau_u, by time (s)")
    return markdown_table(header, lines, caption)
