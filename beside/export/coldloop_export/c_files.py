"""Solver, whole optimiser and output guard as folders of C99: sources, constants, golden vectors, self-tests."""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any, Final

import numpy as np

from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_export import golden, tree
from coldloop_export.c_printer import GENERATED, ConstantRecords, KernelFiles, Printer, golden_files, identifier
from coldloop_export.golden import PER_PROBLEM, GoldenCall, GoldenUpdate, GoldenVector, GuardKernels, OdeProgram, crc
from coldloop_export.tree import ArrayType, Function, Invoke, Kind, RecordType, StructType, Type, filled, template, walk
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.solvers.interface import Costs
from coldloop_optimizer_plc.solvers.ode import OdeMethod


class OdeExport(tree.Export):
    """The solver for the matrices of one problem as C99, with an answer after each iteration, and golden vectors."""

    def __init__(self, method: OdeMethod, vectors: Sequence[GoldenVector]) -> None:
        self.method, self.problem, self.vectors = method, vectors[0].problem, vectors
        self.counts = np.arange(1, len(vectors[0].answer.costs) + 1)
        program = OdeProgram(method, self.problem, self.counts)
        self.printer = Printer(self.problem.phi.dtype.type)
        self.real, self.entry = self.printer.scalars[Kind.REAL], program.entry
        matrices = golden.leaves(("matrices",), method.matrices).items()
        self.constants = {
            "Phi": self.problem.Phi, "Gamma": self.problem.Gamma, "counts": self.counts,
            **{"_".join(path): values for path, values in matrices},
            "flow": np.array([float(each) for each in method.flow], self.problem.phi.dtype),
        }  # fmt: skip
        self.kernels = KernelFiles(self.printer, program.functions, [self.entry], "solver", self.constants)

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names."""
        header = {"N": len(self.problem.phi), "M": len(self.problem.gamma), "K": len(self.counts),
                  "FIRST": self.counts[0], "LAST": self.counts[-1]}  # fmt: skip
        constants = self.constants.items()
        declared = "".join(f"extern const {self.printer.scalar(values)} {name}[{values.size}];\n"
                           for name, values in constants)  # fmt: skip
        literals = np.array([float(each.rstrip("f")) for each in self.printer.literals], self.problem.phi.dtype)
        sum_ = reduce(lambda before, values: crc(values, before), (values for _, values in constants), crc(literals))
        arrays = "\n".join(self.printer.array(name, values, "") for name, values in constants)
        tables = f'{GENERATED}#include <math.h>\n\n#include "tables.h"\n\n{self.kernels.literals()}\n{arrays}'
        return {
            **self.kernels.texts(), "problem.h": self._filled("problem.h", header), "problem.c": self._problem(),
            "tables.h": self._filled("tables.h", {"DECLARED": declared, "SUM": sum_}), "tables.c": tables,
            **self._golden(self.vectors), "self_test.c": self._filled("self_test.c", {}),
        }  # fmt: skip

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs; the stack is that of the deepest calls, without what compilers add."""
        word = self.problem.phi.itemsize
        constants = word * len(self.printer.literals) + sum(
            values.size * (word if values.dtype.kind == "f" else 4) for values in self.constants.values()
        )
        arrays = (values for each in self.vectors for values in golden.arrays_in(each).values())
        return {"constants": constants, "stack of `solve_problem`, arrays and numbers": stack(self.entry, word),
                "self-test and golden vectors": word * sum(values.size for values in arrays)}  # fmt: skip

    def _problem(self) -> str:
        constants = self.constants
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
        return self._filled("problem.c", body)

    def _golden(self, vectors: Sequence[GoldenVector]) -> dict[str, str]:
        stacked = {
            **{name: np.array([getattr(each.problem, name) for each in vectors]) for name in PER_PROBLEM},
            "guess": np.array([each.guess for each in vectors]),
            "guessed": np.array([each.answer.guessed for each in vectors], self.problem.phi.dtype),
            "points": np.array([each.answer.points for each in vectors]),
            "costs": np.array([each.answer.costs for each in vectors]),
            "iterations": np.array([each.answer.iterations for each in vectors]),
        }
        sum_ = reduce(lambda before, values: crc(values, before), stacked.values(), 0)
        declared = {f"golden_{name}[{values.size}]": values.ravel() for name, values in stacked.items()}
        return golden_files(self.printer, sum_, declared, N_GOLDEN=len(vectors))

    def _filled(self, name: str, parts: Mapping[str, object]) -> str:
        bits = ("uint32_t", "4", "FLT_MIN") if self.printer.single else ("uint64_t", "8", "DBL_MIN")
        of_type = dict(zip(("BITS", "BYTES", "SMALLEST"), bits, strict=True))
        texts = {each: str(part) for each, part in parts.items()}
        return _filled(name, {**texts, "REAL": self.real, **of_type})


