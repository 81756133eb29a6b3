"""Harsh problems: what solvers make of the same bad guess in the same PLC time."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from coldloop_rig.studies.paired_run import HARSH, INTERIOR_POINT_ITERATIONS
from coldloop_rig.studies.paired_sums import watch
from coldloop_rig.studies.paper.open_loop import LABELS
from coldloop_rig.studies.request import Outcome, Procedure, RunRequest, Series
from coldloop_rig.studies.solver_runs import throttled
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, loads
from coldloop_rig.text_tables import markdown_table

DRAWS: Final = 3
"""Of six hours: they have more than 300 harsh problems."""


def harsh_loads(options: StudyOptions) -> list[Load]:
    """Return the draws."""
    return loads(options, *"abcdef", usual=DRAWS)


def _solvers() -> list[str]:
    return [name for name in LABELS if name != "daqp"]  # one solve of DAQP is longer than all of these times


def harsh_request(load: Load, solver: str) -> RunRequest:
    """Return the request for one solver on the harsh problems of a load, at P = 1."""
    return throttled(load, solver, 1.0, procedure=Procedure.HARSH_PROBLEMS)


def harsh_requests(options: StudyOptions) -> list[RunRequest]:
    """Return all of them."""
    return [harsh_request(load, solver) for load in harsh_loads(options) for solver in _solvers()]


def harsh_ratios(options: StudyOptions, outcomes: Outcomes) -> dict[str, dict[int, Series]]:
    """Return the costs of all harsh problems over the lowest: by solver and by iterations of the interior-point solver.

    Raises:
        StudyError: A profile costs less than the optimum.
    """
    found = {}
    for solver in _solvers():
        runs = [outcomes[harsh_request(load, solver)] for load in harsh_loads(options)]
        found[solver] = {
            k: np.concatenate([_ratios(run, k, solver) for run in runs]) for k in INTERIOR_POINT_ITERATIONS
        }
    return found


def _ratios(run: Outcome, k: int, solver: str) -> Series:
    cost = run.column(f"after_{k}")
    watch(run, "lowest", cost, f"harsh problems, {solver}")
    ratios: Series = cost / run.column("lowest")
    return ratios


def harsh_values(ratios: Mapping[str, Mapping[int, Series]]) -> dict[str, list[float]]:
    """Return median and worst by name, and how many problems there were."""
    values: dict[str, list[float]] = {}
    for solver, by_count in ratios.items():
        for k, found in by_count.items():
            if len(found):
                name = f"{LABELS[solver]}, in the time of {k} interior-point iterations"
                values[f"J over the lowest of harsh problems, median: {name}"] = [float(np.median(found))]
                values[f"J over the lowest of harsh problems, worst: {name}"] = [float(found.max())]
    counts = [len(found) for found in next(iter(ratios.values())).values()]
    values["number of harsh problems"] = [float(counts[0])]
    return values


def harsh_table(options: StudyOptions, outcomes: Outcomes) -> str:
    """Return medians and worst ratios of every solver, with its number of iterations, as Markdown."""
    ratios = harsh_ratios(options, outcomes)
    number = len(next(iter(ratios.values()))[INTERIOR_POINT_ITERATIONS[0]])
    if not number:
        return "No problem was harsh."
    first = harsh_loads(options)
    caption = (
        f"**Harsh problems**: {number} problems of {len(first)} hours whose guess, the shifted profile of the "
        f"converged loop, costs more than {HARSH:g} times the lowest; cost over the lowest, median (worst), after the "
        "PLC time of so many iterations of the interior-point solver; in brackets each solver's own iterations."
    )
    rows = []
    for solver, by_count in ratios.items():
        counts = _counts(outcomes, first, solver)
        cells = [
            f"{np.median(found):.4g} ({found.max():.3g}) [{counts[k]:.0f}]" for k, found in by_count.items()
        ]  # fmt: skip
        rows.append((LABELS[solver], *cells))
    return markdown_table(("solver", *(f"time of {k}" for k in INTERIOR_POINT_ITERATIONS)), rows, caption)


def _counts(outcomes: Outcomes, drawn: list[Load], solver: str) -> dict[int, float]:
    with_some = next(run for load in drawn if len((run := outcomes[harsh_request(load, solver)]).column("lowest")))
    return {k: float(with_some.column(f"count_{k}")[0]) for k in INTERIOR_POINT_ITERATIONS}
