"""The control PLC's output guard as C99: kernels, limits, its interface, golden calls and a self-test."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_rig.plc_export.c.constants import ConstantRecords
from coldloop_rig.plc_export.c.optimizer_files import size_of
from coldloop_rig.plc_export.c.printer import Printer
from coldloop_rig.plc_export.c.text import GENERATED, KernelFiles, golden_files
from coldloop_rig.plc_export.kernels.golden_calls import GoldenCall, tables_of
from coldloop_rig.plc_export.kernels.guard_program import GuardKernels
from coldloop_rig.plc_export.kernels.ode_program import crc
from coldloop_rig.plc_export.templates import filled, template

TEMPLATES: Final = ("output_guard.h", "output_guard.c", "self_test.c")


class GuardExport:
    """The output guard for some limits as C99.

    Args:
        kernels: Its functions.
        golden: Calls with their answers.
        tick_s: Length of a tick, s.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset.
    """

    def __init__(self, kernels: GuardKernels, golden: Sequence[GoldenCall], tick_s: float) -> None:
        self._inputs, self._tick_s = len(kernels.limits.low), tick_s
        self._printer, self._tables = Printer(np.float64), tables_of(golden)
        self._kernels = KernelFiles(self._printer, kernels.functions, kernels.entries, "guard", ["limits"])
        self.constants = ConstantRecords(self._printer)
        self._limits = self.constants.printed("limits", kernels.limits)

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names."""
        sizes = {"INPUTS": self._inputs, "ROWS": SEQUENCE_ROWS, "TICK_S": self._tick_s}
        parts = {"GENERATED": GENERATED.rstrip(), **{name: str(size) for name, size in sizes.items()}}
        texts = {name: filled(template(f"c/output_guard/{name}"), parts) for name in TEMPLATES}
        return {**self._kernels.texts(), **self._limit_files(), **self._golden_files(), **texts}

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs."""
        state = next(each for each in self._kernels.records if each.name == "GuardState")
        rows = 2 * 8 * self._inputs * SEQUENCE_ROWS
        golden = sum(values.nbytes for values in self._tables.values())
        judged = 2 * size_of(state, 8) + rows
        return {"constants": self.constants.bytes(), "state and rows that are judged, about": judged,
                "self-test and golden calls": golden}  # fmt: skip

    def _limit_files(self) -> dict[str, str]:
        header = (f'{GENERATED}#ifndef LIMITS_H\n#define LIMITS_H\n\n#include "kernels.h"\n\n'
                  f"extern const Limits limits;\n\n{self.constants.declared()}\n#endif\n")  # fmt: skip
        source = (f'{GENERATED}#include <math.h>\n#include <string.h>\n\n#include "limits.h"\n\n'
                  f"{self._kernels.literals()}\n{self.constants.arrays_text()}\n"
                  f"const Limits limits = {self._limits};\n\n"
                  f"{self.constants.summing()}")  # fmt: skip
        return {"limits.h": header, "limits.c": source}

    def _golden_files(self) -> dict[str, str]:
        sum_ = 0
        for values in self._tables.values():
            sum_ = crc(values.view(np.int32), sum_)
        declared = {f"golden_{name}[{len(values)}][{values.shape[1]}]": values
                    for name, values in self._tables.items()}  # fmt: skip
        integers, _, rows = self._tables.values()
        return golden_files(Printer(np.float32), sum_, declared, N_GOLDEN=len(integers), N_GOLDEN_ROWS=len(rows),
                            GOLDEN_INTEGERS=integers.shape[1])  # fmt: skip
