"""Records of a service that decide what a client does: read, and checked against their declaration."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from math import isfinite
from typing import Any, Final, TypeVar

from coldloop.errors import LinkError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.declaration import Field, Kind, fields_of

R = TypeVar("R", bound=tuple[Any, ...])

ANSWER_S: Final = 10.0
"""How long a rig may take to answer all that a command asks at once."""


async def told(client: RegisterClient, record: type[R]) -> R:
    """Return a record whose values are all within their declared ranges.

    Raises:
        LinkError: One is not; or there is no answer.
    """
    row = await client.read(record)
    for (name, field), value in zip(fields_of(record).items(), row, strict=True):
        for number in value if field.elements else (value,):
            for problem in _problems(field, number):
                raise LinkError(f"{client.peer} tells {record.__name__}.{name} = {number:g}, which is {problem}")
    return row


def _problems(field: Field, number: float) -> Iterator[str]:
    if field.kind is Kind.F32 and not isfinite(number):
        yield "not finite"
    if field.low is not None and number < field.low:
        yield f"below {field.low:g}"
    if field.high is not None and number > field.high:
        yield f"above {field.high:g}"
    if field.values is not None and number not in set(field.values):
        yield "not one of its values; a newer version?"


@asynccontextmanager
async def answered_in_time(what: str) -> AsyncIterator[None]:
    """Give up what is done in this context after `ANSWER_S`.

    Raises:
        LinkError: It took longer.
    """
    try:
        async with asyncio.timeout(ANSWER_S):
            yield
    except TimeoutError:
        raise LinkError(f"{what} takes longer than {ANSWER_S:g} s: the rig answers too slowly") from None
