"""The whole optimiser as C99: kernels, constants, its interface, golden updates and a self-test."""

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES, TICK_S
from coldloop.process.updating_periods import LONGEST_TICKS, SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS
from optimizer_plc.program import OptimizerProgram
from rig.plc_export.c.printer import Printer, identifier
from rig.plc_export.c.solver_files import stack
from rig.plc_export.c.text import GENERATED, helpers, records_in
from rig.plc_export.kernels.ode_program import crc
from rig.plc_export.kernels.optimizer_program import OptimizerKernels
from rig.plc_export.kernels.recorded_updates import GoldenUpdate, integers_of, reals_of
from rig.plc_export.templates import filled, template
from rig.plc_export.tree.nodes import ArrayType, RecordType, StructType

Array = NDArray[Any]
SINGLE: Final = np.dtype(np.float32)


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
        self.printer = Printer(np.float32)
        entries = self.kernels.entries
        self._functions = "\n".join(
            self.printer.function(each, "" if each in entries else "static ") for each in self.kernels.functions
        )
        made = (kind for each in self.kernels.functions for kind in self.printer.made_in(each))
        records = records_in(chain(self.kernels.types, made))
        self._records = "\n".join(map(self.printer.structure, records))
        self.state_type = next(each for each in records if each.name == "OptimizerState")
        self.arrays: dict[str, Array] = {}
        """Constant arrays by their names."""
        self.sums: list[str] = []
        """What the sum of the constants is made of, in C."""
        self._sum = crc(np.array([float(each.rstrip("f")) for each in self.printer.literals], SINGLE))
        self._initial = {name: self._printed(name, record) for name, record in self._leading()}

    def _leading(self) -> Iterator[tuple[str, Any]]:
        yield from self.kernels.constants.items()
        for ticks, (rule, starts) in enumerate(zip(self.kernels.rules, self.kernels.starts, strict=True)):
            yield f"rules[{ticks}]", rule
            yield f"starts[{ticks}]", starts

    # -- files ---------------------------------------------------------------------------------------------------------

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names."""
        sizes = {"INPUTS": len(INPUT_NAMES), "OUTPUTS": len(OUTPUT_NAMES), "STATES": len(STATE_NAMES),
                 "ROWS": SEQUENCE_ROWS, "LONGEST": LONGEST_TICKS, "SHORTEST": SHORTEST_TICKS,
                 "TICK_S": TICK_S}  # fmt: skip
        parts = {"GENERATED": GENERATED.rstrip(), **{name: str(size) for name, size in sizes.items()}}
        texts = {name: filled(template(f"c/optimizer/{name}"), parts)
                 for name in ("optimizer.h", "optimizer.c", "self_test.c")}  # fmt: skip
        return {"kernels.h": self._header(), "kernels.c": self._kernels(), "constants.h": self._constants_header(),
                "constants.c": self._constants(), **self._golden_files(), **texts}  # fmt: skip

    def sizes(self) -> OptimizerSizes:
        """Return the bytes of constants, state and stack."""
        constants = sum(4 * array.size for array in self.arrays.values()) + 4 * len(self.printer.literals)
        deepest = max(stack(each, 4) for each in self.kernels.entries)
        return OptimizerSizes(constants, size_of(self.state_type), deepest)

    def _header(self) -> str:
        signatures = "\n".join(f"{self.printer.signature(each)};" for each in self.kernels.entries)
        return f"""{GENERATED}#ifndef KERNELS_H
#define KERNELS_H

#include <stdbool.h>
#include <stdint.h>

#define N_LITERALS {len(self.printer.literals)}
extern const float literals[N_LITERALS];

{self._records}
{signatures}

#endif
"""

    def _kernels(self) -> str:
        literals = "".join(f"    {each},\n" for each in self.printer.literals)
        return f"""{GENERATED}#include <math.h>

#include "kernels.h"

const float literals[N_LITERALS] = {{
{literals}}};

