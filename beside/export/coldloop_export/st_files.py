"""Solver, whole optimiser and output guard as Structured Text: blocks, constants, golden vectors, self-tests.

Tools import it as text, or as one PLCopen XML file (TC6, version 2.01) that is made from the text that is printed. That
takes the text of this package alone: a declaration a line, sections and units that begin and end at a line's start.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import reduce
from itertools import groupby
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np

from coldloop import __version__
from coldloop.process.declaration import Process
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS, Acknowledgement, Plan, SequenceHeader, SequenceRow, Update
from coldloop.registers.declaration import Block as RegisterBlock
from coldloop.registers.declaration import RegisterMap
from coldloop_control_plc.output_limits import beginning
from coldloop_export import golden, st_printer, tree
from coldloop_export.golden import PER_PROBLEM, Array, GoldenCall, GoldenVector, OptimizerKernels, arrays_in, leaves
from coldloop_export.st_lowering import VALUE, Entry, Lowering, Place, Record, Rows, dotted, zeroed
from coldloop_export.st_pausing import ANEW, PIECE, Pausing, an_answer_in_calls, one_iteration_a_call
from coldloop_export.st_printer import Constants, interface_names, memory, portable, scalar_of, section, sum_of
from coldloop_export.tree import ArrayType, Block, Kind, Literal, Name, Path, RecordType, filled, template, type_of
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.solvers.ode import OdeMethod
from coldloop_rig.text_tables import markdown_table

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


class StructuredTextExport(tree.Export):
    """The solver for the matrices of one problem in single precision, cut into calls, with golden vectors.

    Raises UnfitKernelError if a kernel uses what is not in the subset, or a matrix is too large.
    """

    outputs = ("iteration", "element", "iterations_done", "total_us", "longest_us")

    def __init__(self, method: OdeMethod, vectors: Sequence[GoldenVector]) -> None:
        self.vectors = [bounded(method, each) for each in vectors]
        program = golden.OdeProgram(method, vectors[0].problem, np.arange(1, len(self.vectors[0].answer.costs) + 1))
        constants = {path: np.asarray(values) for path, values in program.constants().items()}
        self.printer = st_printer.StructuredTextPrinter(st_printer.types_in(constants))
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

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names, in the order in which they are loaded."""
        return with_types(self.printer, {
            "functions.st": template("structured_text/functions.st"), "kernels.st": self.kernels,
            "golden.st": "\n".join(self._golden(number, each) for number, each in enumerate(self.vectors)),
            "self_test.st": self._self_test(), "configuration.st": self.constants.configuration(),
        })  # fmt: skip

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs."""
        problem = sum(len(getattr(self.vectors[0].problem, name)) for name in PER_PROBLEM) + len(self.vectors[0].guess)
        vector = sum(np.size(values) for values in arrays_in(self.vectors[0]).values())
        return {
            "constants": self.constants.bytes(),
            "an instance of `cl_solver`, with its problem": memory(self.solver) + 4 * problem,
            "self-test and golden vectors": 4 * vector * (len(self.vectors) + 1),
        }

    def _golden(self, number: int, vector: GoldenVector) -> str:
        arrays = arrays_in(vector)
        kinds = {name: self.printer.array_type(scalar_of(values), values.size) for name, values in arrays.items()}
        constants = {
            f"the_{name}": f"{kinds[name]} := {self.constants.value(values)}" for name, values in arrays.items()
        }
        copies = "".join(f"    FOR i := 0 TO {values.size - 1} DO\n        {name}[i] := the_{name}[i];\n    END_FOR;\n"
                         for name, values in arrays.items())  # fmt: skip
        sum_ = reduce(lambda before, values: sum_of(values, before), arrays.values(), 0)
        constants["the_guessed"] = f"REAL := {self.printer.number(vector.answer.guessed)}"
        return "".join([
            f"FUNCTION_BLOCK cl_golden_{number}\n", section("VAR_IN_OUT", kinds),
            section("VAR_OUTPUT", {"guessed": "REAL", "golden_sum": "DINT"}), section("VAR", {"i": "DINT"}),
            section("VAR CONSTANT", constants), copies,
            f"    guessed := the_guessed;\n    golden_sum := {sum_};\nEND_FUNCTION_BLOCK\n",
        ])  # fmt: skip

    def _self_test(self) -> str:
        problem, answer = self.vectors[0].problem, self.vectors[0].answer
        n, m, k = len(problem.phi), len(problem.gamma), len(answer.costs)
        checks, pad = template("structured_text/checks.st") + "\n", " " * 16
        arrays = ", ".join(f"{name} := {name}" for name in arrays_in(self.vectors[0]))
        return filled(checks + template("structured_text/self_test.st") + st_printer.main_program(self.outputs), {
            **self.constants.summed(),
            "WORK": str(WORK), "N": str(n), "M": str(m), "K": str(k), "POINTS": str(n * k), "LAST": str(n - 1),
            "INSTANCES": "\n".join(f"    golden_{each} : cl_golden_{each};" for each in range(len(self.vectors))),
            "AT_ONCE": str(AT_ONCE), "VECTOR_COUNT": str(len(self.vectors)),
            "VECTORS": "".join(
                f"{pad}{each}:\n{pad}    golden_{each}({arrays});\n{pad}    guessed := golden_{each}.guessed;\n"
                f"{pad}    golden_sum := golden_{each}.golden_sum;\n" for each in range(len(self.vectors))
            ).rstrip(),
            "GOLDEN_SUMS": "".join(
                st_printer.summing(name, scalar_of(values), values.size)
                for name, values in arrays_in(self.vectors[0]).items()
            ).rstrip(),
            "SOLVER": st_printer.passed_by_name(self.solver, (ANEW, *self.solver.shared), self.printer.type, 16),
        })  # fmt: skip


def with_types(printer: st_printer.StructuredTextPrinter, texts: Mapping[str, str]) -> dict[str, str]:
    """Return texts as files, before them the types of arrays that they use."""
    return {name: GENERATED + portable(text) for name, text in {"types.st": printer.types(), **texts}.items()}


def bounded(method: OdeMethod, vector: GoldenVector) -> GoldenVector:
    """Return a golden vector with the largest number for an infinite bound, which has no literal, and its answer."""
    most, problem = np.finfo(np.float32).max, vector.problem
    finite = problem._replace(low=np.maximum(problem.low, -most), high=np.minimum(problem.high, most))
    return golden.answered(method, finite, vector.guess)


STATE: Final[Path] = ("m", "state")
FIXED_TICKS: Final[Path] = ("c", "fixed_ticks")
"""Fixed updating period of the session: the one setting that is not constant."""
BEGUN: Final[Path] = (*STATE, "begun")
JOBS: Final[Path] = (*STATE, "jobs")
"""Number of the last plan or solve that was begun."""
JOB: Final[Path] = (*STATE, "job")
"""Number of the one that is under way; 0 is none."""


class OptimizerText(tree.Export):
    """The optimiser of some settings, with its solver cut into calls, and golden updates."""

    outputs = ("element",)

    def __init__(self, optimizer: OptimizerProgram, updates: Sequence[golden.GoldenUpdate]) -> None:
        kernels, self.golden, self._process = OptimizerKernels(optimizer), updates, optimizer.process
        self._arrays = self._golden_arrays()
        one = sum(int(values[0].nbytes) for values in self._arrays.values())
        self._page_length = st_printer.LARGEST_LIST // one
        """Golden updates that a block has within a list of constants."""
        begin, take, solve, note = kernels.entries
        constants, split = st_printer.in_pieces(constants_of(kernels))
        self.state = {**dict(state_types(STATE, type_of(optimizer.state))), FIXED_TICKS: Kind.INT, BEGUN: Kind.BOOL,
                      JOBS: Kind.INT, JOB: Kind.INT}  # fmt: skip
        self.printer = st_printer.StructuredTextPrinter({**st_printer.types_in(constants), **self.state})
        lowering = Lowering({*constants, *split, *self.state}, split)
        of_session, periods = Name(Kind.INT, dotted(FIXED_TICKS)), len(kernels.rules)
        places: dict[str, Place] = {
            "c": Record(("c",)), "m": Record(STATE), "method": Record(("method",)), "latched": Record(("latched",)),
            **{name: Entry(Rows(("r", table), periods), of_session) for name, table in TABLES.items()},
        }  # fmt: skip
        entries = [
            lowering.block(each, {one.name: places[one.name] for one in each.parameters if one.name in places})
            for each in (begin, take, an_answer_in_calls(solve, "method"), note)
        ]
        pausing = Pausing(entries[1:3])
        self.entries = [pausing.block(each) for each in entries]
        self.blocks = [*map(pausing.block, lowering.blocks), self._clearing()]
        self._kernels = "\n".join(map(self.printer.block, self.blocks))
        used = {path for each in lowering.blocks for path in each.constants}
        self.constants = Constants({path: values for path, values in constants.items() if path in used}, self.printer)

    def _clearing(self) -> Block:
        body = tuple(zeroed(Name(kind, dotted(path))) if isinstance(kind, ArrayType)
                     else tree.Assign(Name(kind, dotted(path)), Literal(kind, 0)) for path, kind in self.state.items()
                     if path not in {FIXED_TICKS, JOBS})  # fmt: skip
        at = Name(Kind.INT, "at.0")
        return Block("clear", "coldloop_optimizer_plc/scheme.py", "Make the state zero.", (), (), (), (at,),
                     tuple(self.state), body)  # fmt: skip

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names, in the order in which they are loaded."""
        pages = list(self._pages())
        return with_types(self.printer, {
            "functions.st": template("structured_text/functions.st"), "kernels.st": self._kernels,
            "optimizer.st": self._interface(), "golden.st": "\n".join(pages),
            "self_test.st": self._self_test(len(pages)), "configuration.st": self.constants.configuration(self.state),
        })  # fmt: skip

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs; blocks are an instance of each of the interface."""
        tables = sum(4 * values.size for values in self._arrays.values())
        return {
            "constants": self.constants.bytes(), "state": sum(map(st_printer.size_of, self.state.values())),
            "instances of the four blocks": sum(map(memory, self.entries)), "self-test and golden updates": tables,
        }  # fmt: skip

    def _interface(self) -> str:
        process, (begin, take) = self._process, self.entries[:2]
        passed = st_printer.passed_by_name(take, (*take.inputs, *take.shared), self.printer.type, 12)
        begun = ", ".join(f"{name} := {'TRUE' if each == ANEW else name}"
                          for each, name in interface_names(begin, self.printer.type).items())  # fmt: skip
        return filled(template("structured_text/optimizer/optimizer.st"), {
            **signal_counts(process), "LONGEST": str(process.ticks_per_sample), "SHORTEST": str(SHORTEST_TICKS),
            "LATCHED": passed, "TICK_S": str(process.tick_s), "UNIT": process.load.unit, "BEGIN": begun,
            "PIECE": str(PIECE), "LOAD_STEP": interface_names(take, self.printer.type)[take.outputs[0]],
        })  # fmt: skip

    def _golden_arrays(self) -> dict[str, Array]:
        """Return integers, numbers and rows of the golden updates, and the sum over each of them, a row each."""
        held, inputs = self._process.ticks_per_sample, len(self._process.inputs)
        rows = np.zeros((len(self.golden), SEQUENCE_ROWS // held, inputs), np.float32)
        for place, each in enumerate(self.golden):
            sent = np.array(each.sequence.rows if each.sequence else [], np.float32).reshape(-1, inputs)
            sampled = sent[::held]
            assert (np.repeat(sampled, held, axis=0)[: len(sent)] == sent).all()  # noqa: S101 as it is sent
            rows[place, : len(sampled)] = sampled
        arrays = {**golden.update_tables(self.golden), "rows": rows.reshape(len(rows), -1)}
        sums = [sum_of(three[2], sum_of(three[1], sum_of(three[0]))) for three in zip(*arrays.values(), strict=True)]
        return {**arrays, "sums": np.array(sums, np.int32)[:, None]}

    def _pages(self) -> Iterator[str]:
        arrays, length = self._arrays, self._page_length
        for number, first in enumerate(range(0, len(self.golden), length)):
            part = {name: values[first : first + length] for name, values in arrays.items()}
            shared = {name: self.printer.array_type(scalar_of(values), values.shape[1])
                      for name, values in part.items() if name != "sums"}  # fmt: skip
            constants = {
                f"the_{name}": f"{self.printer.array_type(scalar_of(values), values.size)} := "
                               f"{self.constants.value(values.ravel())}" for name, values in part.items()
            }  # fmt: skip
            copies = "".join(
                f"    FOR i := 0 TO {part[name].shape[1] - 1} DO\n"
                f"        {name}[i] := the_{name}[((row * {part[name].shape[1]}) + i)];\n    END_FOR;\n"
                for name in shared
            )
            yield "".join([
                f"FUNCTION_BLOCK cl_golden_{number}\n", section("VAR_INPUT", {"row": "DINT"}),
                section("VAR_IN_OUT", shared), section("VAR_OUTPUT", {"golden_sum": "DINT"}),
                section("VAR", {"i": "DINT"}), section("VAR CONSTANT", constants), copies,
                "    golden_sum := the_sums[row];\nEND_FUNCTION_BLOCK\n",
            ])  # fmt: skip

    def _self_test(self, pages: int) -> str:
        arrays, page = self._arrays, self._page_length
        lengths = {name: values.shape[1] for name, values in arrays.items() if name != "sums"}
        process, inputs = self._process, len(self._process.inputs)
        places = np.cumsum([1, inputs, inputs, len(process.outputs), len(process.states)])
        cases = "".join(
            f"                {each}:\n"
            f"                    golden_{each}(row := (now_vector MOD {page}), integers := integers, reals := reals,"
            f" rows := rows);\n                    golden_sum := golden_{each}.golden_sum;\n"
            for each in range(pages)
        )
        parts = {
            **signal_counts(process), **self.constants.summed(), "AT_ONCE": str(AT_ONCE), "WORK": str(WORK),
            "ROWS": str(SEQUENCE_ROWS * inputs), "SAMPLE": str(process.ticks_per_sample * inputs),
            **{f"N_{name.upper()}": str(length) for name, length in lengths.items()},
            **{f"AT_{name}": str(place) for name, place in zip(("U", "Y", "X", "PLAN"), places[1:], strict=True)},
            "INSTANCES": "\n".join(f"    golden_{each} : cl_golden_{each};" for each in range(pages)),
            "PAGE": str(page), "PAGES": cases.rstrip(), "VECTOR_COUNT": str(len(self.golden)),
            "GOLDEN_SUMS": "".join(
                st_printer.summing(name, scalar_of(arrays[name]), length) for name, length in lengths.items()
            ).rstrip(),
        }  # fmt: skip
        checks = template("structured_text/checks.st") + "\n"
        return filled(
            checks + template("structured_text/optimizer/self_test.st") + st_printer.main_program(self.outputs), parts
        )


TABLES: Final = {"rule": "rules", "starts": "starts"}
"""Parameters that are of the updating period: their tables."""


def constants_of(kernels: OptimizerKernels) -> dict[Path, Array]:
    """Return the arrays and numbers that never change, and tables of what depends on the fixed updating period."""
    found: dict[Path, Any] = {**leaves(("c",), kernels.constants["constants"]),
                              **leaves(("method",), kernels.constants["method"])}  # fmt: skip
    del found[FIXED_TICKS]
    for table, records in (("rules", kernels.rules), ("starts", kernels.starts)):
        for path in leaves(("r", table), records[0]):
            found[path] = np.array([leaves(("r", table), each)[path] for each in records])
    return {path: np.asarray(values) for path, values in found.items()}


def state_types(path: Path, kind: tree.Type) -> Iterator[tuple[Path, Kind | ArrayType]]:
    """Yield the variables of a state with their types: an array for each number of several records."""
    match kind:
        case RecordType(_, fields):
            for name, part in fields:
                yield from state_types((*path, name), part)
        case tree.RowsType(struct, length):
            for name, number in struct.fields:
                yield (*path, name), number if length == 1 else ArrayType(number, (length,))
        case Kind() | ArrayType():
            yield path, kind


def signal_counts(process: Process) -> Mapping[str, str]:
    """Return how many signals there are, and the last index of each, for a template."""
    counts = {"INPUT": len(process.inputs), "OUTPUT": len(process.outputs), "STATE": len(process.states)}
    return {**{f"{name}S": str(count) for name, count in counts.items()},
            **{f"LAST_{name}": str(count - 1) for name, count in counts.items()}}  # fmt: skip


GUARD_STATE: Final[Path] = ("g", "guard")
TWIN: Final[Path] = ("g", "twin")
"""Copy of the guard's state on which a sequence is played to judge it."""
GUARD_BEGUN: Final[Path] = (*GUARD_STATE, "begun")
PLACES: Final = {"state": Record(GUARD_STATE), "twin": Record(TWIN), "limits": Record(("c", "limits"))}
ROW: Final = {"applied": "wide", "wanted": "wide", "row": "row"}
"""Variables of the interface's blocks that are handed to parameters of the kernels."""
ROWS: Final = {"meanwhile": "before", "rows": "wide", "waiting": "0"}


