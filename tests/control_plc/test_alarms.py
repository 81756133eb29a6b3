"""ISA-18.2: what becomes of an alarm when it is raised, acknowledged, returned, shelved, taken out of service."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from coldloop.process.cold_box import TICK_S
from coldloop.registers.codec import from_words
from coldloop.registers.common import (
    ALL_ALARMS,
    AlarmAction,
    AlarmCommand,
    AlarmKind,
    AlarmPriority,
    AlarmState,
    EventKind,
)
from coldloop.service.journal import Journal
from coldloop_control_plc.alarms import DEFAULT_RULES, TRANSITIONS, AlarmPanel, AlarmSettings

KIND = AlarmKind.FIRST_BAND
NAME = "l1_band"


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
        (["unshelve"], AlarmState.NORMAL),
        (["in_service"], AlarmState.NORMAL),
        (["raise", "out_of_service"], AlarmState.OUT_OF_SERVICE),
        (["out_of_service", "raise"], AlarmState.OUT_OF_SERVICE),
        (["out_of_service", "raise", "in_service"], AlarmState.UNACKNOWLEDGED),
        (["raise", "acknowledge", "out_of_service", "in_service"], AlarmState.UNACKNOWLEDGED),
        (["raise", "out_of_service", "return", "in_service"], AlarmState.NORMAL),
        (["shelve", "out_of_service"], AlarmState.OUT_OF_SERVICE),
        (["out_of_service", "shelve"], AlarmState.OUT_OF_SERVICE),
        (["out_of_service", "acknowledge"], AlarmState.OUT_OF_SERVICE),
        (["out_of_service", "unshelve"], AlarmState.OUT_OF_SERVICE),
        (["shelve", "in_service"], AlarmState.SHELVED),
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


def test_causes_that_take_turns_raise_an_alarm_once_each_while_it_is_active(panel: AlarmPanel) -> None:
    for cause in (1, 2, 1, 2, 1):
        panel.raised(KIND, cause)
    assert (panel.rows[KIND].times, panel.rows[KIND].cause) == (2, 1)
    do(panel, "acknowledge")
    panel.raised(KIND, 1)
    assert panel.rows[KIND].state == AlarmState.ACKNOWLEDGED, "no news"
    for cause in (2, 1, 2):
        panel.raised(KIND, cause)
    assert (panel.rows[KIND].times, panel.rows[KIND].state) == (3, AlarmState.UNACKNOWLEDGED), (
        "news to who acknowledged"
    )
    panel.returned(KIND)
    panel.raised(KIND, 1)
    assert panel.rows[KIND].times == 4


def test_a_cause_that_an_alarm_had_before_a_restart_is_no_news_after_it(panel: AlarmPanel) -> None:
    panel.raised(KIND, 1)
    again = AlarmPanel(Journal())
    again.restore(panel.rows)
    again.raised(KIND, 2)
    again.raised(KIND, 1)
    assert again.rows[KIND].times == 2


def test_all_alarms_are_acknowledged_at_once_and_unknown_ones_are_nobodys(panel: AlarmPanel) -> None:
    for kind in AlarmKind:
        panel.raised(kind)
    panel.command(AlarmCommand(99, AlarmAction.ACKNOWLEDGE))
    panel.command(AlarmCommand(KIND, 0))
    assert {row.state for row in panel.rows} == {AlarmState.UNACKNOWLEDGED}
    panel.command(AlarmCommand(ALL_ALARMS, AlarmAction.ACKNOWLEDGE))
    assert {row.state for row in panel.rows} == {AlarmState.ACKNOWLEDGED}


ACTIONS = ("raise", "return", "acknowledge", "shelve", "unshelve", "out_of_service", "in_service")


@given(st.lists(st.sampled_from(ACTIONS), max_size=30))
def test_no_alarm_is_forgotten_before_it_is_acknowledged_unless_it_was_suppressed(actions: list[str]) -> None:
    panel = AlarmPanel(Journal())
    suppressed = (AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE)
    owed = False
    for action in actions:
        before = panel.rows[KIND]
        state = do(panel, action)
        after = panel.rows[KIND]
        if state in suppressed or action == "acknowledge":
            owed = False
        elif before.state in suppressed:
            owed = bool(after.active)
        elif action == "raise" and not before.active:
            owed = True
        if owed:
            assert state in (AlarmState.UNACKNOWLEDGED, AlarmState.RETURNED)
        assert after.active == (action == "raise" or (before.active and action != "return"))
        assert bool(after.shelved_until) is (state is AlarmState.SHELVED)


@given(st.lists(st.sampled_from(ACTIONS), max_size=30))
def test_what_changes_nothing_is_no_event_and_each_event_is_a_transition(actions: list[str]) -> None:
    journal = Journal()
    panel = AlarmPanel(journal)
    for panel.now, action in enumerate(actions):
        before, count, changes = panel.rows[KIND], journal.count, panel.changes
        do(panel, action)
        events = journal.since(count)
        assert (panel.changes != changes) is (panel.rows[KIND] != before)
        state = AlarmState(before.state)
        for event in events:
            state = TRANSITIONS[state][EventKind(event.kind)]
        assert state == panel.rows[KIND].state


# -- shelving, out of service ------------------------------------------------------------------------------------------


def notes(journal: Journal, start: int = 0) -> list[tuple[EventKind, int]]:
    return [(EventKind(event.kind), event.tick) for event in journal.since(start)]


def shelve(panel: AlarmPanel, seconds: int) -> int:
    panel.command(AlarmCommand(KIND, AlarmAction.SHELVE, seconds))
    return panel.rows[KIND].shelved_until


def test_the_journal_says_who_commanded_and_for_how_long() -> None:
    journal = Journal()
    panel = AlarmPanel(journal)
    panel.command(AlarmCommand(KIND, AlarmAction.SHELVE, 90), "10.0.0.5:4711 operator")
    panel.command(AlarmCommand(KIND, AlarmAction.OUT_OF_SERVICE), "10.0.0.6:4712 operator")
    panel.raised(KIND)
    shelved, removed = journal.since(0)
    assert (shelved.kind, shelved.value, from_words(shelved.who)) == (
        EventKind.ALARM_SHELVED, 90.0, "10.0.0.5:4711 operator",
    )  # fmt: skip
    assert (removed.kind, from_words(removed.who)) == (EventKind.ALARM_OUT_OF_SERVICE, "10.0.0.6:4712 operator")


def test_shelving_ends_by_itself_and_an_alarm_that_is_active_then_is_raised_anew() -> None:
    journal = Journal()
    panel = AlarmPanel(journal)
    panel.now = 100
    panel.raised(KIND)
    assert shelve(panel, 10) == 140
    panel.now = 139
    panel.pass_by()
    assert panel.rows[KIND].state == AlarmState.SHELVED
    panel.now = 145  # scans were missed
    panel.pass_by()
    assert panel.rows[KIND][:5] == (AlarmState.UNACKNOWLEDGED, 1, 0, 2, 145)
    assert notes(journal, 2) == [(EventKind.ALARM_UNSHELVED, 145), (EventKind.ALARM_RAISED, 145)]
    assert from_words(journal.since(2)[0].who) == ""


def test_the_time_of_shelving_has_a_default_and_a_maximum_and_can_be_set_again() -> None:
    journal = Journal()
    panel = AlarmPanel(journal, AlarmSettings(shelving_s=60, longest_shelving_s=600))
    assert shelve(panel, 0) == 240
    assert shelve(panel, 60_000) == 2400
    assert shelve(panel, 601) == 2400
    assert shelve(panel, 1) == 4
    assert [event.value for event in journal.since(0)] == [60.0, 600.0, 1.0]


def test_what_is_out_of_service_is_followed_and_not_noted() -> None:
    journal = Journal()
    panel = AlarmPanel(journal)
    do(panel, "out_of_service")
    panel.raised(KIND, 3)
    assert panel.rows[KIND][:4] == (AlarmState.OUT_OF_SERVICE, 1, 3, 0)
    panel.now = 7
    panel.returned(KIND)
    assert (panel.rows[KIND].active, panel.rows[KIND].returned) == (0, 7)
    panel.raised(KIND, 4)
    do(panel, "in_service")
    assert [EventKind(event.kind) for event in journal.since(0)] == [
        EventKind.ALARM_OUT_OF_SERVICE, EventKind.ALARM_IN_SERVICE, EventKind.ALARM_RAISED,
    ]  # fmt: skip
    assert panel.rows[KIND][:5] == (AlarmState.UNACKNOWLEDGED, 1, 4, 1, 7)


# -- delays ------------------------------------------------------------------------------------------------------------

DELAYED = AlarmSettings.model_validate({"rules": {NAME: {"on_delay_s": 5, "off_delay_s": 2}}})


def course(settings: AlarmSettings, conditions: Sequence[tuple[int, bool]]) -> list[tuple[EventKind, int]]:
    """Scan at the ticks given, with the condition of each."""
    journal = Journal()
    panel = AlarmPanel(journal, settings)
    for panel.now, condition in conditions:
        panel.report(KIND, condition=condition)
        panel.pass_by()
    return notes(journal)


def test_an_alarm_is_raised_and_returns_when_its_delays_have_elapsed_however_many_scans_there_were() -> None:
    times = [(EventKind.ALARM_RAISED, 23), (EventKind.ALARM_RETURNED, 48)]
    assert course(DELAYED, [(tick, 3 <= tick < 40) for tick in range(60)]) == times
    assert course(DELAYED, [(0, False), (3, True), (23, True), (40, False), (48, False)]) == times
    assert course(DELAYED, [(3, True), (30, True), (40, False), (90, False)]) == [
        (EventKind.ALARM_RAISED, 30), (EventKind.ALARM_RETURNED, 90),
    ]  # fmt: skip


def test_a_condition_that_does_not_last_as_long_as_its_delay_changes_nothing() -> None:
    flutter = [(tick, tick % 20 != 19) for tick in range(200)]
    assert course(DELAYED, flutter) == []
    raised = [(EventKind.ALARM_RAISED, 20)]
    assert course(DELAYED, [(0, True), (20, True), *[(tick, tick % 8 == 0) for tick in range(21, 200)]]) == raised


def test_the_alarms_of_the_process_have_delays_and_others_none() -> None:
    settings = AlarmSettings()
    assert {kind for kind in AlarmKind if settings.rule(kind).on_delay_s} == {
        AlarmKind.CAPACITY,
        AlarmKind.FIRST_BAND,
        AlarmKind.SECOND_BAND,
    }
    assert course(settings, [(tick, True) for tick in range(40)]) == [(EventKind.ALARM_RAISED, 20)]


def test_a_condition_told_once_is_raised_when_its_delay_is_over() -> None:
    journal = Journal()
    panel = AlarmPanel(journal, DELAYED)
    panel.raised(KIND, 1)
    panel.raised(KIND, 2)
    for panel.now in range(30):
        panel.pass_by()
    assert [(event.tick, event.cause) for event in journal.since(0)] == [(20, 2)]


@given(
    st.lists(st.tuples(st.integers(-200, 40), st.booleans(), st.sampled_from(["", "shelve", "unshelve"])), max_size=60)
)
def test_timers_neither_run_backwards_nor_beyond_the_plant_time_that_has_passed(
    steps: list[tuple[int, bool, str]],
) -> None:
    journal = Journal()
    panel = AlarmPanel(journal, DELAYED)
    passed, since, shelved_at, tick = 0, 0, 0, 0
    asked = False
    for step, condition, action in steps:
        before = panel.rows[KIND]
        tick = max(0, tick + step)
        passed += max(0, tick - panel.now)
        panel.now = tick
        if condition is not asked:
            asked, since = condition, passed
        panel.report(KIND, condition=condition)
        panel.pass_by()
        row = panel.rows[KIND]
        due = passed - since >= (20 if condition else 8)
        assert row.active == (condition if due else before.active)
        if before.state == AlarmState.SHELVED:
            assert (row.state == AlarmState.SHELVED) is (passed - shelved_at < 100)
        if action:
            panel.command(AlarmCommand(KIND, AlarmAction[action.upper()], 25))
            shelved_at = passed
        if panel.rows[KIND].state == AlarmState.SHELVED:
            assert 0 < panel.rows[KIND].shelved_until - tick <= 100


# -- instants, restarts, settings --------------------------------------------------------------------------------------


def test_what_happens_again_and_again_is_one_alarm_until_a_minute_after_the_last_time() -> None:
    journal = Journal()
    panel = AlarmPanel(journal)
    for panel.now in range(1000):
        if panel.now < 500:
            panel.pulse(AlarmKind.SCAN_OVERRUN)
        panel.pass_by()
    assert notes(journal) == [(EventKind.ALARM_RAISED, 0), (EventKind.ALARM_RETURNED, 499 + round(60 / TICK_S))]


def test_what_happened_at_an_instant_passes_by_also_over_a_restart_and_a_new_session(panel: AlarmPanel) -> None:
    panel.now = 1000
    panel.pulse(AlarmKind.ACCESS_REFUSED)
    again = AlarmPanel(Journal())
    again.now = 1010
    again.restore(panel.rows)
    for board, start in ((again, 1010), (panel, 0)):
        board.now = start
        board.pass_by()
        assert board.rows[AlarmKind.ACCESS_REFUSED].active
        board.now = start + 241
        board.pass_by()
        assert not board.rows[AlarmKind.ACCESS_REFUSED].active


def test_a_restart_keeps_states_and_shelving_and_takes_the_priorities_of_the_configuration() -> None:
    panel = AlarmPanel(Journal())
    panel.now = 1000
    panel.raised(KIND, 2)
    until = shelve(panel, 60)
    again = AlarmPanel(Journal(), AlarmSettings.model_validate({"rules": {NAME: {"priority": "critical"}}}))
    again.restore(panel.rows)
    again.now = 1010
    assert again.rows[KIND] == panel.rows[KIND]._replace(priority=AlarmPriority.CRITICAL)
    again.now = until
    again.pass_by()
    assert again.rows[KIND].state == AlarmState.UNACKNOWLEDGED


def test_each_alarm_has_a_rule_and_the_configuration_changes_what_it_names() -> None:
    assert set(DEFAULT_RULES) == set(AlarmKind)
    settings = AlarmSettings.model_validate(
        {"rules": {"sensor_bad": {"priority": "low"}, "T5_BAND": {"on_delay_s": 1}}}
    )
    assert settings.rule(AlarmKind.SENSOR_BAD) == (AlarmPriority.LOW, 0.0, 0.0)
    assert settings.rule(AlarmKind.SECOND_BAND) == (AlarmPriority.HIGH, 1.0, 0.0)
    assert settings.rule(KIND) == (AlarmPriority.HIGH, 5.0, 0.0)
    assert AlarmPanel(Journal(), settings).rows[AlarmKind.SENSOR_BAD].priority == AlarmPriority.LOW


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rules": {"sensor_worse": {}}}, "unknown alarm 'sensor_worse'; choose from mode, l1_band"),
        ({"rules": {"mode": {"priority": "urgent"}}}, "'low', 'medium', 'high' or 'critical'"),
        ({"rules": {"mode": {"on_delay_s": -1}}}, "greater than or equal to 0"),
        ({"rules": {"mode": {"on_delay_s": "nan"}}}, "finite number"),
        ({"rules": {"scan_overrun": {"on_delay_s": 1}}}, "scan_overrun happens at an instant"),
        ({"shelving_s": 100, "longest_shelving_s": 50}, "shelving_s is above longest_shelving_s"),
    ],
)
def test_settings_that_make_no_sense_are_rejected(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        AlarmSettings.model_validate(settings)
