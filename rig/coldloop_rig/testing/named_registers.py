"""Registers of a server by their names in docs/registers.md."""

from collections.abc import Callable, Coroutine, Iterator
from difflib import get_close_matches
from typing import Any, NamedTuple

from coldloop.errors import UnfitValueError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.endpoints import Endpoint
from coldloop.registers.declaration import Block, RegisterMap

Call = Callable[[Coroutine[Any, Any, Any]], Any]
Record = tuple[Any, ...]


class _Place(NamedTuple):
    block: Block
    field: str
    element: int | None
    """Index in an array; None is all of the field."""


class NamedRegisters:
    """A Modbus client of one service, with the roles of this machine's address or of the rig's certificate.

    A name is that of the block, a dot, and that of the register: `measurement.y.T5`, `operator.mode`. Without the
    element it is the whole array: `measurement.y`. Values have the units of the register map.

    A block with a CRC that was never sealed cannot be read (`DamagedAnswerError`): write all of it.

    All methods raise `UsageError` for a name that does not exist, `PeerUnreachableError` when the service does not
    answer, and `RequestRefusedError`, with the `exception_code`, when it refuses the request.
    """

    def __init__(self, register_map: RegisterMap, endpoint: Endpoint, client: RegisterClient, call: Call) -> None:
        self._client = client
        self._call = call
        self._blocks = {block.name: block for block in register_map.blocks}
        self._places = {name: place for block in register_map.blocks for name, place in _places_of(block)}
        self.endpoint = endpoint
        """Where the service listens, for clients of your own."""
        self.latest: dict[str, Any] = {}
        """What was read last, by name, since `clear`."""

    def read(self, name: str, *, row: int = 0) -> Any:  # noqa: ANN401 a number, or a tuple of an array
        """Return the value of a register; `row` counts from 0 in blocks that have several."""
        place = self._place(name)
        value = getattr(self._record(place.block, row), place.field)
        self.latest[name] = value = value if place.element is None else value[place.element]
        return value

    def read_block(self, block: str, *, row: int = 0) -> Any:  # noqa: ANN401 the record of that block
        """Return all registers of a block, read in one request, as a named tuple."""
        self.latest[block] = found = self._record(self._block(block), row)
        return found

    def write(self, name: str, value: float | Record, *, row: int = 0) -> None:
        """Write a register; the others of its block are written as they were read just before."""
        place = self._place(name)
        if place.element is not None:
            values = list(getattr(self._record(place.block, row), place.field))
            values[place.element] = value
            value = tuple(values)
        self.write_block(place.block.name, row=row, **{place.field: value})

    def write_block(self, block: str, *, row: int = 0, **values: Any) -> None:  # noqa: ANN401 as the registers are
        """Write a block in one request, with its CRC if it has one; registers that are not named keep what was read."""
        where = self._block(block)
        names = [name for name in where.fields if name != "crc" or not where.sealed]
        own = [element for field in where.fields.values() if field.each for element in field.elements]
        unknown = [name for name in values if name not in (*names, *own)]
        if unknown:
            raise UsageError(f"block '{block}' has no register '{unknown[0]}'; it has {', '.join((*names, *own))}")
        for name, field in where.fields.items():  # registers of their own names are given by these, or as one array
            single = {element: values.pop(element) for element in field.elements if field.each and element in values}
            if single:
                known = (
                    single
                    if len(single) == len(field.elements)
                    else {**dict(zip(field.elements, getattr(self._record(where, row), name), strict=True)), **single}
                )
                values[name] = tuple(known[element] for element in field.elements)
        if len(values) == len(names):
            record = where.record(**values, **({"crc": 0} if where.sealed else {}))
        else:
            record = self._record(where, row)._replace(**values)
        try:
            self._call(self._client.write_rows([record], row))
        except (UnfitValueError, TypeError) as error:
            given = ", ".join(f"{name}={value!r}" for name, value in values.items())
            reason = str(error).rpartition(": ")[2]
            raise UsageError(f"block '{block}' cannot hold {given}: {reason}") from None

    def _record(self, block: Block, row: int) -> Any:  # noqa: ANN401 the record of that block
        if not 0 <= row < block.rows:
            raise UsageError(f"block '{block.name}' has rows 0 to {block.rows - 1}, not {row}")
        return self._call(self._client.read_rows(block.record, row, 1))[0]

    def _block(self, name: str) -> Block:
        if name not in self._blocks:
            raise UsageError(f"unknown block '{name}'; choose from {', '.join(self._blocks)}")
        return self._blocks[name]

    def _place(self, name: str) -> _Place:
        if name not in self._places:
            close = get_close_matches(name, self._places, n=3)
            hint = f"did you mean {', '.join(close)}" if close else "see `coldloop registers`: BLOCK.NAME"
            raise UsageError(f"no register '{name}'; {hint}")
        return self._places[name]


def _places_of(block: Block) -> Iterator[tuple[str, _Place]]:
    for name, field in block.fields.items():
        yield f"{block.name}.{name}", _Place(block, name, None)
        before = block.name if field.each else f"{block.name}.{name}"
        for index, element in enumerate(field.elements):
            yield f"{before}.{element}", _Place(block, name, index)
