"""Exported parts as functions of the typed tree with their constants: solver, whole optimiser, output guard."""

import zlib
from collections.abc import Callable, Mapping
from typing import Any, Final, cast

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_control_plc import output_limits
from coldloop_control_plc.output_limits import beginning, plain
from coldloop_export.statements import Program
from coldloop_export.tree import ArrayType, Function, Kind, Type, type_of
from coldloop_optimizer_plc import decisions, scheme
from coldloop_optimizer_plc.computing_settings import Arithmetic
from coldloop_optimizer_plc.decisions import Latched, Starts
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.linear_algebra import real_of
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.rules import DECISIONS, decide_by, make_rule
from coldloop_optimizer_plc.solvers.interface import KERNELS, Costs, solve_by
from coldloop_optimizer_plc.solvers.ode import OdeMethod, solve
from coldloop_rig.cosim.compiled.portable import PORTABLE

Array = NDArray[Any]

PER_PROBLEM: Final = ("phi", "gamma", "low", "high")
"""Vectors of a problem that change from one to the next."""
POWER: Final = frozenset({"power"})
"""The step size has a cube root by `**`: its last bit is that of the platform's library."""


class OdeProgram:
    """The solver, in the precision of its constants, for the matrices of one problem and some iteration counts."""

    def __init__(self, method: OdeMethod, problem: QuadraticProblem, counts: Array) -> None:
        self.method, self.problem, self.counts = method, problem, counts
        real = problem.phi.dtype.type
        none = Costs(real(np.inf), real(np.inf))
        self.types: tuple[Type, ...] = tuple(map(type_of, (method, problem, np.zeros_like(problem.phi), counts, none)))
        program = Program(POWER)
        self.entry: Function = program.function(cast("Dispatcher", solve), self.types)
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


GENERIC: Final = {
    cast("Callable[..., Any]", of): {kind.__name__: cast("Dispatcher", kernel) for kind, kernel in kernels.items()}
    for of, kernels in ((solve_by, KERNELS), (decide_by, DECISIONS))
}
PLATFORM: Final = frozenset({"power", "log"})
"""The cube root of a step size, and the logarithms of the rules of the updating period."""


class OptimizerKernels:
    """Functions of the optimiser, and what they compute with, for the settings of a program."""

    def __init__(self, optimizer: OptimizerProgram) -> None:
        real = real_of(Arithmetic.FLOAT32)
        self.rules = [make_rule(optimizer.settings, optimizer.budget, ticks, real)
                      for ticks in range(optimizer.budget.longest_ticks + 1)]  # fmt: skip
        """The rule for each fixed updating period in ticks; that for 0 adapts it."""
        self.starts = [Starts(rule.first, rule.after_interruption()) for rule in self.rules]
        self.constants: Mapping[str, Any] = {
            "constants": optimizer.constants._replace(fixed_ticks=0), "method": optimizer.method,
        }  # fmt: skip
        process = optimizer.process
        sizes = (len(process.inputs), len(process.inputs), len(process.outputs), len(process.states), 0)
        latched = Latched(0, 0, 0, real(0.0), *(np.zeros(size, real) for size in sizes))
        c, method, m = self.constants["constants"], self.constants["method"], optimizer.state
        program = Program(PLATFORM, GENERIC)
        self.entries: list[Function] = [
            program.function(cast("Dispatcher", kernel), tuple(map(type_of, given)))
            for kernel, given in (
                (decisions.begin_session, (c, m)),
                (decisions.take_update, (c, self.rules[0], self.starts[0], m, latched)),
                (scheme.solve, (c, method, m)),
                (decisions.note_answer, (m, True)),
            )
        ]
        self.functions = program.functions
        """Callees before their callers."""
        self.types: tuple[Type, ...] = tuple(parameter.type for each in self.functions for parameter in each.parameters)


class GuardKernels:
    """Functions of the output guard for some limits of the inputs."""

    def __init__(self, limits: InputLimits) -> None:
        self.limits = plain(limits)
        state = type_of(beginning(self.limits, self.limits.low))
        n, tick, of = len(self.limits.low), Kind.INT, type_of(self.limits)
        row, rows = ArrayType(Kind.REAL, (n,)), ArrayType(Kind.REAL, (SEQUENCE_ROWS, n))
        program = Program(portable=frozenset(PORTABLE), double=True)
        self.begin, self.resume, self.admit, self.judge, self.in_range = self.entries = tuple(
            program.function(function, types) for function, types in (
                (output_limits.begin, (state, of, row)),
                (output_limits.resume, (state, of, tick, row)),
                (output_limits.admit, (state, of, tick, row, Kind.BOOL)),
                (output_limits.judge, (state, state, of, tick, rows, tick, tick, tick, rows, tick)),
                (output_limits.in_range, (of, row)),
            )
        )  # fmt: skip
        self.functions: list[Function] = program.functions
        """Callees before their callers."""
