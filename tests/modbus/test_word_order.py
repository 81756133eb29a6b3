"""Low word first, the habit of Schneider's PLCs, at byte level."""

from typing import TYPE_CHECKING

import pytest

from coldloop.registers.codec import WordOrder
from coldloop.registers.plant import Actuators

if TYPE_CHECKING:
    from tests.modbus.conftest import Serve

LOW_FIRST = {
    "the magic float is swapped": ("03 0000 0002", "03 04 e979 42f6"),
    "50.0 is taken low word first": ("10 0066 0002 04 0000 4248", "10 0066 0002"),
    "100.5 is refused low word first": ("10 0066 0002 04 0000 42c9", "90 03"),
    "infinity is refused low word first": ("10 0066 0002 04 0000 7f80", "90 03"),
    "half a float is refused": ("06 0067 4248", "86 03"),
}


@pytest.mark.parametrize(("request_hex", "answer_hex"), LOW_FIRST.values(), ids=LOW_FIRST.keys())
async def test_with_the_low_word_first(serve: "Serve", request_hex: str, answer_hex: str) -> None:
    async with serve(order=WordOrder.LOW_FIRST) as running:
        wire = await running.connect()
        answer = await wire.ask(bytes.fromhex(request_hex))
        assert answer == bytes.fromhex(answer_hex)
        assert running.bank.get(Actuators).u[0] == (50.0 if answer[0] == 0x10 else 0.0)
