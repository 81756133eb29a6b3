"""A control PLC whose updates are whole and make no sense: the optimiser answers the next one that does."""

from typing import TYPE_CHECKING

import pytest

from coldloop.process.declaration import LAST_NUMBER
from coldloop.registers.control_plc import Update
from tests.link.poison import Change, poisons

if TYPE_CHECKING:
    from tests.optimizer_link.conftest import Connect, Link, PlayedControlPlc, Until


async def one_poisoned(link: "Link", until: "Until", change: "Change") -> None:
    """Latch an update that is changed, and, when it was asked for, answered or refused, one that is not."""
    control = link.control
    answered, asked, damaged = len(control.headers), len(control.awaited), link.status.damaged
    control.poison = change  # type: ignore[assignment] # of an update
    control.latch(control.updates * 20)
    await until(lambda: (len(control.headers), len(control.awaited), link.status.damaged) > (answered, asked, damaged))
    answered = len(control.headers)
    control.latch(control.updates * 20)
    await until(lambda: len(control.headers) > answered)
    assert not link.running.done()


async def goes_on(connect: "Connect", control: "PlayedControlPlc", until: "Until", changes: "list[Change]") -> int:
    """Latch updates that are changed, each followed by one that is not; return how many answers counted as damaged."""
    control.latch()
    async with connect(control) as link:
        await link.answers(1)
        control.latches_on = False
        for change in changes:
            await one_poisoned(link, until, change)
        return link.status.damaged


@pytest.mark.parametrize("field", ["session", "update", "tick", "playing"])
async def test_a_number_at_its_end_is_no_end(
    connect: "Connect", control: "PlayedControlPlc", until: "Until", field: str
) -> None:
    def last(update: tuple[int, ...]) -> tuple[int, ...]:
        return update._replace(**{field: 0xFFFF_FFFF})  # type: ignore[attr-defined,no-any-return] # an update

    await goes_on(connect, control, until, [last])


async def test_the_last_sequence_number_is_followed_by_those_of_a_session_begun_anew(
    connect: "Connect", control: "PlayedControlPlc", until: "Until"
) -> None:
    def last(update: tuple[int, ...]) -> tuple[int, ...]:
        return update._replace(playing=LAST_NUMBER)  # type: ignore[attr-defined,no-any-return] # an update

    await goes_on(connect, control, until, [last])
    assert control.headers[-1].number < LAST_NUMBER


@pytest.mark.usefixtures("realtime")
async def test_every_field_of_an_update_may_be_nonsense(
    connect: "Connect", control: "PlayedControlPlc", until: "Until"
) -> None:
    changes = [change for _, change in poisons(Update)]
    damaged = await goes_on(connect, control, until, changes)
    assert damaged > len(changes) // 4
