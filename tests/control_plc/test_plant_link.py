"""The state machine of the link to the rack: what leads out of step, and what alone leads back."""

import math

import pytest

from coldloop.errors import DamagedAnswerError, LinkError, PeerUnreachableError, RequestRefusedError
from coldloop.registers.common import AlarmKind, EventKind
from coldloop.registers.control_plc import LinkCause, PlantLinkState
from coldloop.registers.plant import Actuators, Measurement, OutputVerdict
from coldloop.service.journal import Journal
from coldloop_control_plc.alarms import AlarmPanel
from coldloop_control_plc.plant_link import FROZEN_TICKS, PlantLink
from coldloop_control_plc.rack import cause_of

HOLDER = 77
U = (43.0, 75.0, 36.0)
S, C = PlantLinkState, LinkCause


def reading(tick: int = 5, **changed: object) -> Measurement:
    shown = Measurement(
        tick, 385.0, (0.0,) * 22, (0.0,) * 28, 1, U, HOLDER, generation=3, verdict=OutputVerdict.ACCEPTED, age=0.5
    )
    return shown._replace(**changed)  # type: ignore[arg-type]


def read_back(link: PlantLink, shown: Measurement, now: float | None = None, session: int = 1) -> bool:
    link.compare(shown, session, now)
    return link.read_back(shown, session, now)


def read_twice(link: PlantLink, shown: Measurement, now: float | None = None) -> bool:
    return not read_back(link, shown, now) and read_back(link, shown, now)


def outputs(tick: int = 5) -> Actuators:
    return Actuators(tick, tuple(U), 1, HOLDER, 3)


@pytest.fixture
def link() -> PlantLink:
    """A link that is in step."""
    journal = Journal()
    made = PlantLink(AlarmPanel(journal), journal, HOLDER)
    made.begin()
    assert read_twice(made, reading())
    made.joined()
    made.settled()
    assert made.synchronised
    return made


@pytest.mark.parametrize(
    ("answer", "state", "cause"),
    [
        (reading(verdict=OutputVerdict.STALE), S.REJECTED, C.STALE),
        (reading(verdict=OutputVerdict.NONE), S.REJECTED, C.REFUSED),
        (reading(verdict=OutputVerdict.WRONG_SESSION, session=2), S.OTHER_MASTER, C.WRONG_SESSION),
        (reading(verdict=OutputVerdict.CHANGED, generation=4), S.JOINING, C.CHANGED),
        (reading(session=2), S.OTHER_MASTER, C.WRONG_SESSION),
        (reading(u=(43.0, 76.0, 36.0)), S.JOINING, C.CHANGED),
        (reading(u=(43.0, math.nan, 36.0)), S.JOINING, C.CHANGED),
        (reading(holder=78), S.JOINING, C.CHANGED),
        (reading(tick=6), S.JOINING, C.TIME_JUMP),
        (reading(tick=67_111_181), S.JOINING, C.TIME_JUMP),
    ],
)
def test_every_doubt_about_the_answer_to_outputs_leads_out_of_step(
    link: PlantLink, answer: Measurement, state: PlantLinkState, cause: LinkCause
) -> None:
    assert not link.exchanged(outputs(), answer, None)
    assert (link.state, link.cause, link.synchronised, link.breaks) == (state, cause, False, 1)


@pytest.mark.parametrize(
    ("error", "state", "cause"),
    [
        (PeerUnreachableError("no answer"), S.SEARCHING, C.NO_ANSWER),
        (DamagedAnswerError("a wrong CRC"), S.JOINING, C.DAMAGED),
        (RequestRefusedError("busy", 6), S.OTHER_MASTER, C.SECOND_MASTER),
        (RequestRefusedError("illegal value", 3), S.REJECTED, C.REFUSED),
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
        (reading(session=2), S.OTHER_MASTER, C.WRONG_SESSION),
        (reading(session=0), S.OTHER_MASTER, C.WRONG_SESSION),
        (reading(u=(math.nan, 75.0, 36.0)), S.JOINING, C.IMPLAUSIBLE),
        (reading(u=(43.0, math.inf, 36.0)), S.JOINING, C.IMPLAUSIBLE),
    ],
)
def test_only_finite_readings_of_this_session_lead_back(
    link: PlantLink, shown: Measurement, state: PlantLinkState, cause: LinkCause
) -> None:
    link.unanswered(LinkCause.NO_ANSWER)
    for _ in range(3):
        assert not read_back(link, shown)
    assert (link.state, link.cause) == (state, cause)
    assert read_twice(link, reading())


@pytest.mark.parametrize(
    "lie",
    [
        {"u": (0.0, 75.0, 36.0)},  # from 0 % the valve would be opened by what a tick allows
        {"u": (42.5, 75.0, 36.0)},  # what it was a scan ago: the way back would be twice as long
        {"u": (43.5, 75.0, 36.0)},  # what was sent last and did not arrive
        {"generation": 9}, {"session": 2}, {"session": 0}, {"tick": 4}, {"tick": 6}, {"tick": 10**6},
    ],
    ids=str,
)  # fmt: skip
def test_what_one_reading_says_is_not_gone_on_from(link: PlantLink, lie: dict[str, object]) -> None:
    """In lock-step, where no time passes: the lie comes first, or between two that are true, and nobody is alarmed."""
    link.addressed(outputs()._replace(u=(43.5, *U[1:])))
    link.missed_scans()
    for shown in (reading(**lie), reading(), reading(**lie), reading()):
        assert not read_back(link, shown)
    assert link.state is S.JOINING
    assert read_back(link, reading()), "as we had left it"


