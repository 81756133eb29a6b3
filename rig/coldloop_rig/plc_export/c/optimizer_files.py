"""The whole optimiser as C99: kernels, constants, its interface, golden updates and a self-test."""

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_rig.plc_export.c.constants import ConstantRecords
from coldloop_rig.plc_export.c.printer import Printer
from coldloop_rig.plc_export.c.solver_files import stack
from coldloop_rig.plc_export.c.text import GENERATED, KernelFiles, golden_files
from coldloop_rig.plc_export.kernels.ode_program import crc
from coldloop_rig.plc_export.kernels.optimizer_program import OptimizerKernels
from coldloop_rig.plc_export.kernels.recorded_updates import GoldenUpdate, integers_of, reals_of
from coldloop_rig.plc_export.templates import filled, template
from coldloop_rig.plc_export.tree.nodes import ArrayType, Kind, RecordType, RowsType, StructType, Type

Array = NDArray[Any]
SINGLE: Final = np.dtype(np.float32)
TABLES: Final = ("constants", "method", "rules", "starts")


class OptimizerSizes(NamedTuple):
    """Bytes that a program needs."""

    constants: int
    state: int
    stack: int
    """Arrays and numbers of the deepest calls; without what the compiler adds."""


class OptimizerExport:
    """The optimiser of some settings as C99.

    Args:
        optimizer: Its program.
        golden: Updates with their answers.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset.
    """

    def __init__(self, optimizer: OptimizerProgram, golden: Sequence[GoldenUpdate]) -> None:
        self.kernels, self._golden, self._state = OptimizerKernels(optimizer), golden, optimizer.state
        self._process, self.printer = optimizer.process, Printer(np.float32)
        functions = self.kernels.functions
        made = (kind for each in functions for kind in self.printer.made_in(each))
        self._kernels = KernelFiles(self.printer, functions, self.kernels.entries, "optimizer", TABLES, made)
        self.state_type = next(each for each in self._kernels.records if each.name == "OptimizerState")
        self.constants = ConstantRecords(self.printer)
        self._initial = {name: self.constants.printed(name, record) for name, record in self._leading()}

    def _leading(self) -> Iterator[tuple[str, Any]]:
        yield from self.kernels.constants.items()
        for ticks, (rule, starts) in enumerate(zip(self.kernels.rules, self.kernels.starts, strict=True)):
            yield f"rules[{ticks}]", rule
            yield f"starts[{ticks}]", starts

    # -- files ---------------------------------------------------------------------------------------------------------

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names."""
        process = self._process
        sizes = {"INPUTS": len(process.inputs), "OUTPUTS": len(process.outputs), "STATES": len(process.states),
                 "ROWS": SEQUENCE_ROWS, "LONGEST": process.ticks_per_sample, "SHORTEST": SHORTEST_TICKS,
                 "TICK_S": process.tick_s}  # fmt: skip
        parts = {"GENERATED": GENERATED.rstrip(), **{name: str(size) for name, size in sizes.items()}}
        texts = {name: filled(template(f"c/optimizer/{name}"), parts)
                 for name in ("optimizer.h", "optimizer.c", "self_test.c")}  # fmt: skip
        return {**self._kernels.texts(), "constants.h": self._constants_header(), "constants.c": self._constants(),
                **self._golden_files(), **texts}  # fmt: skip

    def sizes(self) -> OptimizerSizes:
        """Return the bytes of constants, state and stack."""
        deepest = max(stack(each, 4) for each in self.kernels.entries)
        return OptimizerSizes(self.constants.bytes(), size_of(self.state_type), deepest)

    # -- constants -----------------------------------------------------------------------------------------------------

    def _constants_header(self) -> str:
        rule, starts, method = (type(each).__name__ for each in (
            self.kernels.rules[0], self.kernels.starts[0], self.kernels.constants["method"]))  # fmt: skip
        return f"""{GENERATED}#ifndef CONSTANTS_H
#define CONSTANTS_H

#include "kernels.h"

extern const Constants constants;
extern const {method} method;
/* The rule for each fixed updating period in ticks, and what it begins with; those for 0 adapt it. */
extern const {rule} rules[{len(self.kernels.rules)}];
extern const {starts} starts[{len(self.kernels.rules)}];

{self.constants.declared()}
#endif
"""

    def _constants(self) -> str:
        rules, starts = (
            ",\n".join(f"    {text}" for name, text in self._initial.items() if name.startswith(f"{of}["))
            for of in ("rules", "starts")
        )
        rule, begin, method = (type(each).__name__ for each in (
            self.kernels.rules[0], self.kernels.starts[0], self.kernels.constants["method"]))  # fmt: skip
        return f"""{GENERATED}#include <math.h>
#include <string.h>

#include "constants.h"

{self._kernels.literals()}
{self.constants.arrays_text()}
const Constants constants = {self._initial["constants"]};

const {method} method = {self._initial["method"]};

const {rule} rules[{len(self.kernels.rules)}] = {{
{rules}}};

const {begin} starts[{len(self.kernels.rules)}] = {{
{starts}}};

{self.constants.summing()}"""

    # -- golden updates ------------------------------------------------------------------------------------------------

    def _golden_files(self) -> dict[str, str]:
        integers = np.array([integers_of(each) for each in self._golden], np.int32)
        reals = np.array([reals_of(each) for each in self._golden], SINGLE)
        rows = np.array([row for each in self._golden if each.sequence for row in each.sequence.rows], SINGLE)
        sum_ = crc(rows, crc(reals, crc(integers)))
        declared = {
            f"golden_integers[{len(integers)}][GOLDEN_INTEGERS]": integers,
            f"golden_reals[{len(reals)}][GOLDEN_REALS]": reals,
            f"golden_rows[{len(rows)}][{rows.shape[1]}]": rows,
        }
        return golden_files(self.printer, sum_, declared, N_GOLDEN=len(integers), N_GOLDEN_ROWS=len(rows),
                            GOLDEN_INTEGERS=integers.shape[1], GOLDEN_REALS=reals.shape[1])  # fmt: skip


def size_of(record: RecordType | StructType, real: int = 4) -> int:
    """Return the bytes of a state, of whose numbers with a point each has `real`."""
    return sum(_field_size(kind, real) for _, kind in record.fields)


def _field_size(kind: Type, real: int) -> int:
    if isinstance(kind, RecordType | StructType):
        return size_of(kind, real)
    if isinstance(kind, RowsType):
        return size_of(kind.struct, real) * kind.length
    scalar, count = (kind.kind, kind.size) if isinstance(kind, ArrayType) else (kind, 1)
    return (real if scalar is Kind.REAL else 4) * count
