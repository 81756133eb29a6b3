"""Decision and constraint instants that a problem needs: sets compared by their cost in the loop and on a PLC.

Each set is judged by the loop of an infinitely fast PLC (`run_ideal_loop`), so that the parametrisation alone is
judged and not the time that its iterations take. The loss is J_BF over that of the fullest set tried.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.cosim.one_process import run_ideal_loop
from coldloop_rig.figures.plot import COLOURS, DASHES, INK
from coldloop_rig.plc_sizing import budget, intervals, operations
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import aligned
from coldloop_studies.drawing import legend_outside, panels

KNOTS: Final = (2, 3, 4, 5, 6, 7, 8, 10, 12)
"""Numbers of decision instants that are tried; there are twice as many constraint instants."""
FULLEST: Final = 24
"""Number of decision instants of the reference set, with which the others are compared."""
ENOUGH: Final = 1.01
"""A loss up to which the smallest set is proposed."""


class Judged(NamedTuple):
    """A set of instants and what it costs."""

    label: str
    design: ControlDesign
    variables: int
    rows: int
    condition: float
    """Condition number of Phi."""
    flops: float
    """Operations of an iteration of the configured solver, zeros left out."""
    memory: int
    """Bytes in single precision."""
    iterations: int
    """Done in a sampling period by a PLC of the configured power, whose time for one goes with its operations."""
    costs: tuple[float, ...]
    """J_BF of each load."""


def spread(count: int, horizon: int) -> tuple[int, ...]:
    """Return so many instants from 1 to the horizon, each about as much later in proportion; fewer if it is short."""
    wanted = np.geomspace(1.0, horizon, min(count, horizon))
    instants = [1]
    for instant in wanted[1:]:
        instants.append(max(instants[-1] + 1, round(float(instant))))
    excess = instants[-1] - horizon
    return tuple(instants if excess <= 0 else range(1, horizon + 1)[-count:])


def candidates(design: ControlDesign) -> dict[str, ControlDesign]:
    """Return the sets to compare: the configured one first, the fullest last."""
    found = {"configured": design}
    for knots in (*(knots for knots in KNOTS if knots < design.horizon), min(FULLEST, design.horizon)):
        sets = {
            "decision_instants": spread(knots, design.horizon),
            "constraint_instants": spread(2 * knots, design.horizon),
        }
        found[f"{knots} and {len(sets['constraint_instants'])}"] = design.model_copy(update=sets)
    return found


def judged(settings: Settings, names: Sequence[str], done: Callable[[int, int], None]) -> list[Judged]:
    """Return the sets with what they cost under some loads; `done` is called with the number of sets done and of all.

    Raises StudyError if the loop costs nothing.
    """
    sets, ticks = candidates(settings.optimizer_plc.program.design), settings.process.ticks_per_sample
    found: list[Judged] = []
    for number, (label, design) in enumerate(sets.items()):
        done(number, len(sets))
        tried = settings.with_program(design=design)
        program, (problem, prediction) = tried.optimizer_plc.program, budget.problem_of(tried)
        flops = operations.SOLVERS[program.solver].operations(budget.counted_sizes(problem)[1]).flops
        plc = PlcBudget(program.budget, program.iteration_s * flops / (found[0].flops if found else flops))
        costs = tuple(
            intervals.loop_cost(tried, name, intervals.ADAPTIVE, partial(run_ideal_loop, tried, ticks=ticks))
            for name in names
        )
        intervals.require_costs(costs)
        condition = float(np.linalg.cond(problem.Phi.astype(float)))
        memory = budget.footprint(problem, budget.estimator_memory(prediction, program.estimator), program.solver).total
        iterations = plc.iterations(ticks) if plc.is_enough(ticks) else 0
        rows = len(problem.Gamma)
        found.append(Judged(label, design, problem.size, rows, condition, flops, memory, iterations, costs))
    return found


def losses(found: Sequence[Judged]) -> list[float]:
    """Return J_BF of each set over that of the fullest: the geometric mean over the loads."""
    return [intervals.geometric_mean(np.array(one.costs) / np.array(found[-1].costs)) for one in found]


def proposed(found: Sequence[Judged]) -> Judged:
    """Return the set of the fewest variables whose loss is small enough; the fullest if there is none."""
    enough = [one for one, loss in zip(found, losses(found), strict=True) if loss <= ENOUGH]
    return min(enough or [found[-1]], key=lambda one: (one.variables, one.rows))


def table(found: Sequence[Judged], names: Sequence[str]) -> str:
    """Return the comparison as text, and the lines of a configuration with the set that is proposed."""
    columns = ("variables", "rows", "condition", "operations", "iterations", "kB")
    rows: list[tuple[str, ...]] = [("decisions and constraints", *columns, *names, "loss")]
    rows += [
        (one.label, f"{one.variables}", f"{one.rows}", f"{one.condition:.2g}", f"{one.flops:,.0f}",
         f"{one.iterations}", f"{one.memory / 1e3:.0f}", *(f"{cost:.4g}" for cost in one.costs), f"{loss:.3f}")
        for one, loss in zip(found, losses(found), strict=True)
    ]  # fmt: skip
    period_s = found[0].design.process.sampling_period_s
    return (
        f"{aligned(rows, numbers=True)}iterations: in {period_s:g} s on the configured PLC\n\n"
        f"the smallest with a loss up to {ENOUGH:g}:\n{configuration(found)}"
    )


def configuration(found: Sequence[Judged]) -> str:
    """Return the proposed set as a configuration file."""
    design = proposed(found).design
    return (
        "[optimizer_plc.program.design]\n"
        f"decision_instants = {list(design.decision_instants)}\n"
        f"constraint_instants = {list(design.constraint_instants)}\n"
    )


def drawn(found: Sequence[Judged], names: Sequence[str]) -> Figure:
    """Return loss and iterations over the number of variables; the configured and the proposed set are named."""
    sets = sorted(found[1:], key=lambda one: one.variables)
    sizes = [one.variables for one in sets]
    with panels(2, 1, 4.6, sharex=True) as (figure, (loss, iterations)):
        for name, colour, cost, fullest in zip(
            names, COLOURS, zip(*(one.costs for one in sets), strict=True), found[-1].costs, strict=False
        ):
            loss.plot(sizes, np.divide(cost, fullest), color=colour, linestyle=DASHES[colour], marker=".",
                      label=f"load {name}")  # fmt: skip
        loss.axhline(ENOUGH, color=INK, linewidth=0.8, linestyle=":", label=f"small enough, {ENOUGH:g}")
        iterations.plot(sizes, [one.iterations for one in sets], color=COLOURS[0], marker=".")
        lost = dict(zip([one.label for one in found], losses(found), strict=True))
        for label, one, marker in (("configured", found[0], "s"), ("proposed", proposed(found), "o")):
            for axes, value in ((loss, lost[one.label]), (iterations, one.iterations)):
                axes.plot(one.variables, value, color=INK, marker=marker, markerfacecolor="none", markersize=9,
                          linestyle="", label=label)  # fmt: skip
        loss.set_ylabel("loss: J_BF over the fullest (1)")
        iterations.set_ylabel(f"iterations in {found[0].design.process.sampling_period_s:g} s (1)")
        iterations.set(xlabel="variables (1)", xscale="log")  # the fullest set has several times those of the others
        marks = [mark for mark in (10, 20, 50, 100, 200, 500) if sizes[0] <= mark <= sizes[-1]]
        iterations.set_xticks(marks, map(str, marks))
        iterations.minorticks_off()
        legend_outside(figure, loss)
    return figure