{helpers("float", self._functions)}
{self._functions}"""

    # -- constants -----------------------------------------------------------------------------------------------------

    def _printed(self, path: str, value: object) -> str:
        """Return the initial value of a constant, whose arrays and numbers are noted."""
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            parts = (f".{identifier(name)} = {self._printed(f'{path}.{identifier(name)}', part)}"
                     for name, part in zip(value._fields, value, strict=True))  # fmt: skip
            return f"{{{', '.join(parts)}}}"
        array = np.asarray(value)
        real = array.dtype.kind == "f"
        self._sum = crc(array.astype(SINGLE if real else np.int32), self._sum)
        function, kind = ("sum_of_reals", "float") if real else ("sum_of_integers", "int32_t")
        if isinstance(value, np.ndarray):
            self.sums.append(f"sum = {function}(sum, {path}, {array.size});")
            name = path.replace(".", "_")
            self.arrays[name] = array
            return name
        self.sums.append(f"sum = {function}(sum, &({kind}){{{path}}}, 1);")
        if real:
            return self.printer.number(float(array))
        return str(bool(value)).lower() if isinstance(value, bool | np.bool_) else str(int(array))

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

/* Sum over literals and constants; SUM_OF_CONSTANTS is what it was when they were written. */
uint32_t sum_of_constants(void);
uint32_t sum_of_reals(uint32_t sum, const float *values, int32_t count);
uint32_t sum_of_integers(uint32_t sum, const int32_t *values, int32_t count);
#define SUM_OF_CONSTANTS UINT32_C({self._sum})

#endif
"""

    def _constants(self) -> str:
        arrays = "\n".join(self.printer.array(name, values) for name, values in self.arrays.items())
        rules, starts = (
            ",\n".join(f"    {text}" for name, text in self._initial.items() if name.startswith(f"{of}["))
            for of in ("rules", "starts")
        )
        parts = {"GENERATED": GENERATED.rstrip(), "REAL": "float", "BITS": "uint32_t", "BYTES": "4"}
        sums = filled(template("c/sums.c"), parts)
        rule, begin, method = (type(each).__name__ for each in (
            self.kernels.rules[0], self.kernels.starts[0], self.kernels.constants["method"]))  # fmt: skip
        body = "".join(f"    {each}\n" for each in self.sums)
        return f"""{GENERATED}#include <math.h>
#include <string.h>

#include "constants.h"

{arrays}
const Constants constants = {self._initial["constants"]};

const {method} method = {self._initial["method"]};

const {rule} rules[{len(self.kernels.rules)}] = {{
{rules}}};

const {begin} starts[{len(self.kernels.rules)}] = {{
{starts}}};

{sums}
uint32_t sum_of_constants(void) {{
    uint32_t sum = sum_of_reals(0, literals, N_LITERALS);
{body}    return sum;
}}
"""

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
        externs = "".join(f"extern const {self.printer.scalar(each)} {name};\n" for name, each in declared.items())
        header = (f"{GENERATED}#include <stdint.h>\n\n#define N_GOLDEN {len(integers)}\n"
                  f"#define N_GOLDEN_ROWS {len(rows)}\n"
                  f"#define GOLDEN_INTEGERS {integers.shape[1]}\n#define GOLDEN_REALS {reals.shape[1]}\n"
                  f"#define SUM_OF_GOLDEN UINT32_C({sum_})\n{externs}")  # fmt: skip
        arrays = "\n".join(self.printer.tabulated(name, values) for name, values in declared.items())
        return {"golden.h": header, "golden.c": f'{GENERATED}#include <math.h>\n\n#include "golden.h"\n\n{arrays}'}


def size_of(record: RecordType | StructType) -> int:
    """Return the bytes of a state."""
    return sum(_field_size(kind) for _, kind in record.fields)


def _field_size(kind: object) -> int:
    if isinstance(kind, RecordType | StructType):
        return size_of(kind)
    if isinstance(kind, ArrayType):
        return 4 * kind.size
    struct = getattr(kind, "struct", None)
    return size_of(struct) * kind.length if struct else 4  # type: ignore[attr-defined]
