"""The solver cut at its loop over the counts: a call starts it or does one iteration, and what it needs is kept."""

from typing import Final, TypeVar

from coldloop_rig.plc_export.tree.nodes import (
    Assign,
    Declare,
    Expression,
    For,
    Function,
    If,
    Invoke,
    Kind,
    Literal,
    Name,
    Operation,
    Statement,
    walk,
)
from coldloop_rig.plc_export.tree.subset import UnfitKernelError

Node = TypeVar("Node")
START: Final = Name(Kind.BOOL, "start")
FINISH: Final = Name(Kind.BOOL, "finish")
CALLS: Final = Name(Kind.INT, "calls")
ONE_MORE: Final = Operation(Kind.INT, "+", (CALLS, Literal(Kind.INT, 1)))
COUNT: Final = "count"
"""The parameter of the inner kernel that says how many iterations it does."""


def one_iteration_a_call(solve: Function, *, keep: bool = False) -> Function:
    """Return the solver as a function that starts where `start` is true and else does one iteration.

    The solver calls `follow` at its end, which declares its state and then has a loop over counts: in each round,
    unless the count is reached, it calls a kernel that does `count` iterations, and keeps the answer so far.

    Args:
        solve: The solver.
        keep: Keep these answers, and return what the solver does.

    Raises:
        UnfitKernelError: The solver is built otherwise.
    """
    follow = _only(solve, [each for each in solve.body if isinstance(each, Invoke)][-1:])
    _refuse_other_names(solve, follow)
    within = follow.function.body
    loop = _only(solve, [each for each in within if isinstance(each, For) and _calls(each)])
    behind = _only(solve, [each for each in loop.body if isinstance(each, If)])
    iteration = tuple(map(_one_at_a_time, behind.body))
    kept = _kept(loop, behind) if keep else ()
    needed = {node.name for node in walk((iteration, kept)) if isinstance(node, Name)}
    state = tuple(each for each in within if isinstance(each, Declare) and each.variable.name in needed)
    start = (*solve.body[: solve.body.index(follow)], *state)
    if keep:
        start, iteration = (*start, Declare(CALLS)), (*iteration, Assign(CALLS, ONE_MORE))
        kept = (*kept, *within[within.index(loop) + 1 :])
    body = (If(START, start, iteration), *kept)
    parameters = tuple(each for each in solve.parameters if each.name in {node.name for node in walk(body)
                                                                          if isinstance(node, Name)})  # fmt: skip
    summary = "Start where `start` is true, else do one iteration, or none once the profile is stationary."
    results = follow.function.results if keep else ()
    return Function("solver", solve.source, summary, (START, *parameters), results=results, body=body)


def an_answer_in_calls(solve: Function, method: str) -> Function:
    """Return the optimiser's step (3) as a function that starts, does one iteration, or where `finish` is true ends.

    Args:
        solve: It, as one function.
        method: Its parameter that the solver is called with.

    Raises:
        UnfitKernelError: It is not a call of a solver with something before and behind.
    """
    called = _only(solve, [each for each in solve.body if isinstance(each, Invoke)
                           and method in {node.name for node in each.arguments if isinstance(node, Name)}])  # fmt: skip
    solver, place = one_iteration_a_call(called.function, keep=True), solve.body.index(called)
    given = {each.name: value for each, value in zip(called.function.parameters, called.arguments, strict=True)}
    arguments = (START, *(given[each.name] for each in solver.parameters[1:]))
    body = (
        If(START, solve.body[:place], ()),
        If(Operation(Kind.BOOL, "not", (FINISH,)), (Invoke(solver, arguments, called.results),), ()),
        If(FINISH, solve.body[place + 1 :], ()),
    )
    summary = "Pose the problem where `start` is true, make the sequence where `finish` is, else do one iteration."
    return Function("answer", solve.source, summary, (START, FINISH, *solve.parameters), body=body)


def _kept(loop: For, behind: If) -> tuple[Statement, ...]:
    """Return what keeps the answer at the counts that are reached in a call."""
    count = behind.condition.operands[0]  # type: ignore[union-attr]
    reached = Operation(Kind.BOOL, "==", (count, CALLS))
    stores = tuple(each for each in loop.body if each is not behind)
    return (For(loop.variable, loop.start, loop.stop, loop.step, (If(reached, stores, ()),)),)


def _calls(loop: For) -> bool:
    return any(isinstance(node, Invoke) for node in walk(loop.body))


def _one_at_a_time(statement: Statement) -> Statement:
    """Return a call with the number of iterations made one; any other statement as it is."""
    if not isinstance(statement, Invoke):
        return statement
    parameters = statement.function.parameters
    arguments: tuple[Expression, ...] = tuple(
        Literal(Kind.INT, 1) if parameter.name == COUNT else argument
        for parameter, argument in zip(parameters, statement.arguments, strict=True)
    )
    return Invoke(statement.function, arguments, statement.results)


def _refuse_other_names(solve: Function, follow: Invoke) -> None:
    if follow.arguments[: len(follow.function.parameters)] != follow.function.parameters:
        raise _unfit(solve)


def _only(solve: Function, found: list[Node]) -> Node:
    if len(found) != 1:
        raise _unfit(solve)
    return found[0]


def _unfit(solve: Function) -> UnfitKernelError:
    return UnfitKernelError(f"{solve.source}: the solver is not a start and a loop over counts, as its slices need")
