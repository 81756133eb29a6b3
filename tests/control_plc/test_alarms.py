"""ISA-18.2: what becomes of an alarm when it is raised, acknowledged, returned, shelved."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.registers.audit import EVENT_ROWS, EventKind
from coldloop.registers.safety import ALL_ALARMS, AlarmAction, AlarmCommand, AlarmKind, AlarmState
from control_plc.alarms import AlarmPanel, Journal

KIND = AlarmKind.LEVEL_BAND


@pytest.fixture
def panel() -> AlarmPanel:
    return AlarmPanel(Journal())


def do(panel: AlarmPanel, *actions: str) -> AlarmState:
    for action in actions:
        if action == "raise":
            panel.raised(KIND)
        elif action == "return":
            panel.returned(KIND)
        else:
            panel.command(AlarmCommand(KIND, AlarmAction[action.upper()]))
    return AlarmState(panel.rows[KIND].state)


@pytest.mark.parametrize(
    ("actions", "state"),
    [
        ([], AlarmState.NORMAL),
        (["raise"], AlarmState.UNACKNOWLEDGED),
        (["raise", "acknowledge"], AlarmState.ACKNOWLEDGED),
        (["raise", "return"], AlarmState.RETURNED),
        (["raise", "return", "acknowledge"], AlarmState.NORMAL),
        (["raise", "acknowledge", "return"], AlarmState.NORMAL),
        (["raise", "return", "raise"], AlarmState.UNACKNOWLEDGED),
        (["raise", "shelve"], AlarmState.SHELVED),
        (["raise", "shelve", "return", "raise"], AlarmState.SHELVED),
        (["raise", "shelve", "unshelve"], AlarmState.UNACKNOWLEDGED),
        (["raise", "shelve", "return", "unshelve"], AlarmState.NORMAL),
        (["shelve", "acknowledge"], AlarmState.SHELVED),
        (["acknowledge"], AlarmState.NORMAL),
    ],
)
def test_the_states_follow_isa_18_2(panel: AlarmPanel, actions: list[str], state: AlarmState) -> None:
    assert do(panel, *actions) is state


def test_an_alarm_that_stands_is_raised_again_only_for_another_cause(panel: AlarmPanel) -> None:
    panel.now = 5
    panel.raised(KIND, 1)
    panel.now = 9
    panel.raised(KIND, 1)
    assert (panel.rows[KIND].times, panel.rows[KIND].raised) == (1, 5)
    do(panel, "acknowledge")
    panel.raised(KIND, 2)
    assert (panel.rows[KIND].times, panel.rows[KIND].raised, panel.rows[KIND].state) == (
        2,
        9,
        AlarmState.UNACKNOWLEDGED,
    )


def test_all_alarms_are_acknowledged_at_once_and_unknown_ones_are_nobodys(panel: AlarmPanel) -> None:
    for kind in AlarmKind:
        panel.raised(kind)
    panel.command(AlarmCommand(99, AlarmAction.ACKNOWLEDGE))
    panel.command(AlarmCommand(KIND, 0))
    assert {row.state for row in panel.rows} == {AlarmState.UNACKNOWLEDGED}
    panel.command(AlarmCommand(ALL_ALARMS, AlarmAction.ACKNOWLEDGE))
    assert {row.state for row in panel.rows} == {AlarmState.ACKNOWLEDGED}


def test_each_change_is_an_event_with_its_tick_and_cause(panel: AlarmPanel) -> None:
    journal = Journal()
    panel = AlarmPanel(journal)
    panel.now = 3
    panel.raised(KIND, 7)
    panel.now = 8
    panel.returned(KIND)
    do(panel, "acknowledge", "shelve", "unshelve")
    assert [(event.number, event.tick, EventKind(event.kind)) for event in journal.since(0)] == [
        (1, 3, EventKind.ALARM_RAISED),
        (2, 8, EventKind.ALARM_RETURNED),
        (3, 8, EventKind.ALARM_ACKNOWLEDGED),
        (4, 8, EventKind.ALARM_SHELVED),
        (5, 8, EventKind.ALARM_UNSHELVED),
    ]
    assert journal.since(0)[0].cause == 7
    assert journal.since(5) == []


def test_the_journal_keeps_the_last_events_in_bounded_memory() -> None:
    journal = Journal()
    for tick in range(1000):
        journal.note(tick, EventKind.MODE, 0)
    kept = journal.since(0)
    assert [event.number for event in kept] == list(range(1001 - EVENT_ROWS, 1001))


@given(st.lists(st.sampled_from(["raise", "return", "acknowledge", "shelve", "unshelve"]), max_size=30))
def test_no_alarm_is_forgotten_before_it_is_acknowledged_unless_it_was_shelved(actions: list[str]) -> None:
    panel = AlarmPanel(Journal())
    owed = False
    for action in actions:
        before = panel.rows[KIND]
        state = do(panel, action)
        if action == "raise" and not before.active and before.state != AlarmState.SHELVED:
            owed = True
        if action in ("acknowledge", "shelve"):
            owed = False
        if owed:
            assert state in (AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED)
        assert panel.rows[KIND].active == (action == "raise" or (before.active and action != "return"))


def test_what_happened_at_an_instant_passes_by_also_over_a_restart_and_a_new_session(panel: AlarmPanel) -> None:
    panel.now = 1000
    panel.happened(AlarmKind.ACCESS_REFUSED)
    again = AlarmPanel(Journal())
    again.begin_at(1010)
    again.restore(panel.rows)
    for board, start in ((again, 1010), (panel, 0)):
        board.begin_at(start)
        board.pass_by()
        assert board.rows[AlarmKind.ACCESS_REFUSED].active
        board.now = start + 241
        board.pass_by()
        assert not board.rows[AlarmKind.ACCESS_REFUSED].active
