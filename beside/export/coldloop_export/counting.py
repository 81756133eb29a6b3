"""Operations of exported calls, counted by executing the typed tree: as Python that adds them up.

Additions, subtractions, multiplications, divisions, roots, powers and logarithms of numbers with a point count one
each; comparisons, minima, maxima, signs, conversions and what is done with integers count nothing.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_control_plc.output_limits import GuardState, Limits, beginning
from coldloop_export import golden, tree
from coldloop_export.golden import ITERATIONS, Array, Call, GoldenCall, GoldenUpdate, GoldenVector, GuardKernels
from coldloop_export.tree import ArrayType, Declare, Expression, For, Function, Kind, Operation, Return, Statement
from coldloop_optimizer_plc import computing_settings, decisions, scheme, settings
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.linear_algebra import real_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Costs
from coldloop_optimizer_plc.solvers.ode import OdeMethod, ode_solver
from coldloop_rig.plc_sizing.plc import CallCost

COUNTED: Final = {"+", "-", "*", "/", "sqrt", "power", "log"}
INTEGERS: Final = {Kind.INT: np.int64, Kind.UNSIGNED: np.int64, Kind.BOOL: np.bool_}
KINDS: Final = [Kind.REAL, *INTEGERS]
OPERATORS: Final = {
    "not": "(not {0})", "negative": "(-{0})", "power": "({0} ** {1})", "sqrt": "np.sqrt({0})", "abs": "abs({0})",
    "log": "_log({0})", "copysign": "np.copysign({0}, {1})", "round": "np.rint({0})", "single": "_single({0})",
    "min": "min({0}, {1})", "max": "max({0}, {1})",  # the first of two equal ones, as in the kernels
    **{name: f"np.{name}({{0}})" for name in ("isfinite", "isinf", "isnan")},
}  # fmt: skip


class CountedProgram:
    """Functions that can be called, and what their calls have taken so far.

    Args:
        functions: Callees before their callers.
        real: Single or double precision.
    """

    def __init__(self, functions: Iterable[Function], real: type[np.floating] = np.float32) -> None:
        self._count = [0]
        self._known: dict[str, Any] = {
            "np": np, "SimpleNamespace": SimpleNamespace, "_n": self._count, "_log": _log, "_copy": _copied,
            "_part": _part, "_of": self._of, "_r": real, "_t": [real, *INTEGERS.values()],
            "_single": lambda value: real(np.float32(value)),
        }  # fmt: skip
        printer = _Printer(real)
        for function in functions:
            exec("\n".join(printer.lines(function)), self._known)  # noqa: S102 text of this file

    def _of(self, count: int, value: object) -> object:
        self._count[0] += count
        return value

    def __getitem__(self, name: str) -> Callable[..., Any]:
        """Return a function: its arguments, arrays for results, and it returns those that are numbers."""
        called: Callable[..., Any] = self._known[name]
        return called

    def operations(self) -> int:
        """Return the operations since this was asked for."""
        count, self._count[0] = self._count[0], 0
        return count

    def noting(self, name: str) -> list[int]:
        """Return a list that gets the operations of each further call of a function."""
        called, found = self[name], list[int]()

        def noted(*arguments: Any) -> Any:  # noqa: ANN401 arguments of any function
            before = self._count[0]
            result = called(*arguments)
            found.append(self._count[0] - before)
            return result

        self._known[name] = noted
        return found


def _log(value: np.float32) -> np.float32:
    return np.float32(math.log(value)) if value > 0 else np.float32(math.nan if value < 0 else -math.inf)


def _copied(target: Any, source: Any) -> None:  # noqa: ANN401 records
    for name in target.dtype.names:
        target[name] = source[name]


def _part(array: NDArray[Any], offset: int, shape: tuple[int, ...]) -> NDArray[Any]:
    return array.reshape(-1)[offset : offset + math.prod(shape)].reshape(shape)


class _Printer(tree.TreePrinter):
    """Prints functions as Python."""

    truth, kinds, operators = ("False", "True"), dict.fromkeys(Kind, ""), OPERATORS

    def lines(self, function: Function) -> Iterator[str]:
        """Yield the lines of a function."""
        arrays = (each for each in function.results if isinstance(each.type, ArrayType))
        numbers = "".join(f"{each.name}, " for each in function.results if isinstance(each.type, Kind))
        self._end = f"return ({numbers})"
        yield f"def {function.name}({', '.join(each.name for each in (*function.parameters, *arrays))}):"
        yield from self._body(function.body)
        yield f"    {self._end}"

    def _statement(self, statement: Statement) -> Iterator[str]:  # noqa: C901 one case a statement
        if count := operations_in(statement):
            yield f"_n[0] += {count}"
        match statement:
            case Declare(tree.Name(ArrayType(kind, shape), name), _):
                yield f"{name} = np.zeros({shape}, _t[{KINDS.index(kind)}])"
            case Declare(variable, value):
                yield f"{variable.name} = {self.expression(value or tree.Literal(variable.type, 0))}"  # type: ignore[arg-type]
            case tree.Assign(target, value):
                text = self.expression(target)
                place = text.removeprefix("int(").removesuffix(")") if text.startswith("int(") else text
                yield f"{place} = {self.expression(value)}"
            case tree.Point(variable, part):
                yield f"{variable.name} = {self.expression(part)}"
            case tree.Make(variable, parts):
                listed = ", ".join(f"{name}={self.expression(part)}" for name, part in parts)
                yield f"{variable.name} = SimpleNamespace({listed})"
            case tree.Copy(target, source):
                yield f"_copy({self.expression(target)}, {self.expression(source)})"
            case tree.Invoke(function, arguments, results):
                passed = (*arguments, *(each for each in results if isinstance(each.type, ArrayType)))
                numbers = [each.name for each in results if isinstance(each.type, Kind)]
                to = f"{', '.join(numbers)}, = " if numbers else ""
                yield f"{to}{function.name}({self._listed(passed)})"
            case For(variable, start, stop, step, body):
                yield f"for {variable.name} in range({self._listed((start, stop))}, {step}):"
                yield from self._body(body)
            case tree.While(condition, body):
                yield f"while {self._conditional(condition)}:"
                yield from self._body(body)
            case tree.If(condition, body, other):
                yield from self._nested(f"if {self.expression(condition)}:", body, "    pass")
                yield from self._nested("else:", other, "    pass")
            case Return(value):
                yield f"return {self.expression(value)}" if value else self._end

    def literal(self, value: float) -> str:
        """Return a number with a point."""
        return f"_r({'np.' if not math.isfinite(value) else ''}{float(value)!r})"

    def expression(self, expression: Expression) -> str:  # noqa: C901, PLR0911 one case a kind of expression
        """Return an expression, with parentheses around each operation."""
        match expression:
            case tree.Name(_, name):
                return name
            case tree.Field(_, record, name):
                return f"{self.expression(record)}.{name}"
            case tree.View(ArrayType(_, shape), array, offset):
                return f"_part({self._listed((array, offset))}, {shape})"
            case tree.Item(_, rows, index):
                return f"{self.expression(rows)}[{self.expression(index)}]"
            case tree.Member(kind, struct, name):
                return integer(kind, f"{self.expression(struct)}[{name!r}]")
            case tree.Element(kind, array, indices):
                return integer(kind, f"{self.expression(array)}[{self._listed(indices)}]")
            case Operation(_, "and" | "or" as name, (one, other)):
                return f"({self.expression(one)} {name} {self._conditional(other)})"
            case tree.Select(_, condition, one, other):
                return f"({self._conditional(one)} if {self.expression(condition)} else {self._conditional(other)})"
            case tree.Convert(kind, operand):
                return f"{'_r' if kind is Kind.REAL else 'int'}({self.expression(operand)})"
            case tree.Invocation(_, function, arguments):
                return f"{function.name}({self._listed(arguments)})"
        return super().expression(expression)

    def _listed(self, expressions: Iterable[Expression]) -> str:
        return ", ".join(map(self.expression, expressions))

    def _conditional(self, expression: Expression) -> str:
        """Return an expression that counts its operations where it is computed."""
        count = operations_in(expression)
        return f"_of({count}, {self.expression(expression)})" if count else self.expression(expression)


def integer(kind: Kind, text: str) -> str:
    """Return an element; those that are integers as Python's."""
    return f"int({text})" if kind in {Kind.INT, Kind.UNSIGNED} else text


