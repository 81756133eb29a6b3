"""Exported parts (solver, whole optimiser, output guard) as functions of the typed tree, and their golden vectors.

Golden vectors are recorded problems and updates with the kernels' answers, and drawn calls of the output guard.
"""

import math
import random
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from coldloop import config, errors
from coldloop.kernels.single_precision import single
from coldloop.process.lti_model import load as load_model
from coldloop.process.settings import InputLimits
from coldloop.registers import codec, control_plc
from coldloop.safety.writers import InputSequence
from coldloop_control_plc import output_limits
from coldloop_control_plc.output_limits import Limits, admit, begin, beginning, copy_state, in_range, judge, plain
from coldloop_export import statements, tree
from coldloop_optimizer_plc import computing_settings, decisions, rules, scheme
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.linear_algebra import real_of
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_optimizer_plc.solvers.interface import KERNELS, Answer, Costs, solve_by
from coldloop_optimizer_plc.solvers.ode import OdeMethod, solve
from coldloop_plant.load import find_load
from coldloop_rig.cosim import one_process, scenario
from coldloop_rig.cosim.compiled.loops import PORTABLE
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

Array = NDArray[Any]

PER_PROBLEM: Final = ("phi", "gamma", "low", "high")
"""Vectors of a problem that change from one to the next."""


class OdeProgram:
    """The solver, in the precision of its constants, for the matrices of one problem and some iteration counts."""

    def __init__(self, method: OdeMethod, problem: QuadraticProblem, counts: Array) -> None:
        self.method, self.problem, self.counts = method, problem, counts
        real = problem.phi.dtype.type
        none = Costs(real(np.inf), real(np.inf))
        self.types: tuple[tree.Type, ...] = tuple(
            map(tree.type_of, (method, problem, np.zeros_like(problem.phi), counts, none))
        )
        program = statements.Program(frozenset({"power"}))  # the step size has a cube root by `**`
        self.entry: tree.Function = program.function(solve, self.types)
        self.functions = program.functions
        """Callees before their callers."""

    def constants(self) -> dict[tuple[str, ...], Any]:
        """Return the arrays and numbers that never change, by the parameter of `solve` and the fields to them."""
        c, qp = (each.name for each in self.entry.parameters[:2])
        return {(qp, "Phi"): self.problem.Phi, (qp, "Gamma"): self.problem.Gamma, **leaves((c,), self.method)}


def leaves(path: tuple[str, ...], record: object) -> dict[tuple[str, ...], Any]:
    """Return the arrays and numbers of a record of records, by the fields to them."""
    if not hasattr(record, "_fields"):
        return {path: record}
    found: dict[tuple[str, ...], Any] = {}
    for name, part in zip(record._fields, cast("tuple[object, ...]", record), strict=True):
        found |= leaves((*path, name), part)
    return found


def crc(values: Array, before: int = 0) -> int:
    """Return the CRC-32 of numbers, most significant byte first, as the self-test computes it."""
    wide = values.astype(f">f{values.dtype.itemsize}" if values.dtype.kind == "f" else ">i4")
    return zlib.crc32(wide.tobytes(), before)


class OptimizerKernels:
    """Functions of the optimiser, and what they compute with, for the settings of a program."""

    def __init__(self, optimizer: OptimizerProgram) -> None:
        real = real_of(computing_settings.Arithmetic.FLOAT32)
        self.rules = [rules.make_rule(optimizer.settings, optimizer.budget, ticks, real)
                      for ticks in range(optimizer.budget.longest_ticks + 1)]  # fmt: skip
        """The rule for each fixed updating period in ticks; that for 0 adapts it."""
        self.starts = [decisions.Starts(rule.first, rule.after_interruption()) for rule in self.rules]
        self.constants: Mapping[str, Any] = {
            "constants": optimizer.constants._replace(fixed_ticks=0), "method": optimizer.method,
        }  # fmt: skip
        process = optimizer.process
        sizes = (len(process.inputs), len(process.inputs), len(process.outputs), len(process.states), 0)
        latched = decisions.Latched(0, 0, 0, real(0.0), *(np.zeros(size, real) for size in sizes))
        c, method, m = self.constants["constants"], self.constants["method"], optimizer.state
        generic = {
            cast("Callable[..., Any]", of): {kind.__name__: kernel for kind, kernel in kernels.items()}
            for of, kernels in ((solve_by, KERNELS), (rules.decide_by, rules.DECISIONS))
        }
        program = statements.Program(frozenset({"power", "log"}), generic)  # that root, and the logarithms of the rules
        self.entries: list[tree.Function] = [
            program.function(kernel, tuple(map(tree.type_of, given)))
            for kernel, given in (
                (decisions.begin_session, (c, m)),
                (decisions.take_update, (c, self.rules[0], self.starts[0], m, latched)),
                (scheme.solve, (c, method, m)),
                (decisions.note_answer, (m, True)),
            )
        ]
        self.functions = program.functions
        """Callees before their callers."""
        self.types: tuple[tree.Type, ...] = tuple(
            parameter.type for each in self.functions for parameter in each.parameters
        )


