"""The control PLC's output guard as Structured Text: blocks of its kernels in LREAL, interface, limits, a self-test."""

import re
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_control_plc.output_limits import beginning
from coldloop_rig.plc_export.kernels.golden_calls import GoldenCall, tables_of
from coldloop_rig.plc_export.kernels.guard_program import GuardKernels
from coldloop_rig.plc_export.kernels.ode_program import leaves
from coldloop_rig.plc_export.structured_text.constants import Constants, types_in
from coldloop_rig.plc_export.structured_text.dialects import portable
from coldloop_rig.plc_export.structured_text.lowering import VALUE, Lowering
from coldloop_rig.plc_export.structured_text.optimizer_files import state_types
from coldloop_rig.plc_export.structured_text.places import Record
from coldloop_rig.plc_export.structured_text.printer import (
    DOUBLE,
    StructuredTextPrinter,
    global_name,
    interface_names,
    memory,
    section,
    size_of,
)
from coldloop_rig.plc_export.structured_text.solver_files import AT_ONCE, GENERATED
from coldloop_rig.plc_export.structured_text.verdict import main_program
from coldloop_rig.plc_export.templates import filled, template
from coldloop_rig.plc_export.tree.nodes import Block, Kind, Name, Path
from coldloop_rig.plc_export.tree.subset import type_of

STATE: Final[Path] = ("g", "guard")
TWIN: Final[Path] = ("g", "twin")
"""What a sequence that is judged is played to."""
BEGUN: Final[Path] = (*STATE, "begun")
PLACES: Final = {"state": Record(STATE), "twin": Record(TWIN), "limits": Record(("c", "limits"))}
ROW: Final = {"applied": "wide", "wanted": "wide", "row": "row"}
"""Variables of the interface's blocks that are handed to parameters of the kernels."""
ROWS: Final = {"meanwhile": "before", "rows": "wide", "waiting": "0"}


def of_guard(text: str) -> str:
    """Return text with a prefix of the guard's own for global names, so that the optimiser is loaded beside it."""
    return re.sub(r"\bcl_(?!guard_)", "cg_", text)


class GuardText:
    """The output guard for some limits as Structured Text.

    Args:
        kernels: Its functions.
        golden: Calls with their answers.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset.
    """

    outputs: ClassVar[tuple[str, ...]] = ()
    """Of the self-test, beside those of each."""

    def __init__(self, kernels: GuardKernels, golden: Sequence[GoldenCall]) -> None:
        self._tables = tables_of(golden)
        constants = {path: np.asarray(value) for path, value in leaves(("c", "limits"), kernels.limits).items()}
        constants |= {("c", f"golden_{name}"): values for name, values in self._tables.items()}
        state = type_of(beginning(kernels.limits, kernels.limits.low))
        self.state = {**dict(state_types(STATE, state)), **dict(state_types(TWIN, state)), BEGUN: Kind.BOOL}
        self.printer = StructuredTextPrinter({**types_in(constants), **self.state}, np.float64)
        lowering = Lowering({*constants, *self.state})
        self.entries = [
            lowering.block(each, {one.name: PLACES[one.name] for one in each.parameters if one.name in PLACES})
            for each in kernels.entries
        ]
        self._kernels = "\n".join(map(self.printer.block, lowering.blocks))
        self.constants = Constants(constants, self.printer)
        n = len(kernels.limits.low)
        self._counts = {"INPUTS": n, "LAST": n - 1, "NUMBERS": n * SEQUENCE_ROWS,
                        "ROWS": SEQUENCE_ROWS}  # fmt: skip

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names, in the order in which they are loaded."""
        functions = ("functions.st", "output_guard/functions_lreal.st")
        texts = {
            "types.st": "", "functions.st": "\n".join(template(f"structured_text/{each}") for each in functions),
            "kernels.st": self._kernels, "output_guard.st": self._interface(), "self_test.st": self._self_test(),
            "configuration.st": self._configuration(),
        }  # fmt: skip
        texts["types.st"] = self.printer.types()
        return {name: GENERATED + of_guard(portable(text)) for name, text in texts.items()}

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs."""
        golden = sum((8 if values.dtype.kind == "f" else 4) * values.size for values in self._tables.values())
        rows = 2 * 8 * self._counts["NUMBERS"]
        return {
            "constants": self.constants.bytes() - golden,
            "state": sum(size_of(kind, DOUBLE) for kind in self.state.values()),
            "instances of the four blocks": rows + sum(memory(each, DOUBLE) for each in self.entries),
            "self-test and golden calls": golden,
        }

    def _interface(self) -> str:
        for size in ("INPUTS", "NUMBERS"):
            self.printer.array_type("REAL", self._counts[size])
        begin, resume, admit, judge, in_range = self.entries
        return filled(template("structured_text/output_guard/output_guard.st"), {
            **self._printed_counts(), "BEGIN": self._passed(begin, ROW), "RESUME": self._passed(resume, ROW),
            "ADMIT": self._passed(admit, ROW), "JUDGE": self._passed(judge, ROWS),
            "IN_RANGE": self._passed(in_range, ROW), "INSIDE": self._value(in_range), "PASSES": self._value(judge),
        })  # fmt: skip

    def _passed(self, block: Block, variables: dict[str, str]) -> str:
        """Return the arguments of a call in the interface."""
        names = interface_names(block, self.printer.type)
        return ", ".join(f"{names[each]} := {variables.get(each.name, each.name)}"
                         for each in (*block.inputs, *block.shared))  # fmt: skip

    def _value(self, block: Block) -> str:
        """Return the name of the output that is a function's value."""
        return interface_names(block, self.printer.type)[Name(Kind.BOOL, VALUE)]

    def _printed_counts(self) -> dict[str, str]:
        return {name: str(count) for name, count in self._counts.items()}

    def _self_test(self) -> str:
        checks = template("structured_text/checks.st")
        checks = checks[checks.index("(* Sums up") :] + "\n"  # the other ones are of single precision
        integers, reals, rows = self._tables.values()
        return filled(checks + template("structured_text/output_guard/self_test.st") + main_program(self.outputs), {
            **self._printed_counts(), **self.constants.summed(), "AT_ONCE": str(AT_ONCE),
            "OF_REALS": str(reals.shape[1]), "N_INTEGERS": str(integers.size), "N_REALS": str(reals.size),
            "N_ROWS": str(rows.size), "VECTOR_COUNT": str(len(integers)),
        })  # fmt: skip

    def _configuration(self) -> str:
        state = section("VAR_GLOBAL", {global_name(path): self.printer.type(kind) for path, kind in self.state.items()})
        return self.constants.configuration(state)