def of_guard(text: str) -> str:
    """Return text with a prefix of the guard's own for global names, so that the optimiser is loaded beside it."""
    return re.sub(r"\bcl_(?!guard_)", "cg_", text)


class GuardText(tree.Export):
    """The output guard for some limits as Structured Text, with golden calls."""

    def __init__(self, kernels: golden.GuardKernels, calls: Sequence[GoldenCall]) -> None:
        self._tables = golden.tables_of(calls)
        constants = {path: np.asarray(value) for path, value in leaves(("c", "limits"), kernels.limits).items()}
        constants |= {("c", f"golden_{name}"): values for name, values in self._tables.items()}
        state = type_of(beginning(kernels.limits, kernels.limits.low))
        self.state = {**dict(state_types(GUARD_STATE, state)), **dict(state_types(TWIN, state)), GUARD_BEGUN: Kind.BOOL}
        self.printer = st_printer.StructuredTextPrinter({**st_printer.types_in(constants), **self.state}, np.float64)
        lowering = Lowering({*constants, *self.state})
        self.entries = [
            lowering.block(each, {one.name: PLACES[one.name] for one in each.parameters if one.name in PLACES})
            for each in kernels.entries
        ]
        self._kernels = "\n".join(map(self.printer.block, lowering.blocks))
        self.constants = Constants(constants, self.printer)
        n = len(kernels.limits.low)
        self._sizes = {"INPUTS": n, "LAST": n - 1, "NUMBERS": n * SEQUENCE_ROWS, "ROWS": SEQUENCE_ROWS}
        self._counts = {name: str(count) for name, count in self._sizes.items()}

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names, in the order in which they are loaded."""
        functions = ("functions.st", "output_guard/functions_lreal.st")
        texts = with_types(self.printer, {
            "functions.st": "\n".join(template(f"structured_text/{each}") for each in functions),
            "kernels.st": self._kernels, "output_guard.st": self._interface(), "self_test.st": self._self_test(),
            "configuration.st": self.constants.configuration(self.state),
        })  # fmt: skip
        return {name: of_guard(text) for name, text in texts.items()}

    def sizes(self) -> dict[str, int]:
        """Return the bytes of what a PLC needs."""
        tables = sum((8 if values.dtype.kind == "f" else 4) * values.size for values in self._tables.values())
        rows = 2 * 8 * self._sizes["NUMBERS"]
        return {
            "constants": self.constants.bytes() - tables,
            "state": sum(st_printer.size_of(kind, st_printer.DOUBLE) for kind in self.state.values()),
            "instances of the four blocks": rows + sum(memory(each, st_printer.DOUBLE) for each in self.entries),
            "self-test and golden calls": tables,
        }

    def _interface(self) -> str:
        for size in ("INPUTS", "NUMBERS"):
            self.printer.array_type("REAL", self._sizes[size])
        begin, resume, admit, judge, in_range = self.entries
        return filled(template("structured_text/output_guard/output_guard.st"), {
            **self._counts, "BEGIN": self._passed(begin, ROW), "RESUME": self._passed(resume, ROW),
            "ADMIT": self._passed(admit, ROW), "JUDGE": self._passed(judge, ROWS),
            "IN_RANGE": self._passed(in_range, ROW), "INSIDE": self._value(in_range), "PASSES": self._value(judge),
        })  # fmt: skip

    def _passed(self, block: Block, variables: dict[str, str]) -> str:
        names = interface_names(block, self.printer.type)
        return ", ".join(f"{names[each]} := {variables.get(each.name, each.name)}"
                         for each in (*block.inputs, *block.shared))  # fmt: skip

    def _value(self, block: Block) -> str:
        return interface_names(block, self.printer.type)[Name(Kind.BOOL, VALUE)]

    def _self_test(self) -> str:
        checks = template("structured_text/checks.st")
        checks = checks[checks.index("(* Sums up") :] + "\n"  # the other ones are of single precision
        integers, reals, rows = self._tables.values()
        main = st_printer.main_program(self.outputs)
        return filled(checks + template("structured_text/output_guard/self_test.st") + main, {
            **self._counts, **self.constants.summed(), "AT_ONCE": str(AT_ONCE),
            "OF_REALS": str(reals.shape[1]), "N_INTEGERS": str(integers.size), "N_REALS": str(reals.size),
            "N_ROWS": str(rows.size), "VECTOR_COUNT": str(len(integers)),
        })  # fmt: skip


HEADER: Final = ("block", "register", "type", "unit", "field", "variable")
INSTANCES: Final = {Update: "plan", Plan: "plan", Acknowledgement: "answered", SequenceHeader: "solve"}
"""Instances of `cl_optimizer_plan`, `cl_optimizer_solve`, `cl_optimizer_answered`."""
OTHERS: Final = {
    ("update", "session"): "of the client: a new one begins with `restart`",
    ("acknowledgement", "number"): "of the client: is it `solve.number`",
    ("acknowledgement", "verdict"): "`answered.late` is true for 2 (late)",
    ("plan", "update"): "`plan.update` (input)",
}
"""Registers of the client without a variable of the same name, and what stands for them."""


def register_table(control: RegisterMap) -> str:
    """Return a row for each number of the control PLC's map, for arrays one row, in the order of the addresses."""
    blocks = sorted(map(control.block_of, (*INSTANCES, SequenceRow)), key=lambda block: block.address)
    return markdown_table(HEADER, (row for block in blocks for row in rows(block)))