class GuardKernels:
    """Functions of the output guard for some limits of the inputs."""

    def __init__(self, limits: InputLimits) -> None:
        self.limits = plain(limits)
        state = tree.type_of(beginning(self.limits, self.limits.low))
        n, tick, of = len(self.limits.low), tree.Kind.INT, tree.type_of(self.limits)
        row, rows = tree.ArrayType(tree.Kind.REAL, (n,)), tree.ArrayType(tree.Kind.REAL, (control_plc.SEQUENCE_ROWS, n))
        program = statements.Program(portable=frozenset(PORTABLE), double=True)
        self.begin, self.resume, self.admit, self.judge, self.in_range = self.entries = tuple(
            program.function(function, types) for function, types in (
                (output_limits.begin, (state, of, row)),
                (output_limits.resume, (state, of, tick, row)),
                (output_limits.admit, (state, of, tick, row, tree.Kind.BOOL)),
                (output_limits.judge, (state, state, of, tick, rows, tick, tick, tick, rows, tick)),
                (output_limits.in_range, (of, row)),
            )
        )  # fmt: skip
        self.functions: list[tree.Function] = program.functions
        """Callees before their callers."""


SINGLE: Final = (
    "optimizer_plc.program.preset=paper",
    "optimizer_plc.program.arithmetic=float32",
    "optimizer_plc.program.solver=ode",
)
"""Assignments of the recorded run: the paper's configuration in the arithmetic of its PLC."""
ITERATIONS: Final = 20
"""Iterations of the solver for each recorded problem; the result after each one is compared."""

TELLING: Final = 8
"""Golden vectors of an export; each takes 5 kB."""
LEAST_GAIN: Final = 1e-6
"""Decrease of the cost below which a problem is no golden vector: at steady state there is less, by rounding alone."""
TICKS, LOAD = 1440, "e"
"""Length (ticks) and load of the recorded run: six minutes, in which this load has a large step."""


class GoldenVector(NamedTuple):
    """A problem, the guess it is begun from, and the kernels' answer after 1, 2, ... `ITERATIONS` iterations."""

    problem: QuadraticProblem
    guess: Array
    answer: Answer


class GoldenVectors(NamedTuple):
    """Problems of one run, which have the same matrices, and the solver's constants."""

    method: OdeMethod
    vectors: list[GoldenVector]

    def telling(self, most: int = TELLING) -> list[GoldenVector]:
        """Return the problems whose cost the solver lowers most, in their order; none at steady state."""
        gains = [float(each.answer.guessed) - float(each.answer.costs[-1]) for each in self.vectors]
        by_gain = sorted(range(len(gains)), key=lambda place: -gains[place])
        return [self.vectors[place] for place in sorted(by_gain[:most]) if gains[place] > LEAST_GAIN]


def paper_settings(model: Path) -> Settings:
    """Return the settings of the paper's PLC with a model file."""
    options = {"model.file": (str(model), "model")}
    return config.load_configuration(Settings, environment={}, assignments=SINGLE, options=options).settings


def record(settings: Settings, ticks: int = TICKS, load: str = LOAD) -> GoldenVectors:
    """Return the problems of a run of so many ticks under a named load, adaptive updating period, with the answers."""
    recorder = UpdateRecorder(settings)
    recorder.record(ticks, load, 0.0)
    return recorder.problems()


def answered(method: OdeMethod, problem: QuadraticProblem, guess: Array) -> GoldenVector:
    """Return a problem with what the kernels answer, in single precision."""
    real = real_of(computing_settings.Arithmetic.FLOAT32)
    none, counts = Costs(real(np.inf), real(np.inf)), np.arange(1, ITERATIONS + 1)
    return GoldenVector(problem, guess, solve(method, problem, guess, counts, none))


def arrays_in(vector: GoldenVector) -> dict[str, Array]:
    """Return the arrays of a golden vector by their names."""
    return {**{name: getattr(vector.problem, name) for name in PER_PROBLEM}, "guess": vector.guess,
            **{name: getattr(vector.answer, name).ravel() for name in ("points", "costs", "iterations")}}  # fmt: skip


