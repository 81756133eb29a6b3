"""Register maps as people and tools read them; all derived from the declarations."""

import csv
import io
import json
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import Final

from coldloop.modbus.endpoints import CONTROL_PORT, OPTIMIZER_PORT, PLANT_PORT
from coldloop.modbus.requests import MAX_READ_WORDS
from coldloop.registers.declaration import Block, Kind, Register, RegisterMap
from coldloop_rig.text_tables import aligned, markdown_table

PORTS: Final = {"plant": PLANT_PORT, "control_plc": CONTROL_PORT, "optimizer_plc": OPTIMIZER_PORT}

COLUMNS: Final = (
    "service", "block", "name", "address", "modicon", "rows", "row_words", "type", "unit", "low", "high", "writer",
    "description", "values",
)  # fmt: skip


def modicon(address: int) -> str:
    """Return the 4xxxx-style address of a 0-based one: five digits, or six beyond 49999."""
    return f"{40001 + address}" if address < 9999 else f"{400001 + address}"


Entry = dict[str, str | int | float | dict[str, str] | None]


def _entries(maps: Sequence[RegisterMap]) -> Iterator[Entry]:
    """Yield one entry a register, the first row of each block."""
    for register_map in maps:
        for block in register_map.shown:
            for register in block.registers():
                yield _entry(register_map.service, block, register)


def _entry(service: str, block: Block, register: Register) -> Entry:
    values = (
        service, block.name, register.name, register.address, modicon(register.address), block.rows,
        block.row_words, register.kind.label, register.unit, register.low, register.high,
        register.writer.value if register.writer else "read-only", register.description, _meanings(register),
    )  # fmt: skip
    return dict(zip(COLUMNS, values, strict=True))


def _meanings(register: Register) -> dict[str, str] | None:
    """Return the meaning of an enumeration's numbers."""
    if register.values is None:
        return None
    return {str(value.value): value.word for value in register.meanings}


def _text(value: str | float | dict[str, str] | None) -> str:
    if value is None:
        return ""
    if isinstance(value, dict):
        return " ".join(f"{number}={name}" for number, name in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


def as_json(maps: Sequence[RegisterMap]) -> str:
    """Return an array of objects; a bound that does not exist is null, `values` has the meaning of enumerations."""
    return json.dumps(list(_entries(maps)), indent=1, ensure_ascii=False) + "\n"


def as_csv(maps: Sequence[RegisterMap]) -> str:
    """Return comma-separated values with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _text(value) for name, value in entry.items()} for entry in _entries(maps))
    return text.getvalue()


def as_table(maps: Sequence[RegisterMap]) -> str:
    """Return aligned columns for a terminal."""
    shown = ("service", "block", "name", "address", "modicon", "type", "unit", "writer")
    rows = [shown, *[tuple(_text(entry[column]) for column in shown) for entry in _entries(maps)]]
    return aligned(rows)


def as_markdown(maps: Sequence[RegisterMap]) -> str:
    """Return the register map's documentation."""
    parts = []
    for register_map in maps:
        parts.append(
            f"## {register_map.service} (port {PORTS[register_map.service]}, map version {register_map.version}, "
            f"digest {register_map.digest:08x})\n"
        )
        parts.append(f"Addresses 0 to {register_map.end - 1}; those in no table read 0 and are not written.\n")
        parts += [_block_markdown(register_map.service, block) for block in register_map.shown]
    return "\n".join(parts)


def _block_markdown(service: str, block: Block) -> str:
    writer = f"written by the {block.writer.value}" if block.writer else "read-only"
    many = f"; {block.rows} rows of {block.row_words} words, the first one shown" if block.rows > 1 else ""
    caption = f"### {block.name}: {block.description} ({writer}{many})\n\n`{mbpoll_line(service, block)}`"
    header = ("address", "4xxxx", "name", "type", "unit", "range", "description")
    rows = [
        (r.address, modicon(r.address), r.name, r.kind.label, r.unit, _range(r), r.description)
        for r in block.registers()
    ]
    return markdown_table(header, rows, caption) + "\n"


def _range(r: Register) -> str:
    return f"{_text(r.low)}..{_text(r.high)}" if r.low is not None or r.high is not None else ""


def mbpoll_line(service: str, block: Block) -> str:
    """Return the mbpoll command that reads a run of equal types in a block's first row: of floats where it has any."""
    runs = [(kind, list(group)) for kind, group in groupby(block.registers(), key=lambda register: register.kind)]
    kind, run = max(runs, key=lambda item: (item[0] is Kind.F32, len(item[1])))
    options = {Kind.F32: "4:float -B", Kind.U32: "4:int -B", Kind.U16: "4"}[kind]
    count = min(len(run), MAX_READ_WORDS // kind.words)
    return f"mbpoll -0 -1 -m tcp -p {PORTS[service]} -t {options} -r {run[0].address} -c {count} 127.0.0.1"


FORMATS: Final[dict[str, Callable[[Sequence[RegisterMap]], str]]] = {
    "table": as_table,
    "markdown": as_markdown,
    "csv": as_csv,
    "json": as_json,
}
