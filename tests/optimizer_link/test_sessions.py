"""What an operator writes to the optimiser: judged whole, and nothing that is accepted can end the program."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.errors import RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.bank import Caller, IllegalValueError, RefusedAccessError
from coldloop.registers.codec import WordOrder, blank, from_words
from coldloop.registers.common import Event, EventKind, JournalAnswer, JournalPage, JournalQuery, SessionPace
from coldloop.registers.declaration import Role
from coldloop.registers.optimizer_plc import OperatingLimits, OptimizerSession
from coldloop_optimizer_plc.computing_settings import BudgetSettings, PlcBudget
from coldloop_optimizer_plc.runtime import OptimizerPublication
from tests.harness.records import OPTIMIZER_MAP

if TYPE_CHECKING:
    from tests.optimizer_link.conftest import Connect, Link, PlayedControlPlc, Until

OPERATOR = Caller("panel", frozenset({Role.OPERATOR}))
BLOCK = OPTIMIZER_MAP.block_of(OptimizerSession)
UPDATING_PERIOD = BLOCK.end - 1


def shown(power: float = 1.0, tau_1_s: float = 0.25) -> OptimizerPublication:
    budget = PlcBudget(BudgetSettings(power=power), tau_1_s)
    return OptimizerPublication(
        OPTIMIZER_MAP, WordOrder.HIGH_FIRST, budget, blank(OperatingLimits, OPTIMIZER_MAP), 1, 1
    )


@asynccontextmanager
async def panel(link: "Link") -> AsyncIterator[RegisterClient]:
    client = RegisterClient(OPTIMIZER_MAP, host="127.0.0.1", port=link.port, timeout_s=60.0)
    try:
        yield client
    finally:
        client.close()


@pytest.mark.parametrize(
    "asked",
    [
        OptimizerSession(1, 0, 1.0, 1), OptimizerSession(1, 0, 1.0, 21), OptimizerSession(1, 0, 1.0, 65535),
        OptimizerSession(0, 0, 1.0, 0), OptimizerSession(1, 2, 1.0, 0), OptimizerSession(1, 1, 0.0, 0),
        OptimizerSession(1, 1, -1.0, 0), OptimizerSession(1, 1, float("nan"), 0), OptimizerSession(1, 1, 1e5, 0),
    ],
)  # fmt: skip
async def test_a_session_that_cannot_be_is_refused_and_the_one_before_stays(
    asked: OptimizerSession, connect: "Connect", control: "PlayedControlPlc"
) -> None:
    async with connect(control) as link, panel(link) as client:
        before = OptimizerSession(3, 1, 2.0, 10)
        await client.write(before)
        with pytest.raises(RequestRefusedError) as refused:
            await client.write(asked)
        assert refused.value.exception_code == 3
        assert await client.read(OptimizerSession) == before


@given(register=st.integers(BLOCK.address, BLOCK.end - 1), word=st.integers(0, 0xFFFF))
def test_a_register_that_is_written_alone_is_judged_with_the_rest(register: int, word: int) -> None:
    """Function 6: half of a 32-bit value is refused, and so is a record that is not valid with it."""
    publication = shown()
    with pytest.raises(RefusedAccessError):
        publication.bank.write(register, word.to_bytes(2, "big"), OPERATOR)  # all the others are 0: no session
    publication.bank.put(OptimizerSession(3, 1, 2.0, 10))
    try:
        publication.bank.write(register, word.to_bytes(2, "big"), OPERATOR)
    except RefusedAccessError:
        assert publication.bank.get(OptimizerSession) == OptimizerSession(3, 1, 2.0, 10)
    else:
        assert publication.bank.get(OptimizerSession)[1] in (0, 1)
        assert publication.bank.get(OptimizerSession).updating_period in (0, *range(2, 21))


@pytest.mark.parametrize(
    ("power", "tau_1_s", "shortest"), [(1.0, 0.25, 2), (0.5, 0.25, 4), (1.0, 0.475, 3), (1.0, 4.75, 20)]
)
def test_in_real_time_a_period_has_to_hold_one_iteration(power: float, tau_1_s: float, shortest: int) -> None:
    publication = shown(power, tau_1_s)

    def accepts(ticks: int, *, realtime: int) -> bool:
        publication.bank.put(OptimizerSession(1, realtime, 1.0, 0))
        try:
            publication.bank.write(UPDATING_PERIOD, ticks.to_bytes(2, "big"), OPERATOR)
        except IllegalValueError:
            return False
        return True

    assert [ticks for ticks in range(25) if accepts(ticks, realtime=1)] == [0, *range(shortest, 21)]
    assert [ticks for ticks in range(25) if accepts(ticks, realtime=0)] == [0, *range(2, 21)]


@settings(max_examples=10, deadline=None)
@given(ticks=st.sampled_from([0, *range(2, 21)]), realtime=st.integers(0, 1), factor=st.floats(100, 10_000, width=32))
def test_a_session_that_is_accepted_runs(
    connect: "Connect", make_control: "Callable[[], PlayedControlPlc]", ticks: int, realtime: int, factor: float
) -> None:
    async def story() -> None:
        control = make_control()
        control.session = 9
        async with connect(control) as link, panel(link) as client:
            await client.write(OptimizerSession(9, realtime, factor, ticks))
            control.latch()
            await link.answers(2)
            assert not link.running.done()
            assert not ticks or {header.tau_u for header in control.headers} == {ticks}

    asyncio.run(story())


async def test_the_journal_knows_who_asked_for_a_session(connect: "Connect", control: "PlayedControlPlc") -> None:
    control.session = 4
    async with connect(control) as link, panel(link) as client:
        await client.write(OptimizerSession(4, 0, 2.0, 0))
        control.latch()
        await link.answers(1)
        await client.write(JournalQuery(0, EventKind.SESSION, 0xFFFF))
        page = await client.read(JournalPage)
        event = await client.read(JournalAnswer)
        assert (page.found, page.newest, page.next_first) == (1, 3, 0)
        assert (event.subject, event.value) == (0, 2.0)
        assert "127.0.0.1:" in from_words(event.who)


async def test_a_session_that_nobody_asked_for_here_runs_as_configured_and_is_nobodys(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.session = 5
    async with connect(control) as link, panel(link) as client:
        await client.write(OptimizerSession(4, 1, 2.0, 14))
        control.latch()
        await link.answers(2)
        rows = await client.read_rows(Event, 1, 3)
        assert [event.kind for event in rows] == [EventKind.BOOT, EventKind.CONTROL_LINK, EventKind.SESSION]
        assert (rows[-1].subject, rows[-1].value, from_words(rows[-1].who)) == (0, 1.0, "")
        assert control.headers[0].tau_u != 14


async def test_a_session_that_begins_anew_under_its_number_is_joined_at_once(
    connect: "Connect", control: "PlayedControlPlc", until: "Until"
) -> None:
    """Its updates count from 0 again: the one that was awaited would be long in coming."""
    control.latch()
    async with connect(control) as link:
        await link.answers(5)
        control.latches_on = False
        await until(lambda: control.awaited[-1].update == control.updates)
        control.plans.clear()
        control.updates, control.latches_on = 0, True
        control.latch()
        await until(lambda: len(control.plans) > 2)
        assert [plan.update for plan in control.plans[:3]] == [0, 1, 2]


@pytest.mark.parametrize(("factor", "period"), [(0.01, 0), (0.01, 8)])
async def test_a_new_session_does_not_wait_for_the_answer_of_a_slow_one(
    connect: "Connect", control: "PlayedControlPlc", until: "Until", factor: float, period: int
) -> None:
    async with connect(control) as link, panel(link) as client:
        await client.write(OptimizerSession(1, 1, factor, period))
        control.latch()
        await until(lambda: control.plans)
        control.plans.clear()
        control.session, control.updates = 2, 0
        control.latch()
        await until(lambda: control.plans)  # the answer of the slow one would take 200 s


@pytest.mark.parametrize("asked", [None, OptimizerSession(7, 1, 300.0, 12)])
async def test_an_optimiser_takes_the_pace_that_the_session_has_by_now(
    connect: "Connect", control: "PlayedControlPlc", asked: OptimizerSession | None
) -> None:
    """It has been changed since the session was asked for: this optimiser was not there, or had to begin anew."""
    control.session = 7
    control.bank.put(SessionPace(7, 1, 1000.0))
    async with connect(control) as link, panel(link) as client:
        if asked is not None:
            await client.write(asked)
        control.latch()
        await link.answers(1)
        assert await client.read(SessionPace) == SessionPace(7, 1, 1000.0)
        assert asked is None or control.headers[0].tau_u == asked.updating_period
