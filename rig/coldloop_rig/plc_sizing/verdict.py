"""Whether a controller runs on a PLC and how often it may update, in one sentence."""

from math import floor
from typing import NamedTuple

from coldloop_optimizer_plc.budget import PlcBudget
from coldloop_optimizer_plc.qp.problem import PredictiveProblem
from coldloop_optimizer_plc.settings import ProgramSettings
from coldloop_rig.plc_sizing.memory import Footprint
from coldloop_rig.plc_sizing.profile import PlcProfile
from coldloop_rig.plc_sizing.reference_plc import reference_curve

ROUNDING = 1e-9
MANY = 1000
"""Variables from which on their number is not said."""


class Capacity(NamedTuple):
    """Up to how many variables a PLC has memory and time, where all else grows with them."""

    by_memory: float
    by_time: float
    """For one iteration in the longest updating period."""


def power_of(profile: PlcProfile, size: int) -> float:
    """Return P, the speed of a PLC over the reference PLC's, in loops as long as a problem has variables."""
    return profile.flops_per_s(size) / reference_curve().flops_per_s(size)


def capacity(size: int, needed: Footprint, memory_bytes: int, budget: PlcBudget) -> Capacity:
    """Return what a PLC has room and time for.

    Matrices grow with the square of the variables and the time of an iteration with their third power, as rows grow
    with them; the estimator, the sequences and the preparation stay.

    Args:
        size: Variables of the problem.
        needed: What it takes in memory.
        memory_bytes: The PLC's.
        budget: Of the PLC and the solver.
    """
    fixed = needed.estimator + needed.sequence
    room, time_s = (
        max(memory_bytes - fixed, 0),
        max(budget.longest_ticks * budget.times.tick_s - budget.times.slots, 0.0),
    )
    return Capacity(
        size * (room / (needed.total - fixed)) ** (1 / 2), size * (time_s / budget.times.iteration) ** (1 / 3)
    )


def fits(profile: PlcProfile, program: ProgramSettings, problem: PredictiveProblem, needed: Footprint) -> bool:
    """Return whether a PLC has memory and time for a problem; as `verdict`."""
    budget = PlcBudget(program.budget, program.iteration_s)
    return min(capacity(problem.size, needed, profile.memory_bytes, budget)) + ROUNDING >= problem.size


def verdict(profile: PlcProfile, program: ProgramSettings, problem: PredictiveProblem, needed: Footprint) -> str:
    """Return what a PLC can do with a problem; `program` has the power of this PLC.

    Args:
        profile: The PLC.
        program: Solver and budget.
        problem: The problem in single precision.
        needed: What it takes in memory.
    """
    budget = PlcBudget(program.budget, program.iteration_s)
    limits = capacity(problem.size, needed, profile.memory_bytes, budget)
    problem_text = f"the problem ({problem.size} variables, {len(problem.Gamma)} rows) with {program.solver_name}"
    if not fits(profile, program, problem, needed):
        lacks = []
        if limits.by_memory < problem.size:
            lacks.append(f"it takes {needed.total:,} of {profile.memory_bytes:,} bytes")
        if limits.by_time < problem.size:
            lacks.append(budget.too_slow())
        return f"{profile.name}: {problem_text} does not fit: {', and '.join(lacks)}."
    memory = f"{needed.total / 1e3:,.0f} of {profile.memory_bytes / 1e3:,.0f} kB"
    longest, shortest = budget.ladder[-1], budget.ladder[0]
    first, then = sorted((("memory", limits.by_memory), ("time", limits.by_time)), key=lambda one: one[1])
    shortest_s, longest_s = (ticks * budget.times.tick_s for ticks in (shortest, longest))
    return (
        f"{profile.name}: {problem_text} fits, in {memory}; it updates every {shortest_s:g} s at the "
        f"soonest ({_iterations(budget, shortest)}), {_iterations(budget, longest)} in {longest_s:g} s; "
        f"{first[0]} gives way first, with more than {_variables(first[1])} variables ({then[0]} with "
        f"more than {_variables(then[1])}){_calls(profile, budget)}."
    )


def _iterations(budget: PlcBudget, ticks: int) -> str:
    count = budget.iterations(ticks)
    return f"{count} iteration{'s' if count != 1 else ''}"


def _variables(count: float) -> str:
    return f"{floor(count + ROUNDING)}" if count < MANY else f"{MANY}"


def _calls(profile: PlcProfile, budget: PlcBudget) -> str:
    longest_s, what = max((budget.times.iteration, "an iteration"), (budget.times.preparation, "the preparation"))
    if profile.cycle_s is None or longest_s <= profile.cycle_s:
        return ""
    calls = -int(-longest_s // profile.cycle_s)
    return (
        f"; {what} takes {longest_s:.3g} s and its cycle monitoring stops a program after "
        f"{profile.cycle_s:g} s: divide it over {calls} calls, or set that higher"
    )
