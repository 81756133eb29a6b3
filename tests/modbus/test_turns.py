"""Who is served when: a few requests of each connection in a turn of the event loop, and its time is bounded."""

import asyncio
import struct
from collections import deque
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.modbus import connection
from coldloop.modbus.connection import REQUESTS_AT_ONCE, TURN_S, RefusalLog, Turns, rate_limit_of
from coldloop.modbus.settings import ServerSettings
from coldloop.registers.bank import RegisterBank
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from tests.modbus.conftest import FakeTransport, Plug, Serve

READ_MAGIC = bytes.fromhex("03 0000 0002")
ANSWER_BYTES = 13
STEP_S = 20e-6
FEW = REQUESTS_AT_ONCE
NOBODY: dict[str, list[str]] = {"control": [], "optimizer": [], "operator": []}


class Clock:
    """Goes on by `STEP_S` whenever it is read, as if everything took some time."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        self.now += STEP_S
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(connection, "monotonic", clock)
    return clock


def pipeline(count: int) -> bytes:
    return b"".join(struct.pack(">HHHB", number, 0, 6, 1) + READ_MAGIC for number in range(count))


def answered(transport: "FakeTransport") -> list[int]:
    """Return the transaction ids of the answers so far."""
    return [struct.unpack_from(">H", transport.written, at)[0] for at in range(0, len(transport.written), ANSWER_BYTES)]


async def turn() -> None:
    await asyncio.sleep(0)


@pytest.mark.usefixtures("clock")
async def test_a_request_that_comes_alone_is_answered_in_the_callback_that_brings_it(plug: "Plug") -> None:
    one, transport = plug(RegisterBank(PLANT_MAP), RefusalLog("plant"))
    for count in range(1, 4):
        one.data_received(pipeline(1))
        assert len(answered(transport)) == count
        assert one.idle
        await turn()


async def test_of_64_kilobytes_of_requests_a_few_are_answered_in_each_turn_and_all_in_order(
    plug: "Plug", clock: Clock
) -> None:
    flood, transport = plug(RegisterBank(PLANT_MAP), RefusalLog("plant"))
    flood.data_received(pipeline(5461))
    assert answered(transport) == list(range(FEW))
    assert not flood.idle
    longest_s = 0.0
    while not flood.idle:
        began = clock.now
        await turn()
        longest_s = max(longest_s, clock.now - began)
    assert answered(transport) == list(range(5461))
    assert longest_s < TURN_S + 3 * STEP_S


async def test_requests_of_two_hundred_clients_in_one_turn_take_its_time_and_no_more(
    plug: "Plug", clock: Clock
) -> None:
    bank, refusals, shared = RegisterBank(PLANT_MAP), RefusalLog("plant"), Turns()
    crowd = [plug(bank, refusals, shared) for _ in range(200)]
    began = clock.now
    for client, _ in crowd:
        client.data_received(pipeline(1))
    at_once = [len(answered(transport)) for _, transport in crowd]
    assert 0 < sum(at_once) < 200
    assert clock.now - began < TURN_S + 201 * STEP_S  # each reads the clock once to find the time used up
    while not all(client.idle for client, _ in crowd):
        began = clock.now
        await turn()
        assert clock.now - began < TURN_S + 3 * STEP_S
    assert [answered(transport) for _, transport in crowd] == [[0]] * 200


async def test_one_who_has_a_role_does_not_wait_behind_those_who_have_none(plug: "Plug", clock: Clock) -> None:
    shared = Turns()
    bank, refusals = RegisterBank(PLANT_MAP), RefusalLog("plant")
    readers = [plug(bank, refusals, shared, access=NOBODY, reader_request_rate=0) for _ in range(50)]
    control, transport = plug(bank, refusals, shared)
    for reader, _ in readers:
        reader.data_received(pipeline(500))
    clock.now += TURN_S
    control.data_received(pipeline(1))
    assert answered(transport) == []  # this turn is over
    await turn()
    assert answered(transport) == [0]


class Worker:
    """A client with so many requests, each of which takes `STEP_S`."""

    def __init__(self, shared: Turns, clock: Clock, requests: int, *, has_role: bool) -> None:
        self.requests, self.has_role = requests, has_role
        self._clock = clock
        if requests:
            shared.until()
            shared.queue(self)

    def serve_some(self, until: float) -> bool:
        for _ in range(min(self.requests, FEW)):
            self.requests -= 1
            if self._clock() >= until:
                break
        return self.requests > 0


async def test_one_without_a_role_is_served_in_each_turn_also_when_others_take_all_the_time(clock: Clock) -> None:
    shared = Turns()
    busy = Worker(shared, clock, 10_000, has_role=True)
    modest = [Worker(shared, clock, FEW, has_role=False) for _ in range(5)]
    for served in range(1, 5 * FEW + 1):
        await turn()
        assert 5 * FEW - sum(each.requests for each in modest) == served
    assert busy.requests > 5000


@given(
    roles=st.lists(st.tuples(st.integers(0, 400), st.booleans()), min_size=1, max_size=12),
    late=st.lists(st.integers(0, 60), max_size=8),
)
def test_whatever_is_asked_is_served_and_no_turn_takes_much_longer_than_its_time(
    roles: list[tuple[int, bool]], late: list[int]
) -> None:
    async def story() -> None:
        clock, shared = Clock(), Turns()
        connection.monotonic = clock  # type: ignore[attr-defined, assignment] # what the module reads the time with
        workers = [Worker(shared, clock, count, has_role=has_role) for count, has_role in roles]
        arriving = deque(late)
        while arriving or any(worker.requests for worker in workers):
            began = clock.now
            await turn()
            assert clock.now - began < TURN_S + (FEW + 4) * STEP_S
            if arriving:
                workers.append(Worker(shared, clock, arriving.popleft(), has_role=False))

    original = connection.monotonic  # type: ignore[attr-defined]
    try:
        asyncio.run(story())
    finally:
        connection.monotonic = original  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("keys", "with_role", "without"),
    [
        ({}, None, 200.0),
        ({"request_rate": 50}, 50.0, 50.0),
        ({"request_rate": 5000}, 5000.0, 200.0),
        ({"reader_request_rate": 0}, None, None),
        ({"reader_request_rate": 0, "request_rate": 7}, 7.0, 7.0),
    ],
)
def test_who_has_no_role_has_a_request_limit_by_default(
    keys: dict[str, float], with_role: float | None, without: float | None
) -> None:
    limits = [rate_limit_of(ServerSettings(port=0, **keys), has_role=has_role) for has_role in (True, False)]
    assert [limit and limit.rate for limit in limits] == [with_role, without]


async def test_a_reader_that_floods_is_read_from_later_and_one_with_a_role_is_not(serve: "Serve") -> None:
    access = {role: ["127.0.0.2"] for role in NOBODY}
    async with serve(access=access, reader_request_rate=0.001, request_burst=10) as running:
        reader, control = await running.connect("127.0.0.3"), await running.connect("127.0.0.2")
        for wire in (reader, control):
            wire.send(pipeline(5000))
        assert [(await control.answer())[0] for _ in range(5000)] == list(range(5000))
        assert [(await reader.answer())[0] for _ in range(10)] == list(range(10))
        assert running.server.statistics().rate_limited == 1
