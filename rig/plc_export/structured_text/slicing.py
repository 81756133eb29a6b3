"""The solver cut at its loop over the counts: a call starts it or does one iteration, and what it needs is kept."""

from typing import Final, TypeVar

from rig.plc_export.tree.nodes import (
    Declare,
    Expression,
    For,
    Function,
    If,
    Invoke,
    Kind,
    Literal,
    Name,
    Statement,
    walk,
)
from rig.plc_export.tree.subset import UnfitKernelError

Node = TypeVar("Node")
START: Final = Name(Kind.BOOL, "start")
COUNT: Final = "count"
"""The parameter of the inner kernel that says how many iterations it does."""


def one_iteration_a_call(solve: Function) -> Function:
    """Return the solver as a function that starts where `start` is true and else does one iteration.

    The solver calls `follow` at its end, which declares its state and then has a loop over counts: in each round,
    unless the count is reached, it calls a kernel that does `count` iterations.

    Raises:
        UnfitKernelError: The solver is built otherwise.
    """
    follow = _only(solve, [each for each in solve.body if isinstance(each, Invoke)][-1:])
    _refuse_other_names(solve, follow)
    loop = _only(solve, [each for each in follow.function.body if isinstance(each, For) and _calls(each)])
    behind = _only(solve, [each for each in loop.body if isinstance(each, If)])
    iteration = tuple(map(_one_at_a_time, behind.body))
    needed = {node.name for node in walk(iteration) if isinstance(node, Name)}
    state = tuple(each for each in follow.function.body if isinstance(each, Declare) and each.variable.name in needed)
    start = (*solve.body[: solve.body.index(follow)], *state)
    body = (If(START, start, iteration),)
    parameters = tuple(each for each in solve.parameters if each.name in {node.name for node in walk(body)
                                                                          if isinstance(node, Name)})  # fmt: skip
    summary = "Start where `start` is true, else do one iteration, or none once the profile is stationary."
    return Function("solver", solve.source, summary, (START, *parameters), body=body)


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