class GoldenUpdate(NamedTuple):
    """An update with what it was answered by."""

    fixed_ticks: int
    """Fixed updating period (ticks) of the session that begins with this update; -1 within a session."""
    update: control_plc.Update
    plan: control_plc.Plan
    sequence: InputSequence | None
    """Sequence of the answer; None if the update was interrupted before."""


def integers_of(golden: GoldenUpdate) -> tuple[int, ...]:
    """Return its integers: session, update, plan, header of the sequence, which is 0 if there is none."""
    update, plan = golden.update, golden.plan
    sent = golden.sequence.header if golden.sequence else None
    answered = (sent.number, sent.first_tick, sent.tau_u, sent.length) if sent else (0, 0, 0, 0)
    return (golden.fixed_ticks, update.update, update.tick, update.playing, plan.next_update_tick, plan.suspects,
            *answered)  # fmt: skip


def update_tables(golden: Sequence[GoldenUpdate]) -> dict[str, Array]:
    """Return golden updates as tables of integers and of numbers with a point, a row each."""
    reals = [
        (update.load, *update.u_before, *update.u, *update.y, *update.x, plan.load_step, plan.shortage)
        for _, update, plan, _ in golden
    ]
    integers = np.array([integers_of(each) for each in golden], np.int32)
    return {"integers": integers, "reals": np.array(reals, np.float32)}


def refuse(settings: ProgramSettings) -> None:
    """Refuse a solver or an arithmetic that cannot be exported. Raises UsageError."""
    if settings.solver is not SolverName.ODE:
        raise errors.UsageError("export plc: with the ODE-based solver alone: --set optimizer_plc.program.solver=ode")
    if settings.arithmetic is not computing_settings.Arithmetic.FLOAT32:
        raise errors.UsageError("export plc: in single precision alone: --set optimizer_plc.program.arithmetic=float32")


class _ListeningOptimizer(OptimizerProgram):
    """Keeps every problem with its guess, and every update with its answers."""

    def restart(self, updating_period_s: float, rule: rules.UpdatingRule | None = None) -> None:
        """Reset."""
        self.problems: list[tuple[QuadraticProblem, Array]] = []
        self.updates: list[GoldenUpdate] = []
        self._begun = round(updating_period_s / self.process.tick_s)
        super().restart(updating_period_s, rule)

    def plan(self, update: control_plc.Update) -> control_plc.Plan:
        """Keep the update and its plan."""
        plan = super().plan(update)
        self.updates.append(
            GoldenUpdate(self._begun, update, codec.as_transmitted(plan, control_plc.control_map(self.process)), None)
        )
        self._begun = -1
        return plan

    def solve(self) -> InputSequence:
        """Record the solved problem and its sequence: posing a problem twice gives the same bits."""
        self.problems.append(scheme.pose(self.constants, self.state))
        sequence = super().solve()
        self.updates[-1] = self.updates[-1]._replace(sequence=sequence)
        return sequence


class UpdateRecorder:
    """Records runs of an optimiser that can be exported.

    Raises UsageError if the settings ask for something that is not exported.
    """

    def __init__(self, settings: Settings) -> None:
        refuse(settings.optimizer_plc.program)
        self._model = load_model(settings.model.file)
        self.optimizer = _ListeningOptimizer(self._model, settings.optimizer_plc.program, settings.limits)
        self._rig = one_process.OneProcessRig(settings, compiled=False)
        self._rig.optimizer = self.optimizer

    def record(self, ticks: int, load: str, updating_period_s: float) -> list[GoldenUpdate]:
        """Return the updates of a run of so many ticks under a named load."""
        profile = find_load(load, self._model.w0, self.optimizer.process)
        self._rig.run(scenario.Scenario(ticks, profile, updating_period_s, seed=1), Recorder(ticks, []))
        return self.optimizer.updates

    def problems(self) -> GoldenVectors:
        """Return the problems of the last run with the answers."""
        method = cast("OdeMethod", self.optimizer.method)
        return GoldenVectors(method, [answered(method, qp, guess) for qp, guess in self.optimizer.problems])


Row = tuple[float, ...]


class Call(IntEnum):
    """Function of the guard that is called."""

    RESTART = 0
    SCAN = 1
    RESUME = 2
    JUDGE = 3