def _filled(name: str, parts: Mapping[str, str]) -> str:
    return filled(template(f"c/{name}"), {**parts, "GENERATED": GENERATED.rstrip()})


def _in_order(
    folder: str, kernels: KernelFiles, parts: Mapping[str, str], own: tuple[Sequence[str], Sequence[str]],
    vectors: Mapping[str, str],
) -> dict[str, str]:  # fmt: skip
    """Return the files of a part of the export: kernels, constants, golden vectors, interface and self-test."""
    constants, interface = ({name: _filled(f"{folder}/{name}", parts) for name in names} for names in own)
    return {**kernels.texts(), **constants, **vectors, **interface}


def stack(function: Function, word: int) -> int:
    """Return the bytes of a function's variables and of the deepest calls in it."""
    nodes = list(walk(function.body))
    own = sum(word * (node.variable.type.size if isinstance(node.variable.type, ArrayType) else 1)
              for node in nodes if isinstance(node, tree.Declare))  # fmt: skip
    called = {node.function.name: node.function for node in nodes if isinstance(node, Invoke | tree.Invocation)}
    return own + max((stack(each, word) for each in called.values()), default=0)


TABLES: Final = ("constants", "method", "rules", "starts")


class OptimizerExport(tree.Export):
    """The optimiser of some settings as C99, with golden updates."""

    def __init__(self, optimizer: OptimizerProgram, updates: Sequence[GoldenUpdate]) -> None:
        self.kernels, self._golden = golden.OptimizerKernels(optimizer), updates
        self._process, self.printer = optimizer.process, Printer(np.float32)
        functions = self.kernels.functions
        made = [node.variable.type for each in functions for node in walk(each.body) if isinstance(node, tree.Make)]
        self._kernels = KernelFiles(self.printer, functions, self.kernels.entries, "optimizer", TABLES, made)
        self.state_type = next(each for each in self._kernels.records if each.name == "OptimizerState")
        self.constants = ConstantRecords(self.printer)
        records: dict[str, Any] = {**self.kernels.constants}
        for ticks, (rule, starts) in enumerate(zip(self.kernels.rules, self.kernels.starts, strict=True)):
            records |= {f"rules[{ticks}]": rule, f"starts[{ticks}]": starts}
        self._initial = {name: self.constants.printed(name, record) for name, record in records.items()}

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names."""
        process = self._process
        sizes = {"INPUTS": len(process.inputs), "OUTPUTS": len(process.outputs), "STATES": len(process.states),
                 "ROWS": SEQUENCE_ROWS, "LONGEST": process.ticks_per_sample, "SHORTEST": SHORTEST_TICKS,
                 "TICK_S": process.tick_s}  # fmt: skip
        parts = {**self._constants(), **{name: str(size) for name, size in sizes.items()}}
        own = ("constants.h", "constants.c"), ("optimizer.h", "optimizer.c", "self_test.c")
        return _in_order("optimizer", self._kernels, parts, own, self._golden_files())

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs; the stack is that of the deepest calls, without what compilers add."""
        return {"constants": self.constants.bytes(), "state": size_of(self.state_type),
                "stack, arrays and numbers": max(stack(each, 4) for each in self.kernels.entries)}  # fmt: skip

    def _constants(self) -> dict[str, str]:
        kernels, initial = self.kernels, self._initial
        tables = {
            f"OF_{of.upper()}": ",\n".join(f"    {text}" for name, text in initial.items() if name.startswith(f"{of}["))
            for of in ("rules", "starts")
        }
        kinds = {"RULE": kernels.rules[0], "BEGIN": kernels.starts[0], "METHOD": kernels.constants["method"]}
        return {
            **{name: type(each).__name__ for name, each in kinds.items()}, **tables, "COUNT": str(len(kernels.rules)),
            "OF_CONSTANTS": initial["constants"], "OF_METHOD": initial["method"],
            **self.constants.parts(self._kernels),
        }  # fmt: skip

    def _golden_files(self) -> dict[str, str]:
        integers, reals = golden.update_tables(self._golden).values()
        rows = np.array([row for each in self._golden if each.sequence for row in each.sequence.rows], np.float32)
        sum_ = crc(rows, crc(reals, crc(integers)))
        declared = {
            f"golden_integers[{len(integers)}][GOLDEN_INTEGERS]": integers,
            f"golden_reals[{len(reals)}][GOLDEN_REALS]": reals,
            f"golden_rows[{len(rows)}][{rows.shape[1]}]": rows,
        }
        return golden_files(self.printer, sum_, declared, N_GOLDEN=len(integers), N_GOLDEN_ROWS=len(rows),
                            GOLDEN_INTEGERS=integers.shape[1], GOLDEN_REALS=reals.shape[1])  # fmt: skip


