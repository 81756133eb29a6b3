"""How far rules of the updating period are from what could be reached: controls, a fast PLC, hindsight."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from rig.figures.plot import COLOURS
from rig.studies.drawing import legend_outside, panels
from rig.studies.hindsight import PERIODS_S, SETTLING_S, WIDTH, Objective
from rig.studies.intervals import Interval, gap_closed, mean_ratio
from rig.studies.paper.updating_period import ADAPTIVE, INTERRUPT, RULE
from rig.studies.request import Outcome, Procedure, RunRequest, Series
from rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, first_and_fresh, loads
from rig.text_tables import markdown_table

FIXED_S: Final = (1.0, 1.5, 2.5, 3.5, 5.0)
INTERRUPTED_S: Final = (1.0, 1.5, 2.5)


class PeriodRule(NamedTuple):
    """A way to choose the updating period."""

    period_s: float
    assignments: tuple[str, ...] = ()
    procedure: Procedure = Procedure.CONFIGURED


LITERAL: Final = "Algorithm 1"
OWN: Final = ("contraction rule", "contraction rule, interrupt")
CONSTANT: Final = {
    **{f"fixed {period:g} s": PeriodRule(period) for period in FIXED_S},
    **{f"fixed {period:g} s, interrupt": PeriodRule(period, (INTERRUPT,)) for period in INTERRUPTED_S},
}
RULES: Final = {
    LITERAL: PeriodRule(ADAPTIVE),
    "Algorithm 1, interrupt": PeriodRule(ADAPTIVE, (INTERRUPT,)),
    OWN[0]: PeriodRule(ADAPTIVE, (f"{RULE}contraction",)),
    OWN[1]: PeriodRule(ADAPTIVE, (f"{RULE}contraction", INTERRUPT)),
}
INSTANTS_S: Final = (0.25, 1.0, 2.5, 5.0)
FAST: Final = {
    f"infinitely fast PLC, every {period:g} s": PeriodRule(period, (), Procedure.INFINITELY_FAST)
    for period in INSTANTS_S
}
SEARCHED: Final = {
    Objective.CLOSED_LOOP: "beam search for J_BF",
    Objective.OPEN_LOOP: "beam search for the open loop",
}
ORACLES: Final = {
    SEARCHED[Objective.CLOSED_LOOP]: PeriodRule(ADAPTIVE, (INTERRUPT,), Procedure.BEST_CLOSED_LOOP),
    SEARCHED[Objective.OPEN_LOOP]: PeriodRule(ADAPTIVE, (INTERRUPT,), Procedure.BEST_OPEN_LOOP),
    **FAST,
}
WAYS: Final = {**ORACLES, **CONSTANT, **RULES}
NAMES: Final = {Objective.CLOSED_LOOP: "J_BF", Objective.OPEN_LOOP: "mean open-loop cost"}
HALF: Final = 0.5
METHOD: Final = (
    "**Best sequence in hindsight**: the least of everything that was run, constant periods and rules, and of a beam "
    "search. The search cuts the hour at its load steps and "
    f"{SETTLING_S:g} s after each, and takes one of {', '.join(f'{p:g}' for p in PERIODS_S)} s in "
    f"each segment, with interruption at load steps. It keeps {WIDTH} branch for each period that was last taken, that "
    "which costs least so far in the closed loop, for each cost separately. It is the cost of a sequence that exists; "
    "a wider search may find a lower one. **Infinitely fast PLC**: the exact optimum at the estimated state, applied "
    "at once through the control PLC's guard, at instants of different distance; the least of them is what the "
    "gap goes to. It is a reference, not a bound that could be proved. Shares of a gap are sums of logarithms over the "
    "hours, from Algorithm 1 (0) to the oracle (1); intervals are of 95 % over the hours."
)


class OraclesStudy:
    """Rules and controls between Algorithm 1 and the oracles, on both costs."""

    name = "oracles"
    title = "Beyond the paper: rules of the updating period against oracles and controls"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every way in every hour; long runs first."""
        return [_request(load, way) for way in WAYS.values() for load in _hours(options)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare both costs with those of the oracles."""
        result = StudyResult(("load", "way", "J per time", "J_BF"), [], {}, remarks=[METHOD])
        costs: dict[str, dict[str, Outcome]] = {}
        for load in _hours(options):
            runs = {name: outcomes[_request(load, way)] for name, way in WAYS.items()}
            costs[load.name] = runs
            result.rows += [
                (load.name, name, run.indicators.J_open_mean, run.indicators.J_BF) for name, run in runs.items()
            ]
        for title, hours in first_and_fresh(_hours(options)).items():
            for objective in Objective:
                table = cost_table([costs[load.name] for load in hours], objective)
                shares = shares_of_gap(table)
                result.remarks += [
                    _table(f"{title}, {NAMES[objective]}", table, shares),
                    verdict(title, objective, table, shares),
                ]
                result.figures[f"{title}, {NAMES[objective]}"] = _figure(shares, NAMES[objective])
                for name in RULES:
                    what = f"share of the gap closed, {NAMES[objective]}, {title}: {name}"
                    result.values[what] = [shares[name].value]
        return result


def _hours(options: StudyOptions) -> list[Load]:
    return loads(options, *options.hours)


def _request(load: Load, way: PeriodRule) -> RunRequest:
    return load.request(way.period_s, *way.assignments, procedure=way.procedure)


def cost_table(hours: Sequence[Mapping[str, Outcome]], objective: Objective) -> dict[str, Series]:
    """Return the cost of each way in each hour, and what is best in hindsight: as `BEST` and as `FASTEST`."""
    table = {
        name: np.array([getattr(runs[name].indicators, objective) for runs in hours], dtype=float) for name in WAYS
    }
    sequences = [*SEARCHED.values(), *CONSTANT, *RULES]
    table[BEST] = np.min([table[name] for name in sequences], axis=0)
    table[FASTEST] = np.min([table[name] for name in FAST], axis=0)
    return table


BEST: Final = "best sequence"
FASTEST: Final = "infinitely fast PLC, best distance"


def shares_of_gap(table: Mapping[str, Series]) -> dict[str, Interval]:
    """Return the share of the gap between Algorithm 1 and the best sequence that each way closes."""
    return {name: gap_closed(table[name], table[LITERAL], table[BEST]) for name in (*RULES, *CONSTANT)}


def verdict(title: str, objective: Objective, table: Mapping[str, Series], shares: Mapping[str, Interval]) -> str:
    """Say which rules close half of the gap, and the worst hour of this project's against Algorithm 1."""
    closing = [name for name in RULES if shares[name].value >= HALF]
    gap = mean_ratio(table[LITERAL], table[BEST])
    said = (
        f"Half of it is closed by: {', '.join(closing)}." if closing else "**No rule closes half of it.**"
    )  # fmt: skip
    own = [f"{name} {shares[name].text(2)}, worst hour {100 * (worst(table, name) - 1):+.1f} %" for name in OWN]
    return (
        f"{title}, {NAMES[objective]}: Algorithm 1 costs {gap.text()} times the best sequence. {said} This project's "
        f"rules, with the worst hour against Algorithm 1: {'; '.join(own)}."
    )


def worst(table: Mapping[str, Series], name: str) -> float:
    """Return the largest ratio of a way's cost to that of Algorithm 1 in one hour."""
    return float((table[name] / table[LITERAL]).max())


def _table(title: str, table: Mapping[str, Series], shares: Mapping[str, Interval]) -> str:
    header = (
        "way", "over the best sequence", "share of the gap closed, to the best sequence",
        "to the infinitely fast PLC", "worst hour over Algorithm 1", "hours below Algorithm 1",
    )  # fmt: skip
    rows = []
    closed_loop = bool(np.isfinite(table[FASTEST]).all())  # an infinitely fast PLC has no open-loop cost
    for name in (*RULES, *CONSTANT):
        fast = gap_closed(table[name], table[LITERAL], table[FASTEST]).text(2) if closed_loop else ""
        below = str((table[name] < table[LITERAL]).sum())
        over = mean_ratio(table[name], table[BEST]).text()
        rows.append((name, over, shares[name].text(2), fast, f"{worst(table, name):.3f}", below))
    rows += [
        (name, mean_ratio(table[name], table[BEST]).text(), "", "", f"{worst(table, name):.3f}", "")
        for name in (*FAST, FASTEST) if closed_loop
    ]  # fmt: skip
    rows.append((BEST, "1", "1", "", f"{worst(table, BEST):.3f}", ""))
    return markdown_table(header, rows, f"**{title}** ({len(table[LITERAL])} hours)")


def _figure(shares: Mapping[str, Interval], what: str) -> Figure:
    names = list(shares)
    with panels(1, 1, (8.0, 3.6)) as (figure, (place,)):
        for row, name in enumerate(names):
            one = shares[name]
            colour = COLOURS[0] if name in RULES else "#888888"
            place.plot([one.low, one.high], [row, row], color=colour, linewidth=1.4)
            place.plot(one.value, row, "o", color=colour, label={0: "rules", len(RULES): "controls"}.get(row))
        place.axvline(HALF, color=COLOURS[1], linestyle="--", linewidth=0.9, label="half of the gap")
        place.set_yticks(range(len(names)), names)
        place.invert_yaxis()
        place.set_xlabel(f"share of the gap between Algorithm 1 and the best sequence, {what} (1)")
        legend_outside(figure, place)
    return figure