class Judgement(IntEnum):
    """Verdict of the guard on a sequence."""

    ACCEPTED = 0
    OUT_OF_RANGE = 1
    RATE_EXCEEDED = 2


class GoldenCall(NamedTuple):
    """A call and its answer."""

    call: Call
    tick: int
    given: Row
    """Inputs requested, or applied before, shape (inputs,)."""
    applied: Row
    """Inputs applied after the call, shape (inputs,)."""
    update: bool = False
    """Whether a sequence begins in this scan."""
    judgement: Judgement = Judgement.ACCEPTED
    meanwhile: tuple[Row, ...] = ()
    first_tick: int = 0
    rows: tuple[Row, ...] = ()


CALLS: Final = 800
MOST_NUMBERS: Final = 8_000
"""Limit on the numbers in the rows of all golden calls, and in the inputs given and applied: each table is one list of
constants."""
FARTHEST: Final = 30
"""Ticks until a sequence that is judged begins."""
LATEST: Final = 2_000_000_000
SEED: Final = 0
NOT_FINITE: Final = (math.nan, math.inf, -math.inf)


def golden_calls(limits: InputLimits) -> list[GoldenCall]:
    """Return calls with valid and invalid inputs, with the answers of the control PLC's own guard."""
    drawing, calls, rows = _Drawing(plain(limits), random.Random(SEED)), list[GoldenCall](), 0  # noqa: S311 no secret
    inputs = len(limits.low)
    for call in drawing.calls():
        rows += len(call.meanwhile) + len(call.rows)
        if len(calls) == CALLS or inputs * max(rows, 2 * len(calls)) > MOST_NUMBERS:
            break
        calls.append(call)
    return calls


