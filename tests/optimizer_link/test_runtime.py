"""The optimiser PLC against a control PLC that is absent, restarts, is busy, or behind a wire that damages."""

import asyncio
import time
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import ModelFileError
from coldloop.modbus.client import RegisterClient
from coldloop.process.lti_model import LtiModel
from coldloop.registers.bank import Caller
from coldloop.registers.common import EVENT_ROWS, Event, EventKind, Identity
from coldloop.registers.control_plc import AwaitUpdate, Verdict
from coldloop.registers.optimizer_plc import ControlLinkState, Optimization, OptimizerSession
from coldloop_optimizer_plc.runtime import SHORTEST_WAIT_S
from tests.harness.records import OPTIMIZER_MAP

if TYPE_CHECKING:
    from tests.optimizer_link.conftest import Connect, PlayedControlPlc

S = ControlLinkState
ANOTHER = Caller("another optimiser", frozenset(), connection=10_000_000)


def lost(log: pytest.LogCaptureFixture) -> list[str]:
    """Return the reasons for which the control PLC was lost, as they were logged."""
    return [vars(record)["reason"] for record in log.records if record.message == "control PLC lost"]


async def test_it_waits_for_a_control_plc_that_is_not_there_yet(
    connect: "Connect", control: "PlayedControlPlc", caplog: pytest.LogCaptureFixture
) -> None:
    async with connect(control) as link:
        link.wire.is_cut = True
        attempts = link.wire.accepted
        while link.wire.accepted < attempts + 4:
            await link.wire.moves()
        assert link.status.state == S.SEARCHING
        assert not link.running.done()
        assert len(lost(caplog)) == 1
        link.wire.is_cut = False
        control.latch()
        await link.answers(2)
        assert link.status.breaks == 0