def size_of(kind: Type, real: int = 4) -> int:
    """Return the bytes of a state, of whose numbers with a point each has `real`."""
    if isinstance(kind, RecordType | StructType):
        return sum(size_of(each, real) for _, each in kind.fields)
    if isinstance(kind, tree.RowsType):
        return size_of(kind.struct, real) * kind.length
    scalar, count = (kind.kind, kind.size) if isinstance(kind, ArrayType) else (kind, 1)
    return (real if scalar is Kind.REAL else 4) * count


class GuardExport(tree.Export):
    """The output guard for some limits as C99, with golden calls."""

    def __init__(self, kernels: GuardKernels, calls: Sequence[GoldenCall], tick_s: float) -> None:
        self._inputs, self._tick_s = len(kernels.limits.low), tick_s
        self._printer, self._tables = Printer(np.float64), golden.tables_of(calls)
        self._kernels = KernelFiles(self._printer, kernels.functions, kernels.entries, "guard", ["limits"])
        self.constants = ConstantRecords(self._printer)
        self._limits = self.constants.printed("limits", kernels.limits)

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names."""
        sizes = {"INPUTS": self._inputs, "ROWS": SEQUENCE_ROWS, "TICK_S": self._tick_s}
        parts = {**{name: str(size) for name, size in sizes.items()}, "LIMITS": self._limits,
                 **self.constants.parts(self._kernels)}  # fmt: skip
        own = ("limits.h", "limits.c"), ("output_guard.h", "output_guard.c", "self_test.c")
        return _in_order("output_guard", self._kernels, parts, own, self._golden_files())

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs."""
        state = next(each for each in self._kernels.records if each.name == "GuardState")
        rows = 2 * 8 * self._inputs * SEQUENCE_ROWS
        tables = sum(values.nbytes for values in self._tables.values())
        judged = 2 * size_of(state, 8) + rows
        return {"constants": self.constants.bytes(), "state and rows that are judged, about": judged,
                "self-test and golden calls": tables}  # fmt: skip

    def _golden_files(self) -> dict[str, str]:
        sum_ = reduce(lambda before, values: crc(values.view(np.int32), before), self._tables.values(), 0)
        declared = {f"golden_{name}[{len(values)}][{values.shape[1]}]": values for name, values in self._tables.items()}
        integers, _, rows = self._tables.values()
        return golden_files(Printer(np.float32), sum_, declared, N_GOLDEN=len(integers), N_GOLDEN_ROWS=len(rows),
                            GOLDEN_INTEGERS=integers.shape[1])  # fmt: skip
