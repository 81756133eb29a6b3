"""The journal: numbers without gaps, bounded memory, and queries that find every event once."""

from collections.abc import Iterator
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import from_words
from coldloop.registers.common import EVENT_ROWS, QUERY_ROWS, Event, EventKind, JournalAnswer, JournalPage, JournalQuery
from coldloop.service.journal import ANY_SUBJECT, KEPT, LOOKED_AT, Journal, JournalPublication
from tests.harness.records import CONTROL_MAP

ALL = JournalQuery(0, 0, ANY_SUBJECT)
KINDS = st.sampled_from([EventKind.MODE, EventKind.ALARM_RAISED, EventKind.LEASE])
EVENTS = st.lists(st.tuples(KINDS, st.integers(0, 2)), max_size=40)


def filled(events: int, **start: int) -> Journal:
    journal = Journal(now=lambda: 1_700_000_000.25, **start)
    for tick in range(events):
        journal.note(tick, EventKind.MODE, tick)
    return journal


def pages(journal: Journal, query: JournalQuery) -> Iterator[tuple[JournalPage, list[JournalAnswer]]]:
    """Ask until there is nothing more."""
    while True:
        page, found = journal.select(query)
        yield page, found
        if not page.next_first:
            return
        assert page.next_first > query.first  # or the client would never come to an end
        query = query._replace(first=page.next_first)


def numbers(events: list[Event]) -> list[int]:
    return [event.number for event in events]


# -- numbers, time, who ------------------------------------------------------------------------------------------------


@given(retained=st.integers(0, 2**31), early=EVENTS, late=EVENTS)
def test_numbers_have_no_gaps_over_a_restart_also_when_it_is_noticed_late(
    retained: int, early: list[tuple[EventKind, int]], late: list[tuple[EventKind, int]]
) -> None:
    journal = Journal()
    for kind, subject in early:
        journal.note(0, kind, subject)
    journal.continue_from(7, retained)
    for kind, subject in late:
        journal.note(0, kind, subject)
    events = journal.since(retained)
    assert [(event.kind, event.subject) for event in events] == early + late
    assert numbers(events) == list(range(retained + 1, retained + 1 + len(events)))
    assert {event.boot for event in events} <= {7}
    assert journal.count == retained + len(events)


def test_an_event_says_when_in_utc_and_whose_request_it_was() -> None:
    journal = Journal(boot=3, now=lambda: 1_700_000_000.9876)
    journal.note(2400, EventKind.ALARM_SHELVED, 8, 6, value=900.0, who="10.0.0.5:4711 operator")
    (event,) = journal.since(0)
    assert event[:9] == (1, 3, 2400, 1_700_000_000, 987, EventKind.ALARM_SHELVED, 8, 6, 900.0)
    assert from_words(event.who) == "10.0.0.5:4711 operator"


@pytest.mark.parametrize("clock", [-5.0, 0.0, 2.0**33, 1e18])
def test_an_absurd_clock_still_gives_an_event_that_registers_can_hold(clock: float) -> None:
    journal = Journal(boot=70_000, now=lambda: clock)
    journal.note(2**40, EventKind.MODE, 70_000, -1)
    RegisterBank(CONTROL_MAP).put(journal.since(0)[0])


@given(st.text(max_size=100))
def test_a_name_cannot_carry_control_characters_into_a_terminal(who: str) -> None:
    journal = Journal()
    journal.note(0, EventKind.MODE, who=who)
    shown = from_words(journal.since(0)[0].who)
    assert shown == "".join(c if " " <= c <= "~" else "?" for c in who)[:48]
    assert from_words((0x1B5B, 0x0741)) == "?[?A"


# -- memory ------------------------------------------------------------------------------------------------------------


def test_memory_is_bounded_and_the_last_events_are_kept() -> None:
    journal = filled(KEPT + 5)
    assert numbers(journal.since(0)) == list(range(6, KEPT + 6))
    assert (journal.oldest, journal.count) == (6, KEPT + 5)
    assert numbers(journal.since(KEPT + 3)) == [KEPT + 4, KEPT + 5]


@given(events=st.integers(0, 20), retained=st.integers(0, 50), number=st.integers(0, 100))
def test_since_returns_the_events_behind_a_number(events: int, retained: int, number: int) -> None:
    journal = filled(events, count=retained)
    assert numbers(journal.since(number)) == [n for n in range(retained + 1, retained + events + 1) if n > number]