def rows(block: RegisterBlock) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a block."""
    if block.record is SequenceRow:
        first, count = next(block.registers()), len(list(block.registers()))
        yield (block.name, f"{first.address} to {block.end - 1}", first.kind.label, "", "inputs of each tick",
               f"`cl_state_sent_rows[0]` to `[{block.rows * count - 1}]`, {count} x `solve.length`")  # fmt: skip
        return
    for name, registers in groupby(block.registers(), lambda each: each.name.partition(".")[0]):
        listed = list(registers)
        last = listed[-1].address + listed[-1].kind.words - 1
        units = {each.unit for each in listed}
        array = f", `[0]` to `[{len(listed) - 1}]`" if len(listed) > 1 else ""
        variable = OTHERS.get((block.name, name), f"`{INSTANCES[block.record]}.{name}`{array}")
        yield (block.name, f"{listed[0].address} to {last}" if last > listed[0].address else str(last),
               listed[0].kind.label, units.pop() if len(units) == 1 else "", name,
               "of the client" if name in {"crc", "model_digest"} else variable)  # fmt: skip


# -- PLCopen XML -------------------------------------------------------------------------------------------------------

NAMESPACE: Final = "http://www.plcopen.org/xml/tc6_0201"
XHTML: Final = "http://www.w3.org/1999/xhtml"
SECTIONS: Final = {
    "VAR_INPUT": "inputVars", "VAR_OUTPUT": "outputVars", "VAR_IN_OUT": "inOutVars", "VAR_EXTERNAL": "externalVars",
    "VAR": "localVars",
}  # fmt: skip
POUS: Final = {"FUNCTION": "function", "FUNCTION_BLOCK": "functionBlock", "PROGRAM": "program"}
ELEMENTARY: Final = ("BOOL", "DINT", "REAL", "LREAL")

_COMMENT = r"\(\*((?:(?!\*\)).)*)\*\)"
_UNIT = re.compile(
    rf"(?:^{_COMMENT}\n)?^(FUNCTION_BLOCK|FUNCTION|PROGRAM) (\w+)(?: : (\w+))?\n(.*?)^END_\2$", re.MULTILINE | re.DOTALL
)
_SECTION = re.compile(r"^(VAR\w*)( CONSTANT)?\n(.*?)^END_VAR\n", re.MULTILINE | re.DOTALL)
_DECLARATION = re.compile(rf"^    (\w+) : (\w+)(?: := ([^;]+?))?(?: {_COMMENT})?;\n", re.MULTILINE)
_ARRAY = re.compile(r"^    (\w+) : ARRAY \[(\d+)\.\.(\d+)\] OF (\w+);\n", re.MULTILINE)
_CONFIGURATION = re.compile(
    r"^CONFIGURATION (\w+)\n(.*?)^RESOURCE (\w+) ON PLC\n(.*?)^END_RESOURCE", re.MULTILINE | re.DOTALL
)
_TASK = re.compile(r"TASK (\w+)\(INTERVAL := T#(\w+), PRIORITY := (\d+)\);\n    PROGRAM (\w+) WITH \1 : (\w+);")


def plcopen_xml(texts: Iterable[str], content: str) -> str:
    """Return a project with all types, functions, function blocks, programs, constants and the configuration.

    Args:
        texts: Structured Text as this package prints it.
        content: What is in it.
    """
    text = "\n".join(texts)
    project = ET.Element("project", xmlns=NAMESPACE)
    made = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"
    ET.SubElement(project, "fileHeader", companyName="Coldloop", productName="Coldloop", productVersion=__version__,
                  creationDateTime=made, contentDescription=content)  # fmt: skip
    header = ET.SubElement(project, "contentHeader", name="coldloop", modificationDateTime=made)
    coordinates = ET.SubElement(header, "coordinateInfo")
    for language in ("fbd", "ld", "sfc"):
        ET.SubElement(ET.SubElement(coordinates, language), "scaling", x="1", y="1")
    types = ET.SubElement(project, "types")
    data_types = ET.SubElement(types, "dataTypes")
    for name, first, last, kind in _ARRAY.findall(text):
        array = ET.SubElement(ET.SubElement(ET.SubElement(data_types, "dataType", name=name), "baseType"), "array")
        ET.SubElement(array, "dimension", lower=first, upper=last)
        ET.SubElement(array, "baseType").append(_type(kind))
    ET.SubElement(types, "pous").extend(map(_pou, _UNIT.finditer(text)))
    ET.SubElement(ET.SubElement(project, "instances"), "configurations").append(_configuration(text))
    ET.indent(project, " ")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(project, encoding="unicode")}\n'


def _pou(found: re.Match[str]) -> ET.Element:
    note, kind, name, result, text = found.groups()
    pou = ET.Element("pou", name=name, pouType=POUS[kind])
    interface = ET.SubElement(pou, "interface")
    if result:
        ET.SubElement(interface, "returnType").append(_type(result))
    for keyword, constant, declared in _SECTION.findall(text):
        interface.append(_variables(SECTIONS[keyword], declared, constant=bool(constant)))
    body = re.sub(r"^ {4}", "", _SECTION.sub("", text), flags=re.MULTILINE)
    _write(ET.SubElement(ET.SubElement(pou, "body"), "ST"), body)
    if note:
        _write(ET.SubElement(pou, "documentation"), note.strip())
    return pou


def _variables(tag: str, declared: str, *, constant: bool, **attributes: str) -> ET.Element:
    listed = ET.Element(tag, attributes | ({"constant": "true"} if constant else {}))
    for name, kind, value, note in _DECLARATION.findall(declared):
        variable = ET.SubElement(listed, "variable", name=name)
        ET.SubElement(variable, "type").append(_type(kind))
        if value:
            ET.SubElement(variable, "initialValue").append(_value(value))
        if note:
            _write(ET.SubElement(variable, "documentation"), note.strip())
    return listed


def _type(name: str) -> ET.Element:
    return ET.Element(name) if name in ELEMENTARY else ET.Element("derived", name=name)


def _value(text: str) -> ET.Element:
    if not text.startswith("["):
        return ET.Element("simpleValue", value=text)
    array = ET.Element("arrayValue")
    for each in text.strip("[]").split(","):
        ET.SubElement(array, "value").append(_value(each.strip()))
    return array


def _configuration(text: str) -> ET.Element:
    """Return the configuration: its task with what runs in it, and the lists of constants."""
    found = _CONFIGURATION.search(text)
    assert found  # noqa: S101 the text is of this package
    name, declared, resource, tasks = found.groups()
    configuration = ET.Element("configuration", name=name)
    within = ET.SubElement(configuration, "resource", name=resource)
    for task, interval, priority, instance, program in _TASK.findall(tasks):
        running = ET.SubElement(within, "task", name=task, interval=f"T#{interval}", priority=priority)
        ET.SubElement(running, "pouInstance", name=instance, typeName=program)
    for number, (_, constant, listed) in enumerate(_SECTION.findall(declared), 1):
        configuration.append(
            _variables("globalVars", listed, constant=bool(constant), name=f"{name[:3]}constants_{number}")
        )
    return configuration


def _write(element: ET.Element, text: str) -> None:
    ET.SubElement(element, "p", xmlns=XHTML).text = text
