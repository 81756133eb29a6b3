"""Any bytes at all, to the handler and to a connection: each request is answered, nothing stored that may not be."""

import asyncio
import struct
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.modbus.connection import RefusalLog
from coldloop.modbus.requests import DeviceIdentity, RequestHandler, Written
from coldloop.registers.bank import Caller, RefusedAccessError, RegisterBank
from coldloop.registers.declaration import Role
from tests.harness.records import MAPS

if TYPE_CHECKING:
    from tests.modbus.conftest import Plug

IDENTITY = DeviceIdentity(product="rig", revision="0.1")
BANKS = {service: RegisterBank(register_map) for service, register_map in MAPS.items()}

addresses = st.sampled_from(
    sorted({address for each in MAPS.values() for block in each.blocks for address in (block.address, block.end - 1)})
)
words = (addresses | st.sampled_from([0, 1, 2, 6, 18, 121, 123, 125, 126]) | st.integers(0, 0xFFFF)).map(
    lambda word: struct.pack(">H", word)
)


def write(address: int, count: int, data: bytes) -> bytes:
    return struct.pack(">HHB", address, count, 2 * count) + (data + bytes(2 * count))[: 2 * count]


writes = st.builds(write, addresses, st.integers(1, 60), st.binary(max_size=40))
pdus = st.one_of(
    st.binary(min_size=1, max_size=253),
    st.builds(lambda head, body: bytes((head,)) + b"".join(body), st.integers(0, 255), st.lists(words, max_size=6)),
    writes.map(lambda body: b"\x10" + body),
    st.builds(lambda read, count, body: b"\x17" + read + count + body, words, words, writes),
)
role_sets = st.frozensets(st.sampled_from(Role))


def memory(bank: RegisterBank) -> list[bytes]:
    """Return the words of each block, without making the statistics anew."""
    return [bytes(bank._memory[2 * block.address : 2 * block.end]) for block in bank.map.blocks]  # noqa: SLF001


def assert_stored_by_writers_only(bank: RegisterBank, before: list[bytes], roles: frozenset[Role]) -> None:
    for block, old, new in zip(bank.map.blocks, before, memory(bank), strict=True):
        assert new == old or block.writer in roles


def carried_out(handler: RequestHandler, pdu: bytes) -> bytes | Written | int:
    """Return what the handler returns, or the exception code of a refusal."""
    try:
        return handler.handle(pdu)
    except RefusedAccessError as refusal:
        return refusal.exception_code


@pytest.mark.parametrize("service", MAPS)
@settings(max_examples=3 * settings.default.max_examples)
@given(pdu=pdus, roles=role_sets)
def test_a_request_is_carried_out_or_refused_and_only_writers_store(
    service: str, pdu: bytes, roles: frozenset[Role]
) -> None:
    bank = BANKS[service]
    before = memory(bank)
    outcome = carried_out(RequestHandler(bank, IDENTITY, Caller("client", roles)), pdu)
    if isinstance(outcome, Written):
        assert_stored_by_writers_only(bank, before, roles)
        outcome = outcome.answer()
    else:
        assert memory(bank) == before
    if isinstance(outcome, int):
        assert outcome in (1, 2, 3)
    else:
        assert outcome[0] == pdu[0]
        assert len(outcome) <= 253


@pytest.mark.parametrize("service", MAPS)
@given(segments=st.lists(st.binary(max_size=300), max_size=8), reader=st.booleans())
def test_any_bytes_are_taken_and_every_answer_is_whole(
    plug: "Plug",
    service: str,
    segments: list[bytes],
    reader: bool,  # noqa: FBT001 - drawn by Hypothesis
) -> None:
    async def story() -> None:
        bank, refusals = BANKS[service], RefusalLog(service)
        before = memory(bank)
        nobody: dict[str, list[str]] = {role: [] for role in Role}
        connection, transport = plug(bank, refusals, access=nobody if reader else {})
        for segment in segments:
            connection.data_received(segment)
        await asyncio.sleep(0)
        connection.connection_lost(None)
        assert refusals.counts["server_failure"] == 0
        while transport.written:
            length = struct.unpack_from(">H", transport.written, 4)[0]
            assert len(transport.written) >= 6 + length
            transport.written = transport.written[6 + length :]
        roles: frozenset[Role] = frozenset() if reader else frozenset(Role)
        assert_stored_by_writers_only(bank, before, roles)

    asyncio.run(story())


@given(pipeline=st.lists(pdus, min_size=1, max_size=30), cuts=st.lists(st.integers(0, 3000), max_size=8))
def test_a_pipeline_cut_anywhere_is_answered_in_order_each_with_its_function(
    plug: "Plug", pipeline: list[bytes], cuts: list[int]
) -> None:
    async def story() -> None:
        refusals = RefusalLog("plant")
        connection, transport = plug(BANKS["plant"], refusals)
        stream = b"".join(
            struct.pack(">HHHB", number, 0, len(pdu) + 1, 1) + pdu[:253] for number, pdu in enumerate(pipeline)
        )
        edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
        for start, end in pairwise(edges):
            connection.data_received(stream[start:end])
        while not connection.idle:  # noqa: ASYNC110 - many are answered over several turns of the event loop
            await asyncio.sleep(0)
        connection.connection_lost(None)
        assert not transport.closed
        for number, pdu in enumerate(pipeline):
            transaction, _, length, _, function = struct.unpack_from(">HHHBB", transport.written)
            assert (transaction, function & 0x7F) == (number, pdu[0] & 0x7F)
            transport.written = transport.written[6 + length :]
        assert not transport.written
        assert refusals.counts["server_failure"] == 0

    asyncio.run(story())
