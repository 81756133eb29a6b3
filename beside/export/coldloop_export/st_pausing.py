"""Blocks that pause: a call does a bounded number of operations, and the next call resumes there.

The solver is cut at its loop over the counts first: a call starts it or does one iteration, and what it needs is kept.
A block with more operations than a piece may have becomes steps, each of which is such a piece: `STEP` says which is
next, and all variables keep their values, as those of function blocks do. `remaining` is what a call may still do: each
piece takes its operations from it, and no further one begins once it is used up. So a call exceeds what it was given by
less than a piece.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Final, TypeVar

from coldloop_export import counting, tree
from coldloop_export.tree import Assign, Block, Call, Function, If, Invoke, Kind, Literal, Name, Operation, Statement

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
    if follow.arguments[: len(follow.function.parameters)] != follow.function.parameters:
        raise _unfit(solve)
    within = follow.function.body
    loop = _only(solve, [each for each in within if isinstance(each, tree.For) and _calls(each)])
    behind = _only(solve, [each for each in loop.body if isinstance(each, If)])
    iteration = tuple(map(_one_at_a_time, behind.body))
    kept: tuple[Statement, ...] = ()
    if keep:  # the answer, at the counts that are reached in a call
        reached = Operation(Kind.BOOL, "==", (behind.condition.operands[0], CALLS))  # type: ignore[union-attr]
        stores = tuple(each for each in loop.body if each is not behind)
        kept = (replace(loop, body=(If(reached, stores, ()),)),)
    needed = {node.name for node in tree.walk((iteration, kept)) if isinstance(node, Name)}
    state = tuple(each for each in within if isinstance(each, tree.Declare) and each.variable.name in needed)
    start = (*solve.body[: solve.body.index(follow)], *state)
    if keep:
        start, iteration = (*start, tree.Declare(CALLS)), (*iteration, Assign(CALLS, ONE_MORE))
        kept = (*kept, *within[within.index(loop) + 1 :])
    body = (If(START, start, iteration), *kept)
    parameters = tuple(each for each in solve.parameters if each.name in {node.name for node in tree.walk(body)
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


def _calls(loop: tree.For) -> bool:
    return any(isinstance(node, Invoke) for node in tree.walk(loop.body))


def _one_at_a_time(statement: Statement) -> Statement:
    """Return a call with the number of iterations made one; any other statement as it is."""
    if not isinstance(statement, Invoke):
        return statement
    given = zip(statement.function.parameters, statement.arguments, strict=True)
    arguments = tuple(ONE if parameter.name == COUNT else argument for parameter, argument in given)
    return replace(statement, arguments=arguments)


def _only(solve: Function, found: list[Node]) -> Node:
    if len(found) != 1:
        raise _unfit(solve)
    return found[0]


def _unfit(solve: Function) -> tree.UnfitKernelError:
    return tree.UnfitKernelError(
        f"{solve.source}: the solver is not a start and a loop over counts, as its slices need"
    )


PIECE: Final = 500
"""Operations of a piece, at most."""
# Kernels have no names with points: these are no names of theirs.
REMAINING: Final = Name(Kind.INT, "remaining.")
"""Parameter: operations that a call may still do."""
ANEW: Final = Name(Kind.BOOL, "anew.")
"""Input: begin, rather than go on."""
BUSY: Final = Name(Kind.BOOL, "busy.")
"""Output: there is more to do."""
STEP: Final = Name(Kind.INT, "next.step")
CALL_ANEW: Final = Name(Kind.BOOL, "call.anew")
"""Whether the next call of a block that pauses is the first."""
ONE, TRUE = Literal(Kind.INT, 1), Literal(Kind.BOOL, 1)
END: Final = 0
"""The number that no step has."""


class Pausing:
    """Makes blocks pause.

    Args:
        entries: Blocks that have steps however little they do.
    """

    def __init__(self, entries: Collection[Block]) -> None:
        self.entries = entries
        self._known: dict[Block, Block] = {}
        self._bounds: dict[Block, float] = {}

    def block(self, block: Block) -> Block:
        """Return the block that does the same: with steps where it has much to do, else in one piece.

        One without operations is as it was; any other has `REMAINING` among what it shares.

        Raises:
            UnfitKernelError: A statement takes more operations than a piece has.
        """
        if block not in self._known:
            self._bounds[block] = self.bound(block.body)
            self._known[block] = self._made(block)
        return self._known[block]

    def _made(self, block: Block) -> Block:
        bound = self._bounds[block]
        if not bound and block not in self.entries:
            return block
        if bound <= PIECE and block not in self.entries:
            return replace(block, shared=(*block.shared, REMAINING), body=self.charged(block.body))
        steps = Steps(self, block.source)
        first = steps.entry(block.body, END)
        going_on = Operation(Kind.BOOL, "and", (_compared(STEP, "!=", END), _compared(REMAINING, ">", 0)))
        body = (
            If(ANEW, (goto(first),), ()), tree.While(going_on, (tree.Switch(STEP, steps.cases()),)),
            Assign(BUSY, _compared(STEP, "!=", END)),
        )  # fmt: skip
        return replace(
            block, inputs=(*block.inputs, ANEW), shared=(*block.shared, REMAINING), outputs=(*block.outputs, BUSY),
            variables=(*block.variables, STEP, CALL_ANEW, *steps.kept), body=body,
        )  # fmt: skip

    def bound(self, statements: Sequence[Statement]) -> float:
        """Return how many operations statements take at most; infinity where that is not known."""
        return sum(map(self._bound, statements))

    def _bound(self, statement: Statement) -> float:
        match statement:
            case If(condition, body, other):
                return operations_in(condition) + max(self.bound(body), self.bound(other))
            case tree.Count():
                each = self.bound(statement.body)
                before = operations_in((statement.first, statement.last))
                return before + (each and each * max(1, most_rounds(statement)))
            case tree.While(condition, body):
                return math.inf if operations_in(condition) + self.bound(body) else 0
            case Call(block, arguments):
                self.block(block)
                return operations_in(arguments) + self._bounds[block]
        return operations_in(statement)

    def charged(self, statements: Sequence[Statement]) -> tuple[Statement, ...]:
        """Return statements that take what they do from what is left."""
        found: list[Statement] = []
        own = 0
        for statement in statements:
            before, behind = self._charged(statement)
            own += before
            if may_return(statement):
                found += charge(own)
                own = 0
            found += behind
        return (*found, *charge(own))

    def _charged(self, statement: Statement) -> tuple[int, tuple[Statement, ...]]:
        """Return the operations that are to be taken once, and the statement that takes its others itself."""
        match statement:
            case If(condition, body, other):
                return operations_in(condition), (If(condition, self.charged(body), self.charged(other)),)
            case tree.Count(_, first, last, _, body) if all(
                isinstance(each, Assign) for each in body
            ) and not operations_in((first, last)):
                return 0, (*charge(operations_in(body), rounds(statement)), statement)
            case tree.Count(_, first, last, _, body):
                return operations_in((first, last)), (replace(statement, body=self.charged(body)),)
            case Call(_, arguments):
                return operations_in(arguments), (self.called(statement),)
        return operations_in(statement), (statement,)

    def called(self, call: Call) -> Call:
        """Return the call of the block that is made of the one that is called."""
        block = self.block(call.block)
        given = ((REMAINING, REMAINING),) if REMAINING in block.shared else ()
        anew = ((ANEW, CALL_ANEW),) if ANEW in block.inputs else ()
        count = len(call.block.inputs)
        return Call(block, (*call.arguments[:count], *anew, *call.arguments[count:], *given), call.results)


class Steps:
    """The steps of one block, whose kernel has a source; `pausing` knows the blocks that it calls."""

    def __init__(self, pausing: Pausing, source: str) -> None:
        self.pausing, self.source = pausing, source
        self.kept: list[Name] = []
        """Variables that are computed once: last values of loops, arguments of calls."""
        self._cases: dict[int, tuple[Statement, ...]] = {}

    def cases(self) -> tuple[tuple[int, tuple[Statement, ...]], ...]:
        """Return the steps by their numbers."""
        return tuple(sorted(self._cases.items()))

    def entry(self, statements: Sequence[Statement], after: int) -> int:
        """Return the step that does statements, with those behind it, and goes on with the step `after`."""
        if not statements:
            return after
        number = self._reserved()
        count = self._at_once(statements)
        done = self.pausing.charged(statements[:count])
        rest = statements[count:]
        decided = operations_in(rest[0].condition) if rest and isinstance(rest[0], If) else 0
        if not rest:
            leading: tuple[Statement, ...] = (goto(after),)
        elif self._is_at_once(rest[0]) or (count and self.pausing.bound(statements[:count]) + decided > PIECE):
            leading = (goto(self.entry(rest, after)),)
        else:
            leading = tuple(self._cut(rest[0], rest[1:], after))
        self._cases[number] = (*done, *leading)
        return number

    def _reserved(self) -> int:
        self._cases[len(self._cases) + 1] = ()
        return len(self._cases)

    def _at_once(self, statements: Sequence[Statement]) -> int:
        """Return how many statements are one piece."""
        bound = 0.0
        for place, statement in enumerate(statements):
            bound += self.pausing.bound((statement,))
            if bound > PIECE or not self._is_at_once(statement):
                return place
        return len(statements)

    def _is_at_once(self, statement: Statement) -> bool:
        return not may_return(statement) and self.pausing.bound((statement,)) <= PIECE

    def _cut(self, statement: Statement, behind: Sequence[Statement], after: int) -> Iterator[Statement]:
        """Yield what leads to the steps of a statement that is more than a piece, and to those behind it."""
        match statement:
            case tree.Count():
                yield from self._loop(statement, behind, after)
            case tree.While(condition, body):
                head = self._reserved()
                inner, following = self.entry(body, head), self.entry(behind, after)
                decided = If(condition, (goto(inner),), (goto(following),))
                self._cases[head] = (*charge(operations_in(condition)), decided)
                yield goto(head)
            case If(condition, body, other):
                following = self.entry(behind, after)
                ways = (goto(self.entry(each, following)) for each in (body, other))
                yield from charge(operations_in(condition))
                yield If(condition, *((each,) for each in ways))
            case Call():
                yield from self._called(statement, behind, after)
            case tree.Return():
                yield goto(END)
            case _:
                raise tree.UnfitKernelError(
                    f"{self.source}: a statement of more than {PIECE} operations; write it as several"
                )

    def _called(self, call: Call, behind: Sequence[Statement], after: int) -> Iterator[Statement]:
        """Yield what leads to a call; its arguments stay as they are now, as it may change what they are made of."""
        count = len(call.block.inputs)
        given: list[tuple[Name, tree.Expression]] = []
        for parameter, value in call.arguments[:count]:
            kept = value
            if not isinstance(value, Literal) and not (isinstance(value, Name) and "." not in value.name):
                kept = self._keeping(value.type)  # type: ignore[arg-type]
                yield Assign(kept, value)
            given.append((parameter, kept))
        yield from charge(operations_in(call.arguments))
        place, follows = replace(call, arguments=(*given, *call.arguments[count:])), self.pausing.block(call.block)
        if ANEW not in follows.inputs:
            yield goto(self.entry((place, *behind), after))
            return
        again = self._reserved()
        made = self.pausing.called(place)
        self._cases[again] = (tree.PausingCall(made, CALL_ANEW, BUSY, (goto(self.entry(behind, after)),)),)
        yield from (Assign(CALL_ANEW, TRUE), goto(again))

    def _keeping(self, kind: Kind) -> Name:
        self.kept.append(Name(kind, f"kept.step.{len(self.kept)}"))
        return self.kept[-1]

    def _loop(self, loop: tree.Count, behind: Sequence[Statement], after: int) -> Iterator[Statement]:
        head, last = self._reserved(), loop.last
        variable, first, step = loop.variable, loop.first, loop.step
        if not isinstance(last, Literal):
            last = self._keeping(Kind.INT)
            yield Assign(last, loop.last)
        next_round = Assign(variable, Operation(Kind.INT, "+", (variable, Literal(Kind.INT, step))))
        more = Operation(Kind.BOOL, "<=" if step > 0 else ">=", (variable, last))
        if all(map(self._is_at_once, loop.body)) and self.pausing.bound(loop.body) <= PIECE:
            going_on = Operation(Kind.BOOL, "and", (more, _compared(REMAINING, ">", 0)))
            rounds_at_once = tree.While(going_on, (*self.pausing.charged(loop.body), next_round))
            following = self.entry(behind, after)
            over = If(Operation(Kind.BOOL, "not", (more,)), (goto(following),), ())
            self._cases[head] = (rounds_at_once, over)
        else:
            inner = self.entry((*loop.body, next_round), head)
            self._cases[head] = (If(more, (goto(inner),), (goto(self.entry(behind, after)),)),)
        yield from charge(operations_in((first, loop.last)))
        yield from (Assign(variable, first), goto(head))


def may_return(statement: Statement) -> bool:
    """Return whether there is an end of the block in a statement."""
    return any(isinstance(node, tree.Return) for node in tree.walk(statement))


def goto(step: int) -> Assign:
    """Return what makes a step the next one."""
    return Assign(STEP, Literal(Kind.INT, step))


def charge(operations: int, times: tree.Expression = ONE) -> tuple[Statement, ...]:
    """Return what takes operations from what is left."""
    if not operations:
        return ()
    taken: tree.Expression = Operation(Kind.INT, "*", (Literal(Kind.INT, operations), times))
    if isinstance(times, Literal):
        taken = Literal(Kind.INT, operations * times.value)
    return (Assign(REMAINING, Operation(Kind.INT, "-", (REMAINING, taken))),)


def operations_in(node: object) -> int:
    """Return the operations in what is computed once; both operands of a logical operator are."""
    return sum(isinstance(each, Operation) and each.type is Kind.REAL and each.operator in counting.COUNTED
               for each in tree.walk(node))  # fmt: skip


def rounds(loop: tree.Count) -> tree.Expression:
    """Return how often a loop is gone through."""
    first, last, step = loop.first, loop.last, loop.step
    if isinstance(first, Literal) and isinstance(last, Literal):
        return Literal(Kind.INT, max(0, (last.value - first.value) // step + 1))
    ends = (last, first) if step > 0 else (first, last)
    between: tree.Expression = Operation(Kind.INT, "-", ends)
    if abs(step) > 1:
        between = Operation(Kind.INT, "//", (between, Literal(Kind.INT, abs(step))))
    return Operation(Kind.INT, "max", (Operation(Kind.INT, "+", (between, ONE)), Literal(Kind.INT, 0)))


def most_rounds(loop: tree.Count) -> float:
    """Return how often a loop is gone through at most.

    Where its ends are not numbers, its variable is an index in every round; it is infinity if that is none.
    """
    count = rounds(loop)
    if isinstance(count, Literal):
        return count.value
    in_every_round = [each.condition if isinstance(each, If) else each for each in loop.body
                      if isinstance(each, Assign | If)]  # fmt: skip
    lengths = [length for node in tree.walk(tuple(in_every_round)) if isinstance(node, tree.Element)
               and isinstance(node.array.type, tree.ArrayType)
               for index, length in zip(node.indices, node.array.type.shape, strict=True)
               if index == loop.variable]  # fmt: skip
    return min(lengths, default=math.inf)


def _compared(name: Name, sign: str, number: int) -> Operation:
    return Operation(Kind.BOOL, sign, (name, Literal(Kind.INT, number)))