# -- queries -----------------------------------------------------------------------------------------------------------


@given(
    events=EVENTS, retained=st.integers(0, 50), first=st.integers(0, 100), kind=KINDS | st.just(0),
    subject=st.integers(0, 2) | st.just(ANY_SUBJECT),
)  # fmt: skip
def test_a_query_finds_every_matching_event_once_and_in_order(
    events: list[tuple[EventKind, int]], retained: int, first: int, kind: int, subject: int
) -> None:
    journal = Journal(count=retained)
    for each, about in events:
        journal.note(0, each, about)
    found = [event for _, answer in pages(journal, JournalQuery(first, kind, subject)) for event in answer]
    assert [tuple(event) for event in found] == [
        tuple(event)
        for event in journal.since(0)
        if event.number >= first and kind in (0, event.kind) and subject in (ANY_SUBJECT, event.subject)
    ]


def test_an_answer_has_a_bounded_number_of_events_and_looks_at_a_bounded_number() -> None:
    journal = filled(KEPT)
    journal.note(KEPT, EventKind.LEASE)
    answers = list(pages(journal, JournalQuery(0, EventKind.LEASE, ANY_SUBJECT)))
    assert [len(found) for _, found in answers] == [*[0] * (KEPT // LOOKED_AT - 1), 1]
    assert all(page.found == len(found) <= QUERY_ROWS for page, found in pages(filled(50), ALL))


def test_events_that_were_dropped_between_two_pages_are_seen_from_the_oldest_number() -> None:
    journal = filled(KEPT)
    page, _ = journal.select(ALL)
    for _ in range(10):
        journal.note(0, EventKind.LEASE)
    after, found = journal.select(ALL._replace(first=page.next_first))
    assert (page.next_first, after.oldest, found[0].number) == (4, 11, 11)


# -- registers ---------------------------------------------------------------------------------------------------------


def rows_of(bank: RegisterBank) -> dict[int, Event]:
    return {row: event for row in range(EVENT_ROWS) if (event := bank.get(Event, row)).number}


@given(st.lists(st.integers(0, EVENT_ROWS + 50), max_size=4))
def test_the_registers_show_the_last_events_each_in_its_row_and_each_is_returned_once(bursts: list[int]) -> None:
    bank, journal, ticks = RegisterBank(CONTROL_MAP), Journal(), count()
    publication = JournalPublication(journal, bank)
    for burst in bursts:
        for _ in range(burst):
            journal.note(next(ticks), EventKind.MODE)
        assert publication.is_behind is (burst > 0)
        assert len(publication.show()) == burst
        assert not publication.is_behind
    last = journal.last(EVENT_ROWS)
    assert rows_of(bank) == {event.number % EVENT_ROWS: event for event in last}
    assert bank.get(JournalPage) == (journal.oldest, journal.count, 0, 0)


def test_events_that_get_new_numbers_are_moved_in_the_registers_and_not_returned_again() -> None:
    bank, journal = RegisterBank(CONTROL_MAP), filled(0)
    publication = JournalPublication(journal, bank)
    journal.note(1, EventKind.BOOT)
    assert len(publication.show()) == 1
    journal.continue_from(2, 5000)
    assert publication.is_behind
    assert publication.show() == []
    assert rows_of(bank) == {5001 % EVENT_ROWS: journal.since(0)[0]}
    journal.note(2, EventKind.MODE)
    assert numbers(publication.show()) == [5002]


def test_an_answer_stays_readable_while_new_events_are_shown() -> None:
    bank, journal = RegisterBank(CONTROL_MAP), filled(5)
    publication = JournalPublication(journal, bank)
    publication.answer(ALL._replace(first=2))
    journal.note(0, EventKind.MODE)
    publication.show()
    assert bank.get(JournalPage) == (1, 6, 3, 5)
    assert [bank.get(JournalAnswer, row).number for row in range(QUERY_ROWS)] == [2, 3, 4]
    publication.answer(ALL._replace(first=6))
    assert [bank.get(JournalAnswer, row).number for row in range(QUERY_ROWS)] == [6, 0, 0]