class _Drawing:
    """Calls one after the other of one guard."""

    def __init__(self, limits: Limits, source: random.Random) -> None:
        self.limits, self.random, self._n = limits, source, len(limits.low)
        self._longest = min(control_plc.SEQUENCE_ROWS, MOST_NUMBERS // (10 * self._n))
        """Rows of a sequence that is judged."""
        self.state = beginning(limits, self._row(0.2, 0.8))
        self.twin = beginning(limits, self.state.applied)
        self.tick = source.randrange(LATEST)

    def _row(self, low: float, high: float) -> Row:
        """Return outputs between shares of their ranges, as they cross the link."""
        drawn = (self.random.uniform(low, high) for _ in range(self._n))
        bounds = zip(drawn, self.limits.low, self.limits.high, strict=True)
        return tuple(single(bottom + share * (top - bottom)) for share, bottom, top in bounds)

    def _chance(self, probability: float) -> bool:
        return self.random.random() < probability

    def _changed(self, row: Row, values: Sequence[float]) -> Row:
        """Return a row with one of these values in the place of one output."""
        place = self.random.randrange(self._n)
        return (*row[:place], self.random.choice(values), *row[place + 1 :])

    def _applied(self) -> Row:
        return tuple(self.state.applied)

    def calls(self) -> Iterator[GoldenCall]:
        """Yield calls without end."""
        yield from self._restarted()
        while True:
            kinds = (self._scans, self._updates, self._resumed, self._judged, self._restarted)
            yield from self.random.choices(kinds, (8, 6, 6, 14, 1))[0]()

    def _restarted(self) -> Iterator[GoldenCall]:
        found = self._row(-0.01, 1.01)
        begin(self.state, self.limits, found)
        self.tick = self.random.choice((0, self.random.randrange(LATEST)))
        yield GoldenCall(Call.RESTART, 0, found, self._applied())

    def _scanned(self, wanted: Row, *, update: bool = False) -> GoldenCall:
        admit(self.state, self.limits, self.tick, wanted, update)
        self.tick += 1
        return GoldenCall(Call.SCAN, self.tick - 1, wanted, self._applied(), update)

    def _wanted(self) -> Row:
        """Return random requested inputs: often beyond the limits, now and then NaN or infinite."""
        wanted = self._row(-0.3, 1.3)
        return self._changed(wanted, NOT_FINITE) if self._chance(0.3) else wanted

    def _scans(self) -> Iterator[GoldenCall]:
        wanted = self._wanted()
        for _ in range(self.random.randrange(1, 6)):
            yield self._scanned(wanted)

    def _updates(self) -> Iterator[GoldenCall]:
        for _ in range(self.random.randrange(1, 4)):
            yield self._scanned(self._wanted(), update=True)
        self.tick += self.random.randrange(30)

    def _resumed(self) -> Iterator[GoldenCall]:
        """Yield a break behind a move; the outputs are elsewhere then, now and then outside their bounds."""
        yield self._scanned(self._wanted(), update=True)
        self.tick += self.random.randrange(3)
        found = self._row(-0.2, 1.2) if self._chance(0.4) else self._row(0.0, 1.0)
        if self._chance(0.4):
            found = self._changed(self._applied(), (*NOT_FINITE, *found))
        output_limits.resume(self.state, self.limits, self.tick, found)
        yield GoldenCall(Call.RESUME, self.tick, found, self._applied())
        for _ in range(self.random.randrange(1, 4)):
            yield self._scanned(self._applied() if self._chance(0.5) else self._wanted())

    def _judged(self) -> Iterator[GoldenCall]:
        """Yield the judgement of a sequence that may be played, or that is changed in one place."""
        copy_state(self.state, self.twin, self.limits)
        long = self._chance(0.08)
        farthest = min(FARTHEST, self._longest)
        ahead, length = (farthest, self._longest) if long else (min(4, farthest), min(8, self._longest))
        coming = self.random.randrange(ahead + 1)
        first_tick = self.tick + self.random.randrange(coming, ahead + 1)
        meanwhile = tuple(self._played(self.tick + k, moves=0.5, as_wanted=self._chance(0.5)) for k in range(coming))
        for k in range(self.tick + coming, first_tick):
            admit(self.twin, self.limits, k, self.twin.applied, update=False)
        length = self.random.randrange(1, length + 1)
        rows = [self._played(first_tick + k, moves=4.0 / length, update=k == 0) for k in range(length)]
        if self._chance(0.6):
            changed = self.random.choice((length - 1, self.random.randrange(length)))
            others = (self._row(0.0, 1.0)[0], *self._at_a_bound(), *NOT_FINITE)
            rows[changed] = self._moved(rows[changed]) if self._chance(0.6) else self._changed(rows[changed], others)
        judgement = Judgement.OUT_OF_RANGE
        if all(in_range(self.limits, row) for row in rows):
            passes = judge(self.state, self.twin, self.limits, self.tick, meanwhile, 0, len(meanwhile), first_tick,
                           rows, len(rows))  # fmt: skip
            judgement = Judgement.ACCEPTED if passes else Judgement.RATE_EXCEEDED
        yield GoldenCall(
            Call.JUDGE, self.tick, self._applied(), self._applied(), meanwhile=meanwhile, first_tick=first_tick,
            rows=tuple(rows), judgement=judgement,
        )  # fmt: skip

    def _moved(self, row: Row) -> Row:
        """Return a row with one output moved by about its rate."""
        place = self.random.randrange(self._n)
        by = self.limits.rate[place] * self.random.uniform(-1.2, 1.2)
        low, high = self.limits.low[place], self.limits.high[place]
        return (*row[:place], single(min(max(row[place] + by, low), high)), *row[place + 1 :])

    def _at_a_bound(self) -> Row:
        """Return outputs a little beyond their bounds: by less than the slack, or by more."""
        beyond = self.random.uniform(0.0, 2.0)
        sides = zip(self.limits.low, self.limits.high, self.limits.slack, strict=True)
        return tuple(
            single(self.random.choice((low - beyond * slack, high + beyond * slack))) for low, high, slack in sides
        )

    def _played(self, tick: int, *, moves: float, update: bool = False, as_wanted: bool = False) -> Row:
        """Return what the twin applies, where now and then something new is wanted; or that."""
        wanted = self._row(-0.1, 1.1) if self._chance(moves) else tuple(self.twin.applied)
        admit(self.twin, self.limits, tick, wanted, update)
        return wanted if as_wanted else tuple(self.twin.applied)


def tables_of(golden: Sequence[GoldenCall]) -> dict[str, Array]:
    """Return golden calls as tables, one row each: integers, reals (inputs given and applied), and all their rows.

    Integers: call, tick, update or judgement, rows played meanwhile, first tick, rows of the sequence, and where these
    begin in the table of rows, those that are played meanwhile behind them.
    """
    integers, rows = list[tuple[int, ...]](), list[Row]()
    for each in golden:
        told = int(each.judgement if each.call is Call.JUDGE else each.update)
        lengths = (len(each.meanwhile), each.first_tick, len(each.rows))
        integers.append((each.call, each.tick, told, *lengths, len(rows)))
        rows += [*each.rows, *each.meanwhile]
    return {
        "integers": np.array(integers, np.int32),
        "reals": np.array([(*each.given, *each.applied) for each in golden], np.float32),
        "rows": np.array(rows, np.float32),
    }