@pytest.mark.parametrize("leap", [-1e6, -20.0, 20.0, 1e6])
def test_time_that_leaps_in_one_reading_is_not_gone_on_from(link: PlantLink, leap: float) -> None:
    link.missed_scans()
    at = 1e6 + 100.0
    assert not read_back(link, reading(tick=2_000_000), at)
    assert not read_back(link, reading(tick=2_000_000 + int(leap)), at + 0.01)
    assert not read_back(link, reading(tick=2_000_000, age=0.52), at + 0.02)
    assert read_back(link, reading(tick=2_000_003), at + 3.0)


def test_a_reading_before_the_break_confirms_none_after_it(link: PlantLink) -> None:
    link.missed_scans()
    assert read_twice(link, reading())
    link.joined()
    link.missed_scans()
    assert not read_back(link, reading())


def test_a_gateway_that_is_behind_is_not_gone_on_from_but_a_rack_that_went_back_is(link: PlantLink) -> None:
    assert link.exchanged(outputs(100), reading(tick=100), 200.0)
    link.missed_scans()
    for late in range(4):
        assert not read_back(link, reading(tick=97 + late), 201.0 + late), "of before the break"
    assert read_back(link, reading(tick=101), 205.0)
    link.missed_scans()
    assert [read_back(link, reading(tick=50 + later), 206.0 + later) for later in range(6)] == [False] * 5 + [True]


def test_session_0_is_none_and_cannot_be_joined(link: PlantLink) -> None:
    link.unanswered(LinkCause.NO_ANSWER)
    for _ in range(3):
        assert not read_back(link, reading(session=0), session=0)


def test_in_real_time_the_rack_may_be_a_tick_away_and_no_more(link: PlantLink) -> None:
    assert link.exchanged(outputs(5), reading(tick=6), 6.0)
    assert link.exchanged(outputs(8), reading(tick=7), 8.0)
    assert not link.exchanged(outputs(11), reading(tick=9), 11.0)
    assert link.cause is LinkCause.TIME_JUMP


def test_a_rack_whose_clock_stands_is_found_frozen_and_rejoined_when_it_moves(link: PlantLink) -> None:
    assert link.exchanged(outputs(5), reading(tick=6), 0.0)
    link.missed_scans()
    for now in (1.0, FROZEN_TICKS - 0.5, FROZEN_TICKS):
        assert not read_back(link, reading(tick=6), now), "what is repeated says nothing new"
    assert link.state is S.FROZEN
    assert read_back(link, reading(tick=7), FROZEN_TICKS + 9.0)


def test_at_tick_0_the_rack_waits_for_outputs_and_is_not_frozen(link: PlantLink) -> None:
    for now in range(3 * FROZEN_TICKS):
        assert read_twice(link, reading(tick=0), float(now))


def test_alarms_tell_what_is_wrong_and_return_when_a_scan_is_taken() -> None:
    journal = Journal()
    alarms = AlarmPanel(journal)
    link = PlantLink(alarms, journal, HOLDER)
    link.begin()
    assert not alarms.rows[AlarmKind.PLANT_LOST].active, "reading back at the beginning is no fault"
    link.unanswered(LinkCause.NO_ANSWER)
    assert alarms.rows[AlarmKind.PLANT_LOST].active
    link.unanswered(LinkCause.SECOND_MASTER)
    assert alarms.rows[AlarmKind.PLANT_OTHER_MASTER].active
    assert not alarms.rows[AlarmKind.PLANT_LOST].active, "it answers"
    assert read_twice(link, reading())
    link.joined()
    assert link.exchanged(outputs(), reading(), None)
    link.settled()
    assert not any(row.active for row in alarms.rows)
    states = [event.subject for event in journal.since(0) if event.kind == EventKind.PLANT_LINK]
    assert states == [S.JOINING, S.SEARCHING, S.OTHER_MASTER, S.SYNCHRONISED]


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
    link.missed_scans()
    assert not alarms.rows[AlarmKind.PLANT_LOST].active
    assert read_twice(link, reading(u=(30.0, 50.0, 40.0), generation=4, holder=0))
    row = alarms.rows[AlarmKind.PLANT_LOST]
    assert (row.active, row.cause) == (1, LinkCause.CHANGED)


def test_a_second_master_that_the_rack_has_refused_is_alarmed(link: PlantLink) -> None:
    row = link._alarms.rows  # noqa: SLF001
    for refused, times in ((1, 0), (0, 0), (1, 0), (2, 1), (2, 1)):  # one answer may lie
        assert link.exchanged(outputs(), reading(refused=refused), None)
        assert row[AlarmKind.SECOND_WRITER].times == times
    assert row[AlarmKind.SECOND_WRITER].cause == 2
