"""The state machine of the link to the rack: what leads out of step, and what alone leads back."""

import math

import pytest

from coldloop.errors import DamagedAnswerError, LinkError, PeerUnreachableError, RequestRefusedError
from coldloop.registers.audit import EventKind
from coldloop.registers.control_plc import LinkCause, PlantLinkState
from coldloop.registers.plant import Actuators, Measurement, OutputVerdict
from coldloop.registers.safety import AlarmKind
from coldloop.service.journal import Journal
from control_plc.alarms import AlarmPanel
from control_plc.plant_link import FROZEN_TICKS, PlantLink
from control_plc.scan_cycle import cause_of

HOLDER = 77
U = (43.0, 75.0, 36.0)
S, C = PlantLinkState, LinkCause


def reading(tick: int = 5, **changed: object) -> Measurement:
    shown = Measurement(
        tick, 385.0, (0.0,) * 22, (0.0,) * 28, 1, U, HOLDER, generation=3, verdict=OutputVerdict.TAKEN, age=0.5
    )
    return shown._replace(**changed)  # type: ignore[arg-type]


def read_twice(link: PlantLink, shown: Measurement, now: float | None = None) -> bool:
    return not link.read_back(shown, 1, now) and link.read_back(shown, 1, now)


def outputs(tick: int = 5) -> Actuators:
    return Actuators(tick, *U, 1, HOLDER, 3)


@pytest.fixture
def link() -> PlantLink:
    """A link that is in step."""
    journal = Journal()
    made = PlantLink(AlarmPanel(journal), journal, HOLDER)
    made.begin()
    assert read_twice(made, reading())
    made.joined()
    made.settled()
    assert made.in_step
    return made


@pytest.mark.parametrize(
    ("answer", "state", "cause"),
    [
        (reading(verdict=OutputVerdict.UNTIMELY), S.NOT_TAKEN, C.UNTIMELY),
        (reading(verdict=OutputVerdict.NONE), S.NOT_TAKEN, C.REFUSED),
        (reading(verdict=OutputVerdict.WRONG_SESSION, session=2), S.FOREIGN, C.WRONG_SESSION),
        (reading(verdict=OutputVerdict.CHANGED, generation=4), S.JOINING, C.CHANGED),
        (reading(session=2), S.FOREIGN, C.WRONG_SESSION),
        (reading(u=(43.0, 76.0, 36.0)), S.JOINING, C.CHANGED),
        (reading(u=(43.0, math.nan, 36.0)), S.JOINING, C.CHANGED),
        (reading(holder=78), S.JOINING, C.CHANGED),
        (reading(tick=6), S.JOINING, C.LEAPT),
        (reading(tick=67_111_181), S.JOINING, C.LEAPT),
    ],
)
def test_every_doubt_about_the_answer_to_outputs_leads_out_of_step(
    link: PlantLink, answer: Measurement, state: PlantLinkState, cause: LinkCause
) -> None:
    assert not link.exchanged(outputs(), answer, None)
    assert (link.state, link.cause, link.in_step, link.breaks) == (state, cause, False, 1)


@pytest.mark.parametrize(
    ("error", "state", "cause"),
    [
        (PeerUnreachableError("no answer"), S.SEARCHING, C.NO_ANSWER),
        (DamagedAnswerError("a wrong CRC"), S.JOINING, C.DAMAGED),
        (RequestRefusedError("busy", 6), S.FOREIGN, C.SECOND_MASTER),
        (RequestRefusedError("illegal value", 3), S.NOT_TAKEN, C.REFUSED),
    ],
)
def test_a_request_that_comes_to_nothing_leads_out_of_step(
    link: PlantLink, error: LinkError, state: PlantLinkState, cause: LinkCause
) -> None:
    link.unanswered(cause_of(error))
    assert (link.state, link.cause) == (state, cause)


@pytest.mark.parametrize(
    ("shown", "state", "cause"),
    [
        (reading(session=2), S.FOREIGN, C.WRONG_SESSION),
        (reading(session=0), S.FOREIGN, C.WRONG_SESSION),
        (reading(u=(math.nan, 75.0, 36.0)), S.JOINING, C.IMPLAUSIBLE),
        (reading(u=(43.0, math.inf, 36.0)), S.JOINING, C.IMPLAUSIBLE),
    ],
)
def test_only_a_finite_reading_of_this_session_leads_back(
    link: PlantLink, shown: Measurement, state: PlantLinkState, cause: LinkCause
) -> None:
    link.unanswered(LinkCause.NO_ANSWER)
    assert not link.read_back(shown, 1, None)
    assert (link.state, link.cause) == (state, cause)
    assert link.read_back(reading(), 1, None)


