"""Runs that are known to be the same before they are done: those of a solver that is never cut off.

The computing power of the PLC enters a run in one process with a fixed updating period through one number only, the
iterations that fit into the period. A solver that ended by itself in every period of one run, before that number, does
the same in the run with another number that is large enough: from P = 7 on, qpOASES does the same run again.
"""

from collections.abc import Iterable, Mapping, Sequence

from coldloop_optimizer_plc.budget import BudgetSettings, PlcBudget
from coldloop_optimizer_plc.solvers import make_solver
from coldloop_rig.studies.request import Outcome, Procedure, RunRequest, decisive_digest
from coldloop_rig.studies.settings import settings_of


def iteration_limit(request: RunRequest) -> int | None:
    """Return the iterations that fit into the updating period of a run, if power enters it by that number alone.

    In a networked run the time of an answer counts as well, with an adaptive period the number is the rule's, and a
    period that a load step cuts off leaves no record of its iterations.
    """
    program = settings_of(request.assignments).optimizer_plc.program
    in_one_process = request.procedure is Procedure.CONFIGURED and not request.networked
    if not in_one_process or not request.updating_period_s or program.interrupting_load_step_w:
        return None
    budget = PlcBudget(program.budget, make_solver(program).tau_1_s)
    return budget.iterations(round(request.updating_period_s / program.process.tick_s))


def never_cut_off(outcome: Outcome, limit: int) -> bool:
    """Return whether each solve of a run ended by itself before `limit` iterations."""
    return max(outcome.updates["iterations"], default=limit) < limit


def families(requests: Iterable[RunRequest]) -> list[list[RunRequest]]:
    """Return the requests in groups that differ by their limit of iterations only, the largest limit first."""
    groups: dict[str, list[tuple[int, RunRequest]]] = {}
    for request in dict.fromkeys(requests):
        limit = iteration_limit(request)
        key = request.digest if limit is None else _digest_without_budget(request)
        groups.setdefault(key, []).append((limit or 0, request))
    return [
        [request for _, request in sorted(group, key=lambda one: one[0], reverse=True)] for group in groups.values()
    ]


def same_run(
    request: RunRequest, done: Sequence[RunRequest], outcomes: Mapping[RunRequest, Outcome]
) -> RunRequest | None:
    """Return which of the requests `done` of its family had the outcome that `request` would have, if one is known."""
    limit = iteration_limit(request)
    if limit is None:
        return None
    for other in done:
        if iteration_limit(other) == limit or never_cut_off(outcomes[other], limit):
            return other
    return None


def _digest_without_budget(request: RunRequest) -> str:
    return decisive_digest(request, settings_of(request.assignments).with_program(budget=BudgetSettings()))
