"""A rack that says anything its seal allows: the control PLC does not fail, and no output moves further than its rate.

`POISON_EXAMPLES=100000 pytest tests/control_plc/test_poisoned_answers.py` tries more of them.
"""

import asyncio
import os
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.errors import ImplausibleAnswerError
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits
from coldloop.registers.bank import ANYBODY, RefusedAccessError
from coldloop.registers.codec import DomainError, codec_of
from coldloop.registers.common import LeaseStatus
from coldloop.registers.control_plc import LadderStatus, Operator, OperatorMode, PlantLinkState, PlantLinkStatus, Status
from coldloop.registers.declaration import Block, Role
from coldloop.registers.plant import Measurement
from coldloop.safety.writers import SIMPLE_CLIENT
from coldloop.service.journal import Journal
from coldloop_control_plc.plant_link import PlantLink
from coldloop_control_plc.program import make_program
from coldloop_control_plc.rack import ScanCycle
from coldloop_control_plc.runtime import ControlPlc
from coldloop_control_plc.settings import ControlSection, ControlSettings
from coldloop_plant.rack import AppliedOutputs
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP, as_transmitted, sealed
from tests.link.poison import values_of

HEADER: Final = read_header(DEFAULT_MODEL_FILE)
RATE: Final = InputLimits().rate
MANY: Final = int(os.environ.get("POISON_EXAMPLES", "60"))
TICKS: Final = 12
TURNS: Final = 3
"""Ticks after which an operator has changed his mind."""
SETPOINTS: Final = ((47.0, 120.0, 37.0), (20.0, 20.0, 30.0))
BACK_IN_STEP: Final = 40
"""Ticks after the last poison."""
CODEC: Final = codec_of(PLANT_MAP.block_of(Measurement))