async def test_every_update_is_planned_and_answered_by_a_holder_with_a_number(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.latch()
    async with connect(control) as link:
        await link.answers(5)
        shown = link.optimizer.publication.bank
        assert link.status.holder == control.beats[0].holder != 0
        assert control.lease.holder == link.status.holder
        assert [plan.update for plan in control.plans[:5]] == [0, 1, 2, 3, 4]
        assert [header.update for header in control.headers[:5]] == [0, 1, 2, 3, 4]
        assert [shown.get(Optimization, row).verdict for row in range(5)] == [Verdict.ACCEPTED] * 5
        events = [shown.get(Event, row) for row in range(1, EVENT_ROWS) if shown.get(Event, row).number]
        assert [event.kind for event in events] == [EventKind.BOOT, EventKind.CONTROL_LINK, EventKind.SESSION]


async def test_two_starts_have_two_numbers(connect: "Connect", control: "PlayedControlPlc") -> None:
    holders = []
    for _ in range(2):
        async with connect(control) as link:
            holders.append(link.status.holder)
    assert len(set(holders)) == 2


# -- damaged, and lost ---------------------------------------------------------------------------------------------


async def test_a_damaged_update_is_read_again(connect: "Connect", control: "PlayedControlPlc") -> None:
    control.latch()
    async with connect(control) as link:
        link.wire.damaged_answers["update"] = 2
        await link.answers(3)
        assert link.status.damaged == 2
        assert link.status.breaks == 0
        assert [header.update for header in control.headers[:3]] == [0, 1, 2]


@pytest.mark.parametrize("block", ["plan", "heartbeat", "await update", "sequence header"])
async def test_a_request_that_arrives_damaged_is_made_again(
    block: str, connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.latch()
    async with connect(control) as link:
        link.wire.damaged_requests[block] = 2
        await link.answers(3)
        assert not link.wire.damaged_requests
        assert link.status.breaks == 0
        accepted = [header.update for header in control.headers if header.update < 3]
        assert sorted(set(accepted)) == [0, 1, 2]


async def test_a_sequence_whose_acknowledgement_is_damaged_is_known_to_be_accepted(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.latch()
    async with connect(control) as link:
        link.wire.damaged_answers["acknowledgement"] = 2
        await link.answers(3)
        assert link.status.damaged == 2
        assert link.status.breaks == link.status.rejected == 0
        assert [header.number for header in control.headers[:3]] == [1, 2, 3]


async def test_a_sequence_whose_acknowledgement_is_lost_is_not_sent_again(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.latch()
    async with connect(control) as link:
        link.wire.lost_answers["sequence header"] = 1
        await link.answers(3)
        assert link.status.breaks == 1
        assert [header.number for header in control.headers[:3]] == [1, 2, 3]
        assert control.awaited[1] == AwaitUpdate(1, 1, control.awaited[1].crc)  # not a fresh one: nothing was lost


@pytest.mark.parametrize("block", ["sequence header", "plan", "await update"])
async def test_after_a_request_that_was_lost_the_next_sequence_arrives(
    block: str, connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.latch()
    async with connect(control) as link:
        link.wire.lost_requests[block] = 1
        await link.answers(3)
        assert link.status.breaks == 1
        assert [header.update for header in control.headers[:3]] == [0, 1, 2]


async def test_a_sequence_that_arrived_damaged_is_sent_again(connect: "Connect", control: "PlayedControlPlc") -> None:
    control.verdicts = [Verdict.BAD_CRC]
    control.latch()
    async with connect(control) as link:
        await link.answers(3)
        assert [header.number for header in control.headers[:3]] == [1, 1, 2]
        assert link.status.rejected == 0


async def test_a_rejected_sequence_is_counted_and_the_next_update_is_awaited(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.verdicts = [Verdict.RATE_EXCEEDED]
    control.latch()
    async with connect(control) as link:
        await link.answers(1)
        control.latch()
        await link.answers(2)
        assert link.status.rejected == 1
        assert [header.update for header in control.headers[:2]] == [0, 1]


async def test_a_control_plc_that_answers_at_once_without_an_update_is_not_asked_in_a_busy_loop(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.updates = 1  # it says that there is one, and shows none
    async with connect(control) as link:
        began = time.monotonic()
        while len(control.awaited) < 10:
            await link.wire.moves()
        assert time.monotonic() - began >= 8 * SHORTEST_WAIT_S


# -- somebody else ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("realtime")
async def test_it_lets_another_optimiser_be_and_goes_on_when_the_lease_is_free(
    connect: "Connect", control: "PlayedControlPlc", caplog: pytest.LogCaptureFixture
) -> None:
    control.lease.take(ANOTHER)
    control.latch()
    async with connect(control) as link:
        await link.reaches(S.OTHER_MASTER)
        while control.lease.refused < 2:
            await link.wire.moves()
        assert link.status.state == S.OTHER_MASTER
        assert not control.plans
        control.lease.closed(ANOTHER)
        await link.answers(2)
        assert link.status.state in (S.WAITING, S.COMPUTING, S.DELIVERING)
        assert link.status.breaks == 0
    (reason,) = lost(caplog)
    assert "exception 6" in reason


async def test_the_same_optimiser_over_another_connection_keeps_its_lease(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.latch()
    async with connect(control) as link:
        await link.answers(1)
        ours = control.lease._caller  # noqa: SLF001
        assert ours is not None
        former = ours._replace(connection=ANOTHER.connection)
        control.lease.take(former, link.status.holder)  # as if its own connection had been another one, ...
        control.lease.closed(former)
        control.lease.closed(ours)  # ... and this one were new
        await link.answers(3)
        assert link.status.breaks == 0


async def test_a_wrong_model_at_the_start_is_an_error(
    connect: "Connect", control: "PlayedControlPlc", model: LtiModel
) -> None:
    control.runs(model.short_digest ^ 1)
    async with connect(control) as link:
        await asyncio.wait({link.running})
        with pytest.raises(ModelFileError, match="give both PLCs the same"):
            link.running.result()
        assert control.beats[0].model_digest == model.short_digest  # so that its alarm says who is wrong


async def test_one_flipped_bit_in_the_model_that_is_read_ends_nothing(
    connect: "Connect", control: "PlayedControlPlc", model: LtiModel
) -> None:
    control.runs(model.short_digest ^ 1)
    control.latch()
    async with connect(control) as link:
        while not control.beats:
            await link.wire.moves()
        await link.wire.moves()  # the model has been read once
        control.runs(model.short_digest)
        await link.answers(2)
        assert link.status.damaged == 1


@pytest.mark.usefixtures("realtime")
async def test_a_control_plc_that_comes_back_with_another_model_is_waited_for_without_taking_its_lease(
    connect: "Connect", control: "PlayedControlPlc", model: LtiModel
) -> None:
    control.latches_on = False
    control.latch()
    async with connect(control) as link:
        await link.answers(1)
        await link.reaches(S.WAITING)  # a write that the cut interrupts would leave the lease with a dead connection
        control.runs(model.short_digest ^ 1)
        link.wire.cut()
        await link.reaches(S.WRONG_MODEL)
        beats = len(control.beats)
        attempts = link.wire.accepted
        while link.wire.accepted < attempts + 1:
            await link.wire.moves()
        assert len(control.beats) == beats
        control.runs(model.short_digest)
        await link.reaches(S.WAITING)
        assert link.status.breaks == 1


async def test_something_else_that_listens_there_is_named_once_and_waited_out(
    connect: "Connect", something_else: "PlayedControlPlc", caplog: pytest.LogCaptureFixture
) -> None:
    async with connect(something_else) as link:
        attempts = link.wire.accepted
        while link.wire.accepted < attempts + 3:
            await link.wire.moves()
        assert link.status.state == S.SEARCHING
    (reason,) = lost(caplog)
    assert "another register map" in reason


# -- time ----------------------------------------------------------------------------------------------------------


async def test_a_newer_update_ends_a_computation_that_a_load_step_may_end(
    connect: "Connect", control: "PlayedControlPlc"
) -> None:
    control.session = 7
    control.latch()
    async with connect(control, interrupting_load_step_w=10.0) as link:
        link.optimizer.publication.bank.put(OptimizerSession(7, 1, 5.0, 20))
        while not control.plans:
            await link.wire.moves()
        control.latch(4)
        await link.answers(1)
        assert link.status.interrupted == 1
        assert control.headers[0].update == 1


async def test_its_own_server_answers_at_the_highest_factor(connect: "Connect", control: "PlayedControlPlc") -> None:
    control.latch()
    async with connect(control) as link:
        link.optimizer.publication.bank.put(OptimizerSession(1, 1, 10_000.0, 0))
        await link.answers(1)
        reader = RegisterClient(OPTIMIZER_MAP, host="127.0.0.1", port=link.port, timeout_s=60.0)
        for _ in range(20):
            sent = len(control.headers)
            assert (await reader.read(Identity)).session == 1
            await link.answers(sent + 1)
        reader.close()