def operations_in(node: object) -> int:
    """Return the operations of what a node computes once, without those that it may not come to."""
    match node:
        case tree.Select(_, once) | tree.If(once) | Operation(_, "and" | "or", (once, _)):
            return operations_in(once)
        case For(_, start, stop):
            return operations_in((start, stop))
        case tree.While():
            return 0
    own = isinstance(node, Operation) and node.type is Kind.REAL and node.operator in COUNTED
    return own + sum(map(operations_in, tree.parts_of(node)))


REAL: Final = real_of(computing_settings.Arithmetic.FLOAT32)
NEAR: Final = REAL(0.01)
"""Distance from the guess to bounds that are to cut a step."""
FAR: Final = REAL(1e6)
"""Distance of bounds and rows that have no effect."""
COUNTS: Final = np.arange(1, ITERATIONS + 1)
ITERATION: Final = "descend"
"""The kernel that a call does one iteration by."""


class IterationCounts(NamedTuple):
    """Operations of a call that does one iteration."""

    unconstrained: int
    """No row is active, no bound is reached."""
    recorded: CallCost
    worst: int
    """Every row is active at each point, no variable is held, a bound cuts the step, and the step is taken."""
    total: int
    """Sum over all recorded calls."""


class Counter:
    """Counts iterations of the solver, in single precision, for the matrices of one problem."""

    def __init__(self, method: OdeMethod, problem: QuadraticProblem) -> None:
        self.method, self.problem = method, problem
        ode = golden.OdeProgram(method, problem, COUNTS)
        self._entry, self._program = ode.entry.name, CountedProgram(ode.functions)
        self._noted = self._program.noting(ITERATION)

    def iterations(self, problem: QuadraticProblem, guess: Array) -> list[int]:
        """Return the operations of `ITERATIONS` iterations, each of which is a call."""
        self._noted.clear()
        none = Costs(REAL(np.inf), REAL(np.inf))
        room = (np.zeros((ITERATIONS, len(guess)), REAL), np.zeros(ITERATIONS, REAL), np.zeros_like(COUNTS))
        self._program[self._entry](self.method, problem, guess, COUNTS, none, *room)
        return list(self._noted)

    def unconstrained(self, rows: float = FAR, bounds: float = FAR) -> int:
        """Return the operations of an iteration without active rows and bounds, which are so far from the guess."""
        qp = self.problem
        n, gamma = len(qp.phi), np.full(len(qp.gamma), rows, REAL)
        guess, high = np.zeros(n, REAL), np.full(n, bounds, REAL)
        return max(self.iterations(qp._replace(gamma=gamma, low=-high, high=high), guess))

    def worst(self) -> int:
        """Return the operations of an iteration that does all that an iteration can do."""
        return self.unconstrained(-FAR, NEAR)


