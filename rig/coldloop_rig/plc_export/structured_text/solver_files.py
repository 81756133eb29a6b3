"""The ODE-based solver as Structured Text: types, function blocks, constants, golden vectors, a self-test."""

from collections.abc import Iterable
from typing import ClassVar, Final, NamedTuple

import numpy as np

from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.ode import OdeMethod
from coldloop_rig.plc_export.kernels.ode_program import PER_PROBLEM, OdeProgram
from coldloop_rig.plc_export.kernels.recorded_problems import GoldenVector, answered, arrays_in
from coldloop_rig.plc_export.structured_text.constants import (
    Constants,
    scalar_of,
    sum_of,
    summing,
    types_in,
)
from coldloop_rig.plc_export.structured_text.dialects import portable
from coldloop_rig.plc_export.structured_text.lowering import Lowering
from coldloop_rig.plc_export.structured_text.pausing import ANEW, Pausing
from coldloop_rig.plc_export.structured_text.places import Record
from coldloop_rig.plc_export.structured_text.printer import (
    StructuredTextPrinter,
    memory,
    passed_by_name,
    section,
)
from coldloop_rig.plc_export.structured_text.slicing import one_iteration_a_call
from coldloop_rig.plc_export.structured_text.verdict import main_program
from coldloop_rig.plc_export.templates import filled, template
from coldloop_rig.plc_export.tree.nodes import RecordType

WORK: Final = 10_000
"""Operations that a call is given to do in the self-test: it exceeds them by less than a piece."""
AT_ONCE: Final = 1000
"""Constants that a call of the self-test sums up: less work than an iteration of the solver."""
NOTES: Final = {
    "z": "the profile after the iterations done",
    "cost": "its augmented cost",
    "done": "iterations done since the start",
    "guessed": "cost of the guess",
    "stalled": "iterations in a row that gained nothing; at 20 the profile is stationary",
}
GENERATED: Final = "(* Written by Coldloop from the kernels of its optimiser; changes belong there. *)\n"


class Sizes(NamedTuple):
    """Bytes that a PLC needs."""

    constants: int
    solver: int
    """An instance, with its problem."""
    self_test: int
    """More, with the golden vectors."""


