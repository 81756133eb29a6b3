"""The ODE-based solver as functions of the typed tree, with its constants: what both targets print."""

import zlib
from typing import Any, Final, cast

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Costs
from coldloop_optimizer_plc.solvers.ode import OdeMethod, solve
from coldloop_rig.plc_export.tree.nodes import Function, Type
from coldloop_rig.plc_export.tree.reading import Program
from coldloop_rig.plc_export.tree.subset import type_of

Array = NDArray[Any]

PER_PROBLEM: Final = ("phi", "gamma", "low", "high")
"""Vectors of a problem that change from one to the next."""
POWER: Final = frozenset({"power"})
"""The step size has a cube root by `**`: its last bit is that of the platform's library."""


class OdeProgram:
    """The solver for the matrices of one problem and a table of iteration counts.

    Args:
        method: Constants of the solver; their type, single or double precision, is that of the export.
        problem: One of the problems.
        counts: Iterations after which there is an answer.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset.
    """

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
