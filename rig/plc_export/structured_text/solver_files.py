"""The ODE-based solver as Structured Text: types, function blocks, constants, golden vectors, a self-test."""

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np

from optimizer_plc.qp.problem import QuadraticProblem
from optimizer_plc.solvers.ode import OdeMethod
from rig.plc_export.kernels.ode_program import PER_PROBLEM, Array, OdeProgram
from rig.plc_export.kernels.recorded_problems import GoldenVector, answered, arrays_in
from rig.plc_export.structured_text.lowering import Lowering
from rig.plc_export.structured_text.printer import (
    TABLE,
    StructuredTextPrinter,
    global_name,
    interface_names,
    memory,
    section,
)
from rig.plc_export.structured_text.slicing import one_iteration_a_call
from rig.plc_export.templates import filled, template
from rig.plc_export.tree.nodes import Path, RecordType
from rig.plc_export.tree.subset import UnfitKernelError, type_of

LARGEST_LIST: Final = 64 * 1024
"""Bytes of a list of constants: a data block of standard access of an S7-1200 or S7-1500 holds no more."""
AT_ONCE: Final = 1000
"""Constants that a call of the self-test sums up: less work than an iteration of the solver."""
PRIME, FACTOR = 65521, 257
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
    """The solver for the matrices of one problem, an iteration a call.

    Args:
        method: Constants of the solver, in single precision.
        problem: One of the problems.
        vectors: Golden vectors.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset, or a matrix is too large.
    """

    def __init__(self, method: OdeMethod, problem: QuadraticProblem, vectors: Iterable[GoldenVector]) -> None:
        self.vectors = [bounded(method, each) for each in vectors]
        program = OdeProgram(method, problem, np.arange(1, len(self.vectors[0].answer.costs) + 1))
        constants = program.constants()
        self.printer = StructuredTextPrinter({path: type_of(values) for path, values in constants.items()})
        function, lowering = one_iteration_a_call(program.entry), Lowering(constants)
        records = {each.name: (each.name,) for each in function.parameters if isinstance(each.type, RecordType)}
        self.solver = lowering.block(function, records)
        self.kernels = "\n".join(
            self.printer.block(each, NOTES if each is self.solver else {}) for each in lowering.blocks
        )
        used = {path for each in lowering.blocks for path in each.constants}
        self.constants: dict[Path, Array] = {
            path: np.asarray(values) for path, values in constants.items() if path in used
        }

    # -- files ---------------------------------------------------------------------------------------------------------

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names, in the order in which they are loaded."""
        golden = "\n".join(self._golden(number, each) for number, each in enumerate(self.vectors))
        test = self._self_test()
        configuration = self._configuration()
        functions = template("structured_text/functions.st")
        texts = {"types.st": self.printer.types(), "functions.st": functions, "kernels.st": self.kernels,
                 "golden.st": golden, "self_test.st": test, "configuration.st": configuration}  # fmt: skip
        return {name: GENERATED + text for name, text in texts.items()}

    def sizes(self) -> Sizes:
        """Return the bytes of the constants, of the solver and of the self-test."""
        problem = sum(len(getattr(self.vectors[0].problem, name)) for name in PER_PROBLEM) + len(self.vectors[0].guess)
        constants = 4 * (len(self.printer.literals) + sum(values.size for values in self.constants.values()))
        vector = sum(np.size(values) for values in arrays_in(self.vectors[0]).values())
        return Sizes(constants, memory(self.solver) + 4 * problem, 4 * vector * (len(self.vectors) + 1))

    def calls(self) -> int:
        """Return how often the self-test is called until it is done."""
        return 1 + -(-sum(self._lengths()) // AT_ONCE) + sum(1 + len(each.answer.costs) for each in self.vectors)

    # -- constants -----------------------------------------------------------------------------------------------------

    def _lengths(self) -> list[int]:
        return [len(self.printer.literals), *(values.size for values in self.constants.values())]

    def _globals(self) -> dict[str, tuple[str, int, str]]:
        """Return type, bytes and value of each constant."""
        literals = f"[\n        {', '.join(self.printer.literals)}]"
        found = {TABLE: (f"{TABLE}_table", 4 * len(self.printer.literals), literals)}
        for path, values in self.constants.items():
            self.printer.where = global_name(path)
            found[global_name(path)] = (self.printer.type(type_of(values[()])), 4 * values.size, self._value(values))
        return found

    def _value(self, values: Array) -> str:
        """Return a number, or an array as an initialiser."""
        if values.dtype.kind == "b":
            return "TRUE" if values else "FALSE"
        number = self.printer.number if values.dtype.kind == "f" else lambda each: str(int(each))
        printed = [number(each) for each in values.ravel()]
        rows = [", ".join(printed[place : place + 6]) for place in range(0, len(printed), 6)]
        return f"[\n        {(',' + chr(10) + ' ' * 8).join(rows)}]" if values.ndim else printed[0]

    def _lists(self) -> Iterator[str]:
        """Yield lists of constants, none larger than tools take."""
        listed: dict[str, str] = {}
        room = LARGEST_LIST
        for name, (kind, size, value) in self._globals().items():
            if size > LARGEST_LIST:
                raise UnfitKernelError(f"{name}: {size} bytes, and a list of constants has at most {LARGEST_LIST}")
            if size > room:
                yield section("VAR_GLOBAL CONSTANT", listed)
                listed, room = {}, LARGEST_LIST
            listed[name] = f"{kind} := {value}"
            room -= size
        yield section("VAR_GLOBAL CONSTANT", listed)

    def _configuration(self) -> str:
        lists = "".join(self._lists())
        return f"""CONFIGURATION cl_configuration
{lists}RESOURCE cl_resource ON PLC
    TASK cl_task(INTERVAL := T#250ms, PRIORITY := 1);
    PROGRAM cl_instance WITH cl_task : cl_main;
END_RESOURCE
END_CONFIGURATION
"""

    def _sum_of_constants(self) -> int:
        sum_ = sum_of(np.array([float(each.removeprefix("REAL#")) for each in self.printer.literals], np.float32))
        for values in self.constants.values():
            sum_ = sum_of(values, sum_)
        return sum_

    # -- golden vectors and self-test ----------------------------------------------------------------------------------

    def _golden(self, number: int, vector: GoldenVector) -> str:
        """Return the block that copies a golden vector to where the self-test has it."""
        arrays, self.printer.where = arrays_in(vector), f"golden vector {number}"
        kinds = {name: self.printer.array_type(scalar_of(values), values.size) for name, values in arrays.items()}
        constants = {f"the_{name}": f"{kinds[name]} := {self._value(values)}" for name, values in arrays.items()}
        copies = "".join(f"    FOR i := 0 TO {values.size - 1} DO\n        {name}[i] := the_{name}[i];\n    END_FOR;\n"
                         for name, values in arrays.items())  # fmt: skip
        guessed = self.printer.number(vector.answer.guessed)
        return "".join([
            f"FUNCTION_BLOCK cl_golden_{number}\n", section("VAR_IN_OUT", kinds),
            section("VAR_OUTPUT", {"guessed": "REAL", "golden_sum": "DINT"}), section("VAR", {"i": "DINT"}),
            section("VAR CONSTANT", constants), copies,
            f"    guessed := {guessed};\n    golden_sum := {sum_of_vector(vector)};\nEND_FUNCTION_BLOCK\n",
        ])  # fmt: skip

    def _self_test(self) -> str:
        problem, answer = self.vectors[0].problem, self.vectors[0].answer
        globals_ = self._globals()
        n, m, k = len(problem.phi), len(problem.gamma), len(answer.costs)
        lengths = self._lengths()
        self.printer.array_type("DINT", len(lengths))
        return filled(template("structured_text/self_test.st"), {
            "CALLS": str(self.calls()), "N": str(n), "M": str(m), "K": str(k), "POINTS": str(n * k), "LAST": str(n - 1),
            "EXTERNALS": "\n".join(f"    {name} : {kind};" for name, (kind, _, _) in globals_.items()),
            "INSTANCES": "\n".join(f"    golden_{each} : cl_golden_{each};" for each in range(len(self.vectors))),
            "PARTS": str(len(lengths)), "LENGTHS": ", ".join(map(str, lengths)), "AT_ONCE": str(AT_ONCE),
            "CONSTANTS": "".join(self._item(part, name) for part, name in enumerate(globals_)).rstrip(),
            "SUM": str(self._sum_of_constants()), "VECTOR_COUNT": str(len(self.vectors)),
            "VECTORS": "".join(self._loaded(each) for each in range(len(self.vectors))).rstrip(),
            "GOLDEN_SUMS": "".join(summed(*each) for each in arrays_in(self.vectors[0]).items()).rstrip(),
            "SOLVER": self._problem_passed(),
        })  # fmt: skip

    def _item(self, part: int, name: str) -> str:
        """Return the case of the self-test that reads an element of a constant."""
        values = next((each for path, each in self.constants.items() if global_name(path) == name), None)
        pad = " " * 20
        if values is not None and values.dtype.kind == "b":
            read = f"IF {name} THEN\n{pad}    item := 1;\n{pad}ELSE\n{pad}    item := 0;\n{pad}END_IF;"
        else:
            element = f"{name}[offset]" if values is None or values.ndim else name
            real = values is None or values.dtype.kind == "f"
            read = f"item := {f'cl_bits({element})' if real else element};"
        return f"{pad}{part}:\n{pad}    {read.replace(chr(10), chr(10) + '    ')}\n"

    def _loaded(self, number: int) -> str:
        pad = " " * 16
        arrays = ", ".join(f"{name} := {name}" for name in arrays_in(self.vectors[0]))
        return (f"{pad}{number}:\n{pad}    golden_{number}({arrays});\n{pad}    guessed := golden_{number}.guessed;\n"
                f"{pad}    golden_sum := golden_{number}.golden_sum;\n")  # fmt: skip

    def _problem_passed(self) -> str:
        names = interface_names(self.solver, self.printer.type)
        return ",\n".join(
            f"                {names[each]} := {each.name.rpartition('.')[2]}" for each in self.solver.shared
        )


def bounded(method: OdeMethod, vector: GoldenVector) -> GoldenVector:
    """Return a golden vector with the largest number for an infinite bound, which has no literal, and its answer."""
    most = np.finfo(np.float32).max
    problem = vector.problem
    return answered(method, problem._replace(low=np.maximum(problem.low, -most), high=np.minimum(problem.high, most)),
                    vector.guess)  # fmt: skip


def scalar_of(values: Array) -> str:
    """Return the type of an array's elements."""
    return "REAL" if values.dtype.kind == "f" else "DINT"


def sum_of(values: Array, before: int = 0) -> int:
    """Return the sum over numbers that the self-test computes: no change of one bit leaves it as it is."""
    if values.dtype.kind == "f":
        single = values.astype(np.float32).ravel()
        items = np.abs(single).view(np.int32).astype(int) * np.where(single < 0, -1, 1)
    else:
        items = values.astype(int).ravel()
    for item in items.tolist():
        before = (before * FACTOR + item % PRIME) % PRIME
    return before


def sum_of_vector(vector: GoldenVector) -> int:
    """Return the sum over a golden vector."""
    sum_ = 0
    for values in arrays_in(vector).values():
        sum_ = sum_of(values, sum_)
    return sum_


def summed(name: str, values: Array) -> str:
    """Return the loop of the self-test that sums up an array of a golden vector."""
    item = f"cl_bits({name}[i])" if scalar_of(values) == "REAL" else f"{name}[i]"
    return (f"            FOR i := 0 TO {values.size - 1} DO\n"
            f"                sum := cl_floor_mod(((sum * {FACTOR}) + cl_floor_mod({item}, {PRIME})), {PRIME});\n"
            "            END_FOR;\n")  # fmt: skip