class StructuredTextExport:
    """The solver for the matrices of one problem, cut into calls.

    Args:
        method: Constants of the solver, in single precision.
        problem: One of the problems.
        vectors: Golden vectors.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset, or a matrix is too large.
    """

    outputs: ClassVar[tuple[str, ...]] = ("iteration", "element", "iterations_done", "total_us", "longest_us")
    """Of the self-test, beside those of each."""

    def __init__(self, method: OdeMethod, problem: QuadraticProblem, vectors: Iterable[GoldenVector]) -> None:
        self.vectors = [bounded(method, each) for each in vectors]
        program = OdeProgram(method, problem, np.arange(1, len(self.vectors[0].answer.costs) + 1))
        constants = {path: np.asarray(values) for path, values in program.constants().items()}
        self.printer = StructuredTextPrinter(types_in(constants))
        function, lowering = one_iteration_a_call(program.entry), Lowering(constants)
        records = {each.name: Record((each.name,)) for each in function.parameters if isinstance(each.type, RecordType)}
        whole = lowering.block(function, records)
        pausing = Pausing((whole,))
        self.solver = pausing.block(whole)
        self.kernels = "\n".join(
            self.printer.block(each, NOTES if each is self.solver else {})
            for each in map(pausing.block, lowering.blocks)
        )
        used = {path for each in lowering.blocks for path in each.constants}
        self.constants = Constants({path: values for path, values in constants.items() if path in used}, self.printer)

    # -- files ---------------------------------------------------------------------------------------------------------

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names, in the order in which they are loaded."""
        golden = "\n".join(self._golden(number, each) for number, each in enumerate(self.vectors))
        test = self._self_test()
        functions, lists = template("structured_text/functions.st"), self.constants.configuration()
        texts = {"types.st": self.printer.types(), "functions.st": functions, "kernels.st": self.kernels,
                 "golden.st": golden, "self_test.st": test, "configuration.st": lists}  # fmt: skip
        return {name: GENERATED + portable(text) for name, text in texts.items()}

    def sizes(self) -> Sizes:
        """Return the bytes of the constants, of the solver and of the self-test."""
        problem = sum(len(getattr(self.vectors[0].problem, name)) for name in PER_PROBLEM) + len(self.vectors[0].guess)
        vector = sum(np.size(values) for values in arrays_in(self.vectors[0]).values())
        return Sizes(self.constants.bytes(), memory(self.solver) + 4 * problem, 4 * vector * (len(self.vectors) + 1))

    # -- golden vectors and self-test ----------------------------------------------------------------------------------

    def _golden(self, number: int, vector: GoldenVector) -> str:
        """Return the block that copies a golden vector to where the self-test has it."""
        arrays = arrays_in(vector)
        kinds = {name: self.printer.array_type(scalar_of(values), values.size) for name, values in arrays.items()}
        constants = {
            f"the_{name}": f"{kinds[name]} := {self.constants.value(values)}" for name, values in arrays.items()
        }
        copies = "".join(f"    FOR i := 0 TO {values.size - 1} DO\n        {name}[i] := the_{name}[i];\n    END_FOR;\n"
                         for name, values in arrays.items())  # fmt: skip
        constants["the_guessed"] = f"REAL := {self.printer.number(vector.answer.guessed)}"
        return "".join([
            f"FUNCTION_BLOCK cl_golden_{number}\n", section("VAR_IN_OUT", kinds),
            section("VAR_OUTPUT", {"guessed": "REAL", "golden_sum": "DINT"}), section("VAR", {"i": "DINT"}),
            section("VAR CONSTANT", constants), copies,
            f"    guessed := the_guessed;\n    golden_sum := {sum_of_vector(vector)};\nEND_FUNCTION_BLOCK\n",
        ])  # fmt: skip

    def _self_test(self) -> str:
        problem, answer = self.vectors[0].problem, self.vectors[0].answer
        n, m, k = len(problem.phi), len(problem.gamma), len(answer.costs)
        checks = template("structured_text/checks.st") + "\n"
        return filled(checks + template("structured_text/self_test.st") + main_program(self.outputs), {
            **self.constants.summed(),
            "WORK": str(WORK), "N": str(n), "M": str(m), "K": str(k), "POINTS": str(n * k), "LAST": str(n - 1),
            "INSTANCES": "\n".join(f"    golden_{each} : cl_golden_{each};" for each in range(len(self.vectors))),
            "AT_ONCE": str(AT_ONCE), "VECTOR_COUNT": str(len(self.vectors)),
            "VECTORS": "".join(self._loaded(each) for each in range(len(self.vectors))).rstrip(),
            "GOLDEN_SUMS": "".join(
                summing(name, scalar_of(values), values.size) for name, values in arrays_in(self.vectors[0]).items()
            ).rstrip(),
            "SOLVER": passed_by_name(self.solver, (ANEW, *self.solver.shared), self.printer.type, 16),
        })  # fmt: skip

    def _loaded(self, number: int) -> str:
        pad = " " * 16
        arrays = ", ".join(f"{name} := {name}" for name in arrays_in(self.vectors[0]))
        return (f"{pad}{number}:\n{pad}    golden_{number}({arrays});\n{pad}    guessed := golden_{number}.guessed;\n"
                f"{pad}    golden_sum := golden_{number}.golden_sum;\n")  # fmt: skip


def bounded(method: OdeMethod, vector: GoldenVector) -> GoldenVector:
    """Return a golden vector with the largest number for an infinite bound, which has no literal, and its answer."""
    most = np.finfo(np.float32).max
    problem = vector.problem
    return answered(method, problem._replace(low=np.maximum(problem.low, -most), high=np.minimum(problem.high, most)),
                    vector.guess)  # fmt: skip


def sum_of_vector(vector: GoldenVector) -> int:
    """Return the sum over a golden vector."""
    sum_ = 0
    for values in arrays_in(vector).values():
        sum_ = sum_of(values, sum_)
    return sum_