class Poison(NamedTuple):
    """What is done to the record in one answer, or in one write."""

    kind: str
    place: int
    value: int

    def of(self, raw: bytes, block: Block, earlier: list[bytes]) -> bytes:
        """Return a record's bytes with something else in them; its seal is that of the new ones."""
        codec = codec_of(block)
        if self.kind == "stale" and earlier:
            return earlier[-1 - self.place % len(earlier)]
        if self.kind == "bit":
            bit = self.place % (8 * (len(raw) - 4 * block.sealed))
            changed = bytearray(raw)
            changed[bit // 8] ^= 1 << bit % 8
            return self._sealed(bytes(changed), block)
        places = list(block.fields.items())[: -1 if block.sealed else None]
        number = self.place % len(places)
        _, field = places[number]
        values = values_of(field)
        record = codec.decode(raw)
        value = values[self.value % len(values)]
        element = self.value % len(field.elements) if field.elements else 0
        new = (*record[number][:element], value, *record[number][element + 1 :]) if field.elements else value
        changed_record = type(record)(*record[:number], new, *record[number + 1 :])
        return codec.encode_sealed(changed_record) if block.sealed else codec.encode(changed_record)

    @staticmethod
    def _sealed(raw: bytes, block: Block) -> bytes:
        codec = codec_of(block)
        return codec.encode_sealed(codec.decode(raw)) if block.sealed else raw


poisons = st.builds(
    Poison, st.sampled_from(("value", "value", "bit", "stale")), st.integers(0, 10_000), st.integers(0, 10_000)
)


class Site:
    """A rack, whose outputs are real, and a control PLC without sockets."""

    def __init__(self) -> None:
        program = self.program = make_program(HEADER, ControlSection(), InputLimits())
        self.link = PlantLink(program.alarms, Journal(), 77)
        self.cycle = ScanCycle(program, self.link, lambda _: False)
        cv155, ncr22, cv156 = as_transmitted(Operator(0, tuple(HEADER.u0))).u
        self.outputs = AppliedOutputs((cv155, ncr22, cv156))  # it does not limit: what is sent is what moves
        self.tick = 0
        self.applied = [self.outputs.u]
        self.told: list[bytes] = []
        self.lie: tuple[float, ...] | None = None
        program.restart(1)
        self.link.begin()

    def scan(self, poison: Poison | None = None) -> None:
        """Do what the control PLC does in one tick of the rack."""
        high = self.tick // TURNS % 2
        self.program.operate(Operator(OperatorMode.MANUAL, tuple(SETPOINTS[high])))
        asked = self.cycle.begin()
        if asked is not None:
            self.outputs.offer(as_transmitted(sealed(asked)), ANYBODY, session=1, tick=self.tick, realtime=True)
        truth = CODEC.encode(sealed(self.measurement()))
        raw = truth if poison is None else poison.of(truth, PLANT_MAP.block_of(Measurement), self.told)
        self.told.append(truth)
        try:
            answer = CODEC.decode_checked(raw)
        except DomainError as error:
            self.cycle.failed(ImplausibleAnswerError(str(error)))
        else:
            assert isinstance(answer, Measurement)
            self.cycle.answered(self.measurement() if self.lies_again(answer) else answer, self.tick + 0.5)
        self.applied.append(self.outputs.u)
        self.tick += 1
        self.outputs.begin_tick()

    def lies_again(self, told: Measurement) -> bool:
        """Tell whether outputs are told again that are not applied: two lies that agree are believed."""
        lie = None if told.u == self.outputs.u else told.u
        again, self.lie = lie is not None and lie == self.lie, lie
        return again

    def measurement(self) -> Measurement:
        y = tuple(value + 1e-3 * (self.tick % 7) for value in HEADER.y0)
        shown = self.outputs
        return Measurement(
            self.tick,
            HEADER.w0,
            y,
            HEADER.x0,
            1,
            shown.u,
            shown.holder,
            shown.generation,
            shown.verdict,
            0,
            0.4,
        )


@settings(max_examples=MANY)
@given(poisoned=st.dictionaries(st.integers(1, TICKS - 1), poisons, min_size=1, max_size=4))
def test_nothing_that_a_rack_says_moves_an_output_beyond_its_rate_or_ends_the_control_plc(
    poisoned: dict[int, Poison],
) -> None:
    site = Site()
    for tick in range(TICKS + BACK_IN_STEP):
        site.scan(poisoned.get(tick))
    for before, after in pairwise(site.applied):
        assert all(abs(new - old) <= rate * 1.0001 for old, new, rate in zip(before, after, RATE, strict=True))
    assert site.link.state is PlantLinkState.SYNCHRONISED
    assert abs(site.program.tick - site.tick) <= 1
    assert site.outputs.holder == site.link.holder != SIMPLE_CLIENT


READ: Final = [(each, block) for each in (PLANT_MAP, CONTROL_MAP, OPTIMIZER_MAP) for block in each.blocks]


@settings(max_examples=MANY)
@given(data=st.data())
def test_whatever_a_server_says_is_a_record_of_its_declaration_or_a_bad_answer(data: st.DataObject) -> None:
    """So it is for all who read: the control PLC, the optimiser, commands, the page, the recorder."""
    _, block = data.draw(st.sampled_from(READ))
    codec = codec_of(block)
    raw = data.draw(st.one_of(st.binary(min_size=codec.size, max_size=codec.size), st.just(bytes(codec.size))))
    for poison in data.draw(st.lists(poisons, max_size=3)):
        raw = poison.of(raw, block, [])
    try:
        record = codec.decode_checked(raw)
    except DomainError:
        return
    for value, field in zip(record, block.fields.values(), strict=True):
        if field.values is not None and any(raw) and field.high == max(field.values):  # others leave room for more
            field.values(value)


def written_blocks() -> Iterator[Block]:
    """Yield what optimisers write to a control PLC."""
    return (block for block in CONTROL_MAP.blocks if block.writer is Role.OPTIMIZER)


@pytest.fixture(scope="module")
def plc() -> Iterator[ControlPlc]:
    made = ControlPlc(ControlSettings())
    yield made
    made.close()


@settings(max_examples=MANY)
@given(data=st.data())
def test_nothing_that_an_optimiser_writes_ends_the_control_plc(plc: ControlPlc, data: st.DataObject) -> None:
    block = data.draw(st.sampled_from(list(written_blocks())))
    raw = plc.bank.read(block.address, block.row_words)
    for poison in data.draw(st.lists(poisons, min_size=1, max_size=3)):
        raw = poison.of(raw, block, [])
    try:
        (written,) = plc.bank.write(block.address, raw)
    except RefusedAccessError:
        return

    async def take() -> None:
        waiting: Any = plc.clients.on_write(written, ANYBODY)
        if waiting is not None:
            waiting.cancel()

    asyncio.run(take())
    for shown in (Status, LadderStatus, PlantLinkStatus, LeaseStatus):
        plc.bank.get(shown)
    plc.publication.safety()
