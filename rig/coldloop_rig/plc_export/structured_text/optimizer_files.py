"""The whole optimiser as Structured Text: blocks of its kernels, its interface, constants, golden updates, a self-test.

Its state is global, as there is one optimiser; so are its constants.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from coldloop.process.declaration import Process
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_rig.plc_export.kernels.ode_program import Array, leaves
from coldloop_rig.plc_export.kernels.optimizer_program import OptimizerKernels
from coldloop_rig.plc_export.kernels.recorded_updates import GoldenUpdate, integers_of, reals_of
from coldloop_rig.plc_export.structured_text.constants import (
    LARGEST_LIST,
    Constants,
    in_pieces,
    scalar_of,
    sum_of,
    summing,
    types_in,
)
from coldloop_rig.plc_export.structured_text.dialects import portable
from coldloop_rig.plc_export.structured_text.lowering import Lowering, zeroed
from coldloop_rig.plc_export.structured_text.pausing import ANEW, PIECE, Pausing
from coldloop_rig.plc_export.structured_text.places import Entry, Place, Record, Rows, dotted
from coldloop_rig.plc_export.structured_text.printer import (
    StructuredTextPrinter,
    global_name,
    interface_names,
    memory,
    passed_by_name,
    section,
    size_of,
)
from coldloop_rig.plc_export.structured_text.slicing import an_answer_in_calls
from coldloop_rig.plc_export.structured_text.solver_files import AT_ONCE, GENERATED, WORK
from coldloop_rig.plc_export.structured_text.verdict import main_program
from coldloop_rig.plc_export.templates import filled, template
from coldloop_rig.plc_export.tree.nodes import (
    ArrayType,
    Assign,
    Block,
    Kind,
    Literal,
    Name,
    Path,
    RecordType,
    RowsType,
    Type,
)
from coldloop_rig.plc_export.tree.subset import type_of

STATE: Final[Path] = ("m", "state")
FIXED_TICKS: Final[Path] = ("c", "fixed_ticks")
"""Of the session: the one setting that is not constant."""
BEGUN: Final[Path] = (*STATE, "begun")
JOBS: Final[Path] = (*STATE, "jobs")
"""Number of the last plan or solve that was begun."""
JOB: Final[Path] = (*STATE, "job")
"""Number of the one that is under way; 0 is none."""


class Sizes(NamedTuple):
    """Bytes that a PLC needs."""

    constants: int
    state: int
    blocks: int
    """Variables of one instance of each block of the interface, and of what it calls."""
    self_test: int
    """More, with the golden updates."""


class OptimizerText:
    """The optimiser of some settings, with its solver cut into calls.

    Args:
        optimizer: Its program.
        golden: Updates with their answers.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset.
    """

    outputs: ClassVar[tuple[str, ...]] = ("element",)
    """Of the self-test, beside those of each."""

    def __init__(self, optimizer: OptimizerProgram, golden: Sequence[GoldenUpdate]) -> None:
        kernels, self.golden, self._process = OptimizerKernels(optimizer), golden, optimizer.process
        begin, take, solve, note = kernels.entries
        constants, split = in_pieces(constants_of(kernels))
        self.state = {**dict(state_types(STATE, type_of(optimizer.state))), FIXED_TICKS: Kind.INT, BEGUN: Kind.BOOL,
                      JOBS: Kind.INT, JOB: Kind.INT}  # fmt: skip
        self.printer = StructuredTextPrinter({**types_in(constants), **self.state})
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
        """Return the block that makes the state zero."""
        body = tuple(zeroed(Name(kind, dotted(path))) if isinstance(kind, ArrayType)
                     else Assign(Name(kind, dotted(path)), Literal(kind, 0)) for path, kind in self.state.items()
                     if path not in {FIXED_TICKS, JOBS})  # fmt: skip
        at = Name(Kind.INT, "at.0")
        return Block("clear", "coldloop_optimizer_plc/session_state.py", "Make the state zero.", (), (), (), (at,),
                     tuple(self.state), body)  # fmt: skip

    # -- files ---------------------------------------------------------------------------------------------------------

    def files(self) -> dict[str, str]:
        """Return the texts of the files by their names, in the order in which they are loaded."""
        pages = list(self._pages())
        texts = {
            "types.st": "", "functions.st": template("structured_text/functions.st"), "kernels.st": self._kernels,
            "optimizer.st": self._interface(), "golden.st": "\n".join(pages),
            "self_test.st": self._self_test(len(pages)), "configuration.st": self._configuration(),
        }  # fmt: skip
        texts["types.st"] = self.printer.types()
        return {name: GENERATED + portable(text) for name, text in texts.items()}

    def sizes(self) -> Sizes:
        """Return the bytes of constants, state, blocks and self-test."""
        golden = sum(4 * values.size for values in self._golden_arrays().values())
        return Sizes(self.constants.bytes(), sum(map(size_of, self.state.values())), sum(map(memory, self.entries)),
                     golden)  # fmt: skip

    def _interface(self) -> str:
        process, (begin, take) = self._process, self.entries[:2]
        passed = passed_by_name(take, (*take.inputs, *take.shared), self.printer.type, 12)
        begun = ", ".join(f"{name} := {'TRUE' if each == ANEW else name}"
                          for each, name in interface_names(begin, self.printer.type).items())  # fmt: skip
        return filled(template("structured_text/optimizer/optimizer.st"), {
            **signal_counts(process), "LONGEST": str(process.ticks_per_sample), "SHORTEST": str(SHORTEST_TICKS),
            "LATCHED": passed, "TICK_S": str(process.tick_s), "UNIT": process.load.unit, "BEGIN": begun,
            "PIECE": str(PIECE), "LOAD_STEP": interface_names(take, self.printer.type)[take.outputs[0]],
        })  # fmt: skip

    def _configuration(self) -> str:
        state = section("VAR_GLOBAL", {global_name(path): self.printer.type(kind) for path, kind in self.state.items()})
        return self.constants.configuration(state)

    # -- golden updates and self-test ----------------------------------------------------------------------------------

    def _golden_arrays(self) -> dict[str, Array]:
        """Return integers, numbers and rows of the golden updates, and the sum over each of them, a row each."""
        held, inputs = self._process.ticks_per_sample, len(self._process.inputs)
        rows = np.zeros((len(self.golden), SEQUENCE_ROWS // held, inputs), np.float32)
        for place, each in enumerate(self.golden):
            sent = np.array(each.sequence.rows if each.sequence else [], np.float32).reshape(-1, inputs)
            sampled = sent[::held]
            assert (np.repeat(sampled, held, axis=0)[: len(sent)] == sent).all()  # noqa: S101 as it is sent
            rows[place, : len(sampled)] = sampled
        arrays = {
            "integers": np.array([integers_of(each) for each in self.golden], np.int32),
            "reals": np.array([reals_of(each) for each in self.golden], np.float32),
            "rows": rows.reshape(len(rows), -1),
        }
        sums = [sum_of(three[2], sum_of(three[1], sum_of(three[0]))) for three in zip(*arrays.values(), strict=True)]
        return {**arrays, "sums": np.array(sums, np.int32)[:, None]}

    def _page_length(self) -> int:
        """Return how many golden updates a block has within a list of constants."""
        return LARGEST_LIST // sum(int(values[0].nbytes) for values in self._golden_arrays().values())

    def _pages(self) -> Iterator[str]:
        """Yield the blocks that copy a golden update to where the self-test has it."""
        arrays, length = self._golden_arrays(), self._page_length()
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
        arrays, page = self._golden_arrays(), self._page_length()
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
                summing(name, scalar_of(arrays[name]), length) for name, length in lengths.items()
            ).rstrip(),
        }  # fmt: skip
        checks = template("structured_text/checks.st") + "\n"
        return filled(checks + template("structured_text/optimizer/self_test.st") + main_program(self.outputs), parts)


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


def state_types(path: Path, kind: Type) -> Iterator[tuple[Path, Kind | ArrayType]]:
    """Yield the variables of a state with their types: an array for each number of several records."""
    match kind:
        case RecordType(_, fields):
            for name, part in fields:
                yield from state_types((*path, name), part)
        case RowsType(struct, length):
            for name, number in struct.fields:
                yield (*path, name), number if length == 1 else ArrayType(number, (length,))
        case Kind() | ArrayType():
            yield path, kind


def signal_counts(process: Process) -> Mapping[str, str]:
    """Return how many signals there are, and the last index of each, for a template."""
    counts = {"INPUT": len(process.inputs), "OUTPUT": len(process.outputs), "STATE": len(process.states)}
    return {**{f"{name}S": str(count) for name, count in counts.items()},
            **{f"LAST_{name}": str(count - 1) for name, count in counts.items()}}  # fmt: skip