def counted_iterations(method: OdeMethod, vectors: Sequence[GoldenVector]) -> IterationCounts:
    """Return the operations of an iteration; the recorded ones are those of golden vectors."""
    counter = Counter(method, vectors[0].problem)
    found = [one for each in vectors for one in counter.iterations(each.problem, each.guess)]
    worst = counter.worst()
    return IterationCounts(counter.unconstrained(), cost_of(found, worst), worst, sum(found))


def counter_of(problem: PredictiveProblem, program: settings.ProgramSettings) -> Counter:
    """Return what counts the iterations of the ODE-based solver for a problem in single precision."""
    method = ode_solver(program.ode, program.penalties).method
    m, zero = len(problem.Gamma), np.zeros(problem.size, REAL)
    qp = QuadraticProblem(problem.Phi, zero, problem.Gamma, np.zeros(m, REAL), zero, zero, REAL(0.0))
    return Counter(method(qp), qp)


def cost_of(found: Sequence[int], worst: int | None = None) -> CallCost:
    """Return least, mean and most of recorded calls, and the worst case."""
    return CallCost(least=min(found), mean=sum(found) / len(found), most=max(found), worst=worst)


def counted_updates(optimizer: OptimizerProgram, updates: Iterable[GoldenUpdate]) -> dict[str, CallCost]:
    """Return the operations of the calls that golden updates take beside the iterations: plan, start, finish."""
    kernels = golden.OptimizerKernels(optimizer)
    begin, take, solve, _ = (each.name for each in kernels.entries)
    program = CountedProgram(kernels.functions)
    c, method = kernels.constants["constants"], kernels.constants["method"]
    x, z, process = len(optimizer.state.belief.x), len(optimizer.state.sent.z), optimizer.process
    empty = partial(scheme.empty_state, x, len(process.inputs), len(process.outputs), z, REAL)
    state = empty()
    noted = {name: program.noting(name) for name in (take, "pose", "warm_start", "deliver")}
    for each in updates:
        if each.fixed_ticks >= 0:
            c = c._replace(fixed_ticks=each.fixed_ticks)
            state = empty()
            program[begin](c, state)
        program[take](c, kernels.rules[c.fixed_ticks], kernels.starts[c.fixed_ticks], state, latched(each))
        if each.sequence:
            program[solve](c, method, state)
    starts = [sum(both) for both in zip(noted["pose"], noted["warm_start"], strict=True)]
    calls = {"plan": noted[take], "start": starts, "finish": noted["deliver"]}
    return {name: cost_of(found) for name, found in calls.items()}


