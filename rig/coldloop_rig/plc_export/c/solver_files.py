"""The ODE-based solver as a folder of C99: sources, constants, golden vectors and a self-test that runs them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Costs
from coldloop_optimizer_plc.solvers.ode import OdeMethod
from coldloop_rig.plc_export.c.printer import Printer, identifier
from coldloop_rig.plc_export.c.text import GENERATED, KernelFiles, golden_files
from coldloop_rig.plc_export.kernels.ode_program import PER_PROBLEM, OdeProgram, crc, leaves
from coldloop_rig.plc_export.kernels.recorded_problems import GoldenVector, arrays_in
from coldloop_rig.plc_export.templates import template
from coldloop_rig.plc_export.tree.nodes import ArrayType, Declare, Function, Invocation, Invoke, Kind, walk

Array = NDArray[Any]


class Sizes(NamedTuple):
    """Bytes that a program needs."""

    constants: int
    stack: int
    """Arrays and numbers of the deepest calls; without what the compiler adds."""
    self_test: int


class OdeExport:
    """The solver for the matrices of one problem and a table of iteration counts, as C99.

    Args:
        method: Constants of the solver; their type, single or double precision, is that of the export.
        problem: One of the problems.
        counts: Iterations after which there is an answer.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset.
    """

    def __init__(self, method: OdeMethod, problem: QuadraticProblem, counts: Array) -> None:
        self.method, self.problem, self.counts = method, problem, counts
        self.program = OdeProgram(method, problem, counts)
        self.printer = Printer(problem.phi.dtype.type)
        self.real = self.printer.scalars[Kind.REAL]
        self.entry = self.program.entry
        self.kernels = KernelFiles(self.printer, self.program.functions, [self.entry], "solver", self._constants())

    # -- files ---------------------------------------------------------------------------------------------------------

    def write(self, folder: Path, vectors: Iterable[GoldenVector]) -> list[Path]:
        """Write the files, with some golden vectors, into a folder that is made; return their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        files = self.files(vectors)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="ascii")
        return [folder / name for name in files]

    def files(self, vectors: Iterable[GoldenVector]) -> dict[str, str]:
        """Return the texts of the files by their names, with some golden vectors."""
        return {
            **self.kernels.texts(), "problem.h": self._problem_header(), "problem.c": self._problem(),
            "tables.h": self._tables_header(), "tables.c": self._tables(),
            **self._golden(list(vectors)), "self_test.c": self._self_test(),
        }  # fmt: skip

    def sizes(self, vectors: Iterable[GoldenVector]) -> Sizes:
        """Return the bytes of the constants, of the stack and of golden vectors."""
        word = self.problem.phi.itemsize
        constants = word * len(self.printer.literals) + sum(
            values.size * (word if values.dtype.kind == "f" else 4) for values in self._constants().values()
        )
        golden = sum(word * sum(values.size for values in arrays_in(each).values()) for each in vectors)
        return Sizes(constants, stack(self.entry, word), golden)

    def _problem_header(self) -> str:
        n, m, k = len(self.problem.phi), len(self.problem.gamma), len(self.counts)
        return f"""{GENERATED}#ifndef PROBLEM_H
#define PROBLEM_H

#include <stdint.h>

#define N_VARIABLES {n}
#define N_ROWS {m}
#define N_COUNTS {k}

/* The answer after {self.counts[0]} to {self.counts[-1]} iterations. */
void solve_problem(
    const {self.real} phi[N_VARIABLES], const {self.real} gamma[N_ROWS], const {self.real} low[N_VARIABLES],
    const {self.real} high[N_VARIABLES], const {self.real} guess[N_VARIABLES], {self.real} *guessed,
    {self.real} points[N_COUNTS * N_VARIABLES], {self.real} costs[N_COUNTS], int32_t iterations[N_COUNTS]);

#endif
"""

    def _tables_header(self) -> str:
        declared = "".join(f"extern const {self.printer.scalar(values)} {name}[{values.size}];\n"
                           for name, values in self._constants().items())  # fmt: skip
        return f"""{GENERATED}#ifndef TABLES_H
#define TABLES_H

#include "kernels.h"

/* In a file of their own, so that the compiler does not copy them into the code. */
{declared}
/* Sum over the constants and the literals; SUM_OF_CONSTANTS is what it was when they were written. */
uint32_t sum_of_constants(void);
uint32_t sum_of_reals(uint32_t sum, const volatile {self.real} *values, int32_t count);
uint32_t sum_of_integers(uint32_t sum, const volatile int32_t *values, int32_t count);
#define SUM_OF_CONSTANTS UINT32_C({self._sum_of_constants()})

#endif
"""

    def _constants(self) -> dict[str, Array]:
        """Return the constant arrays by name."""
        real = self.problem.phi.dtype
        flow = np.array([float(each) for each in self.method.flow], real)
        matrices = {"_".join(path): values for path, values in leaves(("matrices",), self.method.matrices).items()}
        return {"Phi": self.problem.Phi, "Gamma": self.problem.Gamma, "counts": self.counts, **matrices, "flow": flow}

    def _sum_of_constants(self) -> int:
        real = self.problem.phi.dtype
        literals = np.array([float(each.rstrip("f")) for each in self.printer.literals], real)
        sum_ = crc(literals)
        for array in self._constants().values():
            sum_ = crc(array, sum_)
        return sum_

    def _problem(self) -> str:
        constants = self._constants()
        sums = "\n".join(
            f"    sum = sum_of_{'reals' if values.dtype.kind == 'f' else 'integers'}(sum, {name}, {values.size});"
            for name, values in constants.items()
        )
        flow = [f"flow[{place}] != {self.printer.number(0.0)}" if isinstance(each, bool) else f"flow[{place}]"
                for place, each in enumerate(self.method.flow)]  # fmt: skip
        settings = "\n".join(
            f"    method.flow.{identifier(name)} = {value};"
            for name, value in zip(self.method.flow._fields, flow, strict=True)
        )
        matrices = "\n".join(
            f"    method.{name.replace('_', '.', 2)} = {name};" for name in constants if name.startswith("matrices_")
        )
        none = "\n".join(f"    before.{name} = INFINITY;" for name in Costs._fields)
        vectors = "\n".join(f"    qp.{identifier(name)} = {identifier(name)};" for name in PER_PROBLEM)
        body = {"SUMS_OF_BYTES": template("c/sums.c"), "SUMS": sums, "METHOD": f"{matrices}\n{settings}",
                "BEFORE": none, "VECTORS": vectors}  # fmt: skip
        return self._filled(template("c/problem.c"), body)

    def _tables(self) -> str:
        arrays = "\n".join(self.printer.array(name, values, "") for name, values in self._constants().items())
        return f'{GENERATED}#include <math.h>\n\n#include "tables.h"\n\n{self.kernels.literals()}\n{arrays}'

    def _golden(self, vectors: list[GoldenVector]) -> dict[str, str]:
        """Return the files of the golden vectors: inputs and results of all in a row."""
        stacked = {
            **{name: np.array([getattr(each.problem, name) for each in vectors]) for name in PER_PROBLEM},
            "guess": np.array([each.guess for each in vectors]),
            "guessed": np.array([each.answer.guessed for each in vectors], self.problem.phi.dtype),
            "points": np.array([each.answer.points for each in vectors]),
            "costs": np.array([each.answer.costs for each in vectors]),
            "iterations": np.array([each.answer.iterations for each in vectors]),
        }  # fmt: skip
        sum_ = 0
        for values in stacked.values():
            sum_ = crc(values, sum_)
        declared = {f"golden_{name}[{values.size}]": values.ravel() for name, values in stacked.items()}
        return golden_files(self.printer, sum_, declared, N_GOLDEN=len(vectors))

    def _self_test(self) -> str:
        return self._filled(template("c/self_test.c"), {})

    def _filled(self, text: str, parts: Mapping[str, str]) -> str:
        single = self.printer.single
        bits, size, smallest = ("uint32_t", "4", "FLT_MIN") if single else ("uint64_t", "8", "DBL_MIN")
        parts = {**parts, "REAL": self.real, "BITS": bits, "BYTES": size, "SMALLEST": smallest,
                 "GENERATED\n": GENERATED}  # fmt: skip
        for name, value in parts.items():
            text = text.replace(f"@{name}" if name.endswith("\n") else f"@{name}@", value)
        return text


def stack(function: Function, word: int) -> int:
    """Return the bytes of a function's variables and of the deepest calls in it."""
    nodes = list(walk(function.body))
    own = sum(word * (node.variable.type.size if isinstance(node.variable.type, ArrayType) else 1)
              for node in nodes if isinstance(node, Declare))  # fmt: skip
    called = {node.function.name: node.function for node in nodes if isinstance(node, Invoke | Invocation)}
    return own + max((stack(each, word) for each in called.values()), default=0)
