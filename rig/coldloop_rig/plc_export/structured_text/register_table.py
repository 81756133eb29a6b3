"""Which register of the control PLC goes to which variable of the exported optimiser, as a table."""

from collections.abc import Iterator
from itertools import groupby
from typing import Final

from coldloop.registers.control_plc import Acknowledgement, Plan, SequenceHeader, SequenceRow, Update
from coldloop.registers.declaration import Block, Register, RegisterMap
from coldloop_rig.text_tables import markdown_table

HEADER: Final = ("block", "register", "type", "unit", "field", "variable")
INSTANCES: Final = {Update: "plan", Plan: "plan", Acknowledgement: "answered", SequenceHeader: "solve"}
"""Instances of `cl_optimizer_plan`, `cl_optimizer_solve`, `cl_optimizer_answered`."""
OTHERS: Final = {
    ("update", "session"): "of the client: a new one begins with `restart`",
    ("acknowledgement", "number"): "of the client: is it `solve.number`",
    ("acknowledgement", "verdict"): "`answered.late` is true for 2 (late)",
    ("plan", "update"): "`plan.update` (input)",
}
"""Of the client: what is no variable of the same name."""


def register_table(control: RegisterMap) -> str:
    """Return a row for each number of the control PLC's map, for arrays one row, in the order of the addresses."""
    blocks = sorted(map(control.block_of, (*INSTANCES, SequenceRow)), key=lambda block: block.address)
    return markdown_table(HEADER, (row for block in blocks for row in rows(block)))


def rows(block: Block) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a block."""
    if block.record is SequenceRow:
        first, count = next(block.registers()), len(list(block.registers()))
        yield (block.name, f"{first.address} to {block.end - 1}", first.kind.label, "", "inputs of each tick",
               f"`cl_state_sent_rows[0]` to `[{block.rows * count - 1}]`, {count} x `solve.length`")  # fmt: skip
        return
    for name, registers in groupby(block.registers(), lambda each: each.name.partition(".")[0]):
        listed = list(registers)
        last = listed[-1].address + listed[-1].kind.words - 1
        yield (block.name, f"{listed[0].address} to {last}" if last > listed[0].address else str(last),
               listed[0].kind.label, units(listed), name, variable(block, name, len(listed)))  # fmt: skip


def variable(block: Block, name: str, length: int) -> str:
    """Return the variable of a field."""
    if name in {"crc", "model_digest"}:
        return "of the client"
    array = f", `[0]` to `[{length - 1}]`" if length > 1 else ""
    return OTHERS.get((block.name, name), f"`{INSTANCES[block.record]}.{name}`{array}")


def units(registers: list[Register]) -> str:
    """Return the unit of all of them, if they have one."""
    found = {each.unit for each in registers}
    return found.pop() if len(found) == 1 else ""