def counted_guard(kernels: GuardKernels, calls: Iterable[GoldenCall]) -> dict[str, CallCost]:
    """Return the operations of the scans and judgements of golden calls of the output guard."""
    program, limits = CountedProgram(kernels.functions, np.float64), kernels.limits
    begin, resume, scan, judge, _ = (each.name for each in kernels.entries)
    state, twin = _guard_state(limits), _guard_state(limits)
    noted = {"scan": program.noting(scan), "judgement": program.noting(judge)}
    for each in calls:
        given = np.array(each.given)
        match each.call:
            case Call.RESTART:
                program[begin](state, limits, given)
            case Call.SCAN:
                program[scan](state, limits, each.tick, given, each.update)
            case Call.RESUME:
                program[resume](state, limits, each.tick, given)
            case Call.JUDGE:
                before, rows = np.array(each.meanwhile), np.array(each.rows)
                ahead = (each.tick, before, 0, len(before), each.first_tick)
                program[judge](state, twin, limits, *ahead, rows, len(rows))
    return {name: cost_of(found) for name, found in noted.items()}


def counted_longest(kernels: GuardKernels) -> int:
    """Return the operations of the judgement of the longest sequence after another one, all rows of which move."""
    program, limits = CountedProgram(kernels.functions, np.float64), kernels.limits
    low, high, rate = map(np.array, (limits.low, limits.high, limits.rate))
    middle, step = (low + high) / 2, np.minimum(rate, high - low) / 1000
    rows = (middle + np.outer(np.arange(2 * SEQUENCE_ROWS + 1) % 2, step)).astype(np.float32).astype(float)
    state, twin = _guard_state(limits), _guard_state(limits)
    program[kernels.begin.name](state, limits, rows[0])
    program.operations()
    meanwhile, offered = rows[1 : SEQUENCE_ROWS + 1], rows[SEQUENCE_ROWS + 1 :]
    ahead = (0, meanwhile, 0, SEQUENCE_ROWS, SEQUENCE_ROWS)
    assert program[kernels.judge.name](state, twin, limits, *ahead, offered, SEQUENCE_ROWS)  # noqa: S101 by construction
    return program.operations()


def _guard_state(limits: Limits) -> GuardState:
    state = beginning(limits, limits.low)
    for name in ("applied", "anchor", "coming", "moves", "before"):
        setattr(state, name, np.array(getattr(state, name)))
    return state


def latched(of: GoldenUpdate) -> decisions.Latched:
    """Return an update as the kernels take it."""
    update = of.update
    u_before, u, y, x, ahead = (np.array(each, REAL) for each in (update.u_before, update.u, update.y, update.x, ()))
    return decisions.Latched(update.update, update.tick, update.playing, REAL(update.load), u_before, u, y, x, ahead)