def test_outputs_that_one_reading_shows_and_nobody_has_written_are_not_gone_on_from(link: PlantLink) -> None:
    """A single lie, the first answer after a break: from 0 % the valve would be opened by what a tick allows."""
    link.unanswered(LinkCause.NO_ANSWER)
    for lie in (reading(u=(0.0, 75.0, 36.0)), reading(u=(50.0, 75.0, 36.0), generation=4), reading(generation=9)):
        assert not link.read_back(lie, 1, None)
        assert not link.in_step
    assert link.read_back(reading(), 1, None), "as we had left it"


def test_outputs_whose_answer_was_lost_are_ours_and_go_on_at_once(link: PlantLink) -> None:
    sent = link.addressed(outputs()._replace(cv155=43.5))
    assert (sent.holder, sent.generation) == (HOLDER, 3)
    link.unanswered(LinkCause.NO_ANSWER)
    assert link.read_back(reading(u=sent[1:4]), 1, None)


def test_outputs_before_the_last_that_were_taken_are_no_longer_ours(link: PlantLink) -> None:
    for cv155 in (43.5, 44.0):
        link.addressed(outputs()._replace(cv155=cv155))
    link.unanswered(LinkCause.NO_ANSWER)
    assert not link.read_back(reading(), 1, None)


def test_session_0_is_none_and_cannot_be_joined(link: PlantLink) -> None:
    link.unanswered(LinkCause.NO_ANSWER)
    assert not link.read_back(reading(session=0), 0, None)


def test_in_real_time_the_rack_may_be_a_tick_away_and_no_more(link: PlantLink) -> None:
    assert link.exchanged(outputs(5), reading(tick=6), 6.0)
    assert link.exchanged(outputs(8), reading(tick=7), 8.0)
    assert not link.exchanged(outputs(11), reading(tick=9), 11.0)
    assert link.cause is LinkCause.LEAPT


def test_a_rack_whose_clock_stands_is_found_frozen_and_rejoined_when_it_moves(link: PlantLink) -> None:
    assert link.exchanged(outputs(5), reading(tick=6), 0.0)
    link.overslept()
    assert link.read_back(reading(tick=6), 1, FROZEN_TICKS - 0.5)
    assert not link.read_back(reading(tick=6), 1, FROZEN_TICKS)
    assert link.state is S.FROZEN
    assert link.read_back(reading(tick=7), 1, FROZEN_TICKS + 9.0)


def test_at_tick_0_the_rack_waits_for_outputs_and_is_not_frozen(link: PlantLink) -> None:
    for now in range(3 * FROZEN_TICKS):
        assert link.read_back(reading(tick=0), 1, float(now))


def test_alarms_tell_what_is_wrong_and_return_when_a_scan_is_taken() -> None:
    journal = Journal()
    alarms = AlarmPanel(journal)
    link = PlantLink(alarms, journal, HOLDER)
    link.begin()
    assert not alarms.rows[AlarmKind.PLANT_LOST].active, "reading back at the beginning is no fault"
    link.unanswered(LinkCause.NO_ANSWER)
    assert alarms.rows[AlarmKind.PLANT_LOST].active
    link.unanswered(LinkCause.SECOND_MASTER)
    assert alarms.rows[AlarmKind.PLANT_FOREIGN].active
    assert not alarms.rows[AlarmKind.PLANT_LOST].active, "it answers"
    assert read_twice(link, reading())
    link.joined()
    assert link.exchanged(outputs(), reading(), None)
    link.settled()
    assert not any(row.active for row in alarms.rows)
    states = [event.subject for event in journal.since(0) if event.kind == EventKind.PLANT_LINK]
    assert states == [S.JOINING, S.SEARCHING, S.FOREIGN, S.IN_STEP]


def test_a_rack_that_is_powered_up_with_us_is_searched_for_before_it_counts_as_lost(link: PlantLink) -> None:
    alarms = link._alarms  # noqa: SLF001
    link.starting()
    assert (link.state, link.cause) == (S.SEARCHING, LinkCause.STARTED)
    assert not alarms.rows[AlarmKind.PLANT_LOST].active
    link.unanswered(LinkCause.NO_ANSWER)
    row = alarms.rows[AlarmKind.PLANT_LOST]
    assert (row.active, row.cause) == (1, LinkCause.NO_ANSWER)


def test_outputs_that_somebody_else_has_moved_during_a_break_raise_the_alarm(link: PlantLink) -> None:
    """A control PLC that stood still until the rack was at its safe state: nothing else tells."""
    alarms = link._alarms  # noqa: SLF001
    link.overslept()
    assert not alarms.rows[AlarmKind.PLANT_LOST].active
    assert read_twice(link, reading(u=(30.0, 50.0, 40.0), generation=4, holder=0))
    row = alarms.rows[AlarmKind.PLANT_LOST]
    assert (row.active, row.cause) == (1, LinkCause.CHANGED)


def test_a_second_master_that_the_rack_has_refused_is_alarmed(link: PlantLink) -> None:
    assert link.exchanged(outputs(), reading(refused=1), None)
    row = link._alarms.rows[AlarmKind.SECOND_WRITER]  # noqa: SLF001
    assert (row.times, row.cause) == (1, 2)
