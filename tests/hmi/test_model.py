"""What the page knows, thinned and explained without a rig."""

import asyncio
import json
import shutil
import subprocess
from collections.abc import Iterator
from typing import cast

import pytest

from coldloop.errors import LinkError
from coldloop.modbus.client import RegisterClient
from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES, TICK_S
from coldloop.registers.common import (
    Alarm,
    AlarmKind,
    AlarmPriority,
    AlarmState,
    Event,
    EventKind,
    Identity,
    JournalPage,
    SessionPace,
)
from coldloop.registers.control_plc import LadderStatus, Mode, Plan, ProcessNow
from coldloop.registers.optimizer_plc import Optimization
from coldloop.service.monitoring import exposition
from coldloop_hmi.documents import (
    MOST_MARKS,
    alarms_document,
    catalog,
    encoded,
    page_families,
    signals_of,
    state_document,
    trend_document,
)
from coldloop_hmi.guard import WAITING, Broadcast
from coldloop_hmi.page_server import safe_cell
from coldloop_hmi.process_image import MOST_ROWS, STALE_S, JournalEntry, Model, TrendStore, thin
from coldloop_hmi.runtime import Poller
from coldloop_hmi.users import Party
from coldloop_rig.process_file.making import made_from
from tests.harness.process_files import COLUMN
from tests.harness.records import MAPS
from tests.hmi.conftest import Clock


@pytest.fixture
def clock() -> Clock:
    return Clock(100.0)


@pytest.fixture
def model(clock: Clock) -> Model:
    one = Model(COLD_BOX, clock, 3600)
    for service in one.maps:
        one.put(service, Identity(session=1, tick=1))
        one.heard(service)
    one.put("plant", SessionPace(1, 1, 1.0, 0))
    one.put("control_plc", process(1))
    return one


def process(tick: int, level: float = 60.0) -> ProcessNow:
    return ProcessNow(tick, 400.0, (43.0, 75.0, 36.0), (level, *(0.0,) * 21))


def test_signals_have_the_texts_of_their_enumerations() -> None:
    words = {signal.name: signal.words for register_map in MAPS.values() for signal in signals_of(register_map)}
    assert words["control_plc.operator.mode"] == {0: "auto", 1: "classical loops", 2: "manual"}
    assert words["plant.lease.state"][2] == "lingering"
    assert words["plant.pace.realtime"] == {0: "lock-step", 1: "real time"}
    assert words["plant.load status.last_tick"] == words["plant.watchdog.trips"] == {}


def test_every_register_of_a_block_with_one_row_is_a_signal() -> None:
    for register_map in MAPS.values():
        names = {signal.name for signal in signals_of(register_map)}
        assert len(names) == len(signals_of(register_map))
        for block in register_map.blocks:
            if block.rows == 1:
                assert any(name.startswith(f"{register_map.service}.{block.name}.") for name in names)


def test_processes_side_by_side_have_signals_and_times_of_their_own() -> None:
    for process in (COLD_BOX, made_from(COLUMN).process, COLD_BOX):
        model = Model(process, Clock(), 3600)
        u, y = (0.0,) * len(process.inputs), tuple(map(float, range(len(process.outputs))))
        model.put("control_plc", ProcessNow(8, 1.0, u, y))
        told, state = catalog(model, training=False, replay=True), state_document(model)
        assert (told["outputs"], told["process"]["name"]) == (list(process.output_names), process.name)
        assert state["time_s"] == 8 * process.tick_s
        trend = trend_document(model, told["outputs"], 0, 8, 100)
        assert trend["time"] == [8 * process.tick_s]
        for name, value in zip(process.output_names, y, strict=True):
            assert state["values"][f"control_plc.process.y.{name}"] == value
            assert trend["series"][name] == [value]


def test_a_service_that_is_silent_is_not_live_and_its_values_are_stale(model: Model, clock: Clock) -> None:
    assert model.stale_prefixes() == []
    clock.time += STALE_S + 0.1
    model.heard("plant")
    model.heard("optimizer_plc")
    assert model.stale_prefixes()[0] == "control_plc."
    assert not state_document(model)["services"]["control_plc"]["live"]


@pytest.mark.parametrize(
    ("pace", "stands"),
    [
        (SessionPace(1, 1, 1.0, 0), True),
        (SessionPace(1, 1, 1.0, 1), False),
        (SessionPace(1, 0, 1.0, 0), False),
        (SessionPace(1, 1, 0.01, 0), False),
    ],
    ids=["running", "paused", "lock-step", "slow"],
)
def test_a_tick_that_stands_still_is_stale_only_where_it_should_move(
    model: Model, clock: Clock, pace: SessionPace, *, stands: bool
) -> None:
    model.put("plant", pace)
    model.put("control_plc", process(5))
    clock.time += STALE_S + 1.0
    for service in model.maps:
        model.heard(service)
    assert ("control_plc.process." in model.stale_prefixes()) is stands


def test_another_session_begins_with_empty_trends(model: Model) -> None:
    for tick in range(10, 60):
        model.put("control_plc", process(tick))
    assert len(model.trends) == 51
    model.put("control_plc", Identity(session=2, tick=0))
    assert len(model.trends) == 0


def test_a_control_plc_that_was_started_again_and_looks_for_its_session_empties_nothing(model: Model) -> None:
    for tick in range(10, 60):
        model.put("control_plc", process(tick))
    model.put("control_plc", Identity(session=0, tick=0))
    model.put("control_plc", Identity(session=1, tick=60))
    assert len(model.trends) == 51


def test_marks_are_of_the_session_that_is_shown(model: Model) -> None:
    def entry(utc: str, service: str, kind: EventKind) -> JournalEntry:
        return JournalEntry.of(service, Event(tick=400, kind=kind), COLD_BOX)._replace(utc=utc)

    raised = EventKind.ALARM_RAISED
    model.put_events([entry("10:00", "control_plc", raised), entry("10:05", "plant", EventKind.SESSION)])
    assert trend_document(model, ["L1"], 0, 900, 20)["marks"] == []
    model.put_events([entry("10:06", "control_plc", raised)])
    assert len(trend_document(model, ["L1"], 0, 900, 20)["marks"]) == 1


def test_time_that_goes_on_after_a_pause_is_neither_old_nor_a_gap(model: Model, clock: Clock) -> None:
    pace = SessionPace(session=1, realtime=1, factor=10.0, paused=0)
    model.put("plant", pace)
    model.put("control_plc", process(5))
    model.put("plant", pace._replace(paused=1))
    for _ in range(40):
        clock.time += 1.0
        for service in model.maps:
            model.heard(service)
    model.put("plant", pace)
    assert "control_plc.process." not in model.stale_prefixes()
    model.put("control_plc", process(12))
    assert model.trends.gaps(0, 100) == []


def test_a_service_that_did_not_answer_once_leaves_a_gap_however_short(model: Model) -> None:
    model.put("control_plc", process(5))
    model.silent("control_plc", "no answer")
    model.heard("control_plc")
    model.put("control_plc", process(305))
    assert model.trends.gaps(0, 400) == [(5, 305)]


def test_a_service_that_counts_its_events_anew_loses_none(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    class Service:
        """Answers with its journal; its requests are numbered by the start that it is in."""

        boot, newest = 1, 5

        async def connect(self, _patience_s: float) -> None:
            pass

        async def read(self, record: type[tuple[object, ...]]) -> tuple[object, ...]:
            return JournalPage(1, self.newest) if record is JournalPage else record()

        async def read_rows(self, _record: type[Event], start: int, count: int) -> list[Event]:
            return [
                Event(each, self.boot, kind=EventKind.BOOT) if each <= self.newest else Event()
                for each in range(start, start + count)
            ]

        def close(self) -> None:
            pass

    service = Service()
    poller = Poller("plant", cast("RegisterClient", service), model, 0.0)
    monkeypatch.setattr(poller, "_slow", [])

    async def look(*, again: bool = False) -> list[tuple[int, int]]:
        if again:
            poller._lose(LinkError("its connection has closed"))  # noqa: SLF001 `run` waits in between
        await poller._look()  # noqa: SLF001
        return [(entry.boot, entry.number) for entry in model.events]

    first = [(1, number) for number in range(1, 6)]
    assert asyncio.run(look()) == first
    assert asyncio.run(look(again=True)) == first, "the same start: nothing is reported twice"
    service.boot, service.newest = 2, 7
    assert asyncio.run(look(again=True)) == first + [(2, number) for number in range(1, 8)]


def test_thinning_keeps_every_excursion_and_says_nothing_that_was_not_there() -> None:
    values = [0.0] * 10_000
    values[4321], values[7777] = 9.0, -5.0
    times, columns = thin([float(i) for i in range(10_000)], {"a": values}, 200, TICK_S)
    assert len(times) == len(columns["a"]) <= 210
    assert (max(columns["a"]), min(columns["a"])) == (9.0, -5.0)
    assert set(columns["a"]) == {0.0, 9.0, -5.0}
    assert times == sorted(times)
    assert thin([1.0, 2.0], {"a": [3.0, 4.0]}, 200, TICK_S) == ([1.0, 2.0], {"a": [3.0, 4.0]})


def test_the_store_forgets_what_is_too_old_and_never_grows_beyond_its_end() -> None:
    store = TrendStore(COLD_BOX, kept_s=300)
    for tick in range(0, 400_000, 4):
        store.add(process(tick), 1)
    assert len(store) <= 300 + 4096 + 1
    assert store.ticks[-1] - store.ticks[0] >= 1200
    long = TrendStore(COLD_BOX, kept_s=1e9)
    for tick in range(MOST_ROWS + 10_000):
        long.add(process(tick), 1)
    assert len(long) <= MOST_ROWS + 4096


def test_modes_are_told_stretch_by_stretch() -> None:
    store = TrendStore(COLD_BOX, 3600)
    for tick, mode in enumerate([1, 1, 1, 3, 3, 1]):
        store.add(process(tick), mode)
    assert [(one.start, one.end, one.value) for one in store.modes(0, 10)] == [
        (0, 0.75, 1),
        (0.75, 1.25, 3),
        (1.25, 1.25, 1),
    ]


def test_where_nothing_was_read_there_is_no_line_however_much_is_thinned(model: Model, clock: Clock) -> None:
    for tick in range(2, 400):
        model.put("control_plc", process(tick))
        model.heard("control_plc")
    clock.time += 35.0
    model.put("control_plc", LadderStatus(1, 0, 0, 1, 1 << OUTPUT_NAMES.index("L1"), 0))
    for tick in range(540, 900):
        model.put("control_plc", process(tick, 61.0))
        model.heard("control_plc")
    for points in (20, 4000):
        trend = trend_document(model, ["L1"], 0, 900, points)
        assert trend["gaps"] == [[399 * 0.25, 540 * 0.25]]
        level = dict(zip(trend["time"], trend["series"]["L1"], strict=True))
        assert [time for time, value in level.items() if value is None] == [400 * 0.25]
        assert {value for time, value in level.items() if time < 100} == {60.0}
        assert {value for time, value in level.items() if time > 100} == {61.0}
    assert [(one["from"], one["to"]) for one in trend["modes"]] == [(0.25, 399 * 0.25), (540 * 0.25, 899 * 0.25)]
    assert trend["doubtful"]["L1"] == [(540 * 0.25, 900 * 0.25, "held")]


def test_the_updating_period_is_not_current_while_mpc_does_not_drive(model: Model) -> None:
    for mode in Mode:
        model.put("control_plc", LadderStatus(mode, 0, 0, 1, 0, 0))
        assert ("update" in model.stale_prefixes()) is (mode != Mode.MPC)
        assert model.is_planned is (mode == Mode.MPC)


def test_doubtful_values_are_listed_by_stretch_with_the_worst_quality(model: Model) -> None:
    t5, l1 = (1 << OUTPUT_NAMES.index(name) for name in ("T5", "L1"))
    for tick, bad, suspect, faulty in ((2, 0, 0, 0), (3, t5, 0, 0), (4, t5, l1, 0), (5, 0, l1, l1), (6, l1 | t5, 0, 0)):
        model.put("control_plc", LadderStatus(1, 0, 0, 1, bad, 0))
        model.put("control_plc", Plan(1, 9, suspects=suspect))
        model.faulty_sensors = faulty
        model.put("control_plc", process(tick))
    document = json.loads(encoded(trend_document(model, ["L1", "T5", "load"], 0, 10, 100)))
    brief = trend_document(model, ["L1", "T5", "load"], 0, 10, 100, is_brief=True)
    assert (brief["predictions"], set(brief["updates"])) == ([], {"time", "tau_u"})
    assert document["doubtful"] == {
        "T5": [[0.75, 1.25, "held"], [1.5, 1.75, "held"]],
        "L1": [[1.0, 1.25, "suspect"], [1.25, 1.5, "simulated"], [1.5, 1.75, "held"]],
    }
    assert model.trends.doubtful(0, 2) == {}


def test_each_value_has_the_worst_of_its_qualities(model: Model, clock: Clock) -> None:
    def quality(name: str) -> str | None:
        return dict(state_document(model)["quality"]).get(name)

    assert quality("control_plc.process.y.T1") is None
    assert quality("control_plc.update.x.") == "simulated", "no sensor has a state"
    t1, l1 = (1 << OUTPUT_NAMES.index(name) for name in ("T1", "L1"))
    model.put("control_plc", Plan(1, 9, suspects=t1 | l1))
    model.put("control_plc", LadderStatus(1, 0, 0, 1, l1, 0))
    assert [quality(f"control_plc.process.y.{name}") for name in ("T1", "L1")] == ["suspect", "held"]
    assert quality("plant.measurement.y.L1") == "bad", "its reading itself"
    model.faulty_sensors = l1
    assert quality("control_plc.process.y.L1") == "simulated"
    assert state_document(model)["stale"] == ["control_plc.process.y.L1"], "what is not current is crossed out"
    model.put("control_plc", LadderStatus(Mode.MANUAL, 0, 0, 1, 0, 0))
    assert quality("control_plc.process.y.T1") is None, "no optimiser doubts it in manual"
    clock.time += STALE_S + 0.1
    assert quality("control_plc.") == "stale"


def test_updates_are_drawn_only_while_they_are_in_force(model: Model) -> None:
    manual = range(40, 80)
    for tick in range(2, 120):
        model.put("control_plc", LadderStatus(Mode.MANUAL if tick in manual else Mode.MPC, 0, 0, 1, 0, 0))
        model.put("control_plc", process(tick))
    updates = [Optimization(i, tick, 8, 3, 3, 0, *(float(tick),) * 11) for i, tick in enumerate(range(8, 119, 8))]
    model.put_updates(updates)
    for end in (60, 119):
        found = trend_document(model, ["L1"], 20, end, 400)["updates"]
        shown = {time: values for time, *values in zip(*(found[name] for name in ("time", "tau_u", "J")), strict=True)}
        assert found["time"] == sorted(found["time"])
        drawn = {round(time / 0.25) for time, (tau_u, _) in shown.items() if tau_u is not None}
        assert drawn == {8, 16, 24, 32, 40} | ({80, 88, 96, 104, 112, 119} if end == 119 else set())
        assert shown[40 * 0.25] == [2.0, None], "the period reaches to its end, its cost is of an instant"
        assert shown[41 * 0.25] == [None, None]


@pytest.mark.parametrize("count", [MOST_MARKS, MOST_MARKS + 7])
def test_marks_are_all_of_the_window_or_since_when_is_said(model: Model, count: int) -> None:
    model.put("control_plc", process(2 * MOST_MARKS))
    event = JournalEntry.of("control_plc", Event(kind=EventKind.ALARM_RAISED), COLD_BOX)
    model.put_events(event._replace(tick=tick) for tick in range(count))
    document = trend_document(model, ["L1"], 0, 2 * MOST_MARKS, 20)
    assert len(document["marks"]) == MOST_MARKS
    assert document["marks_since_s"] == (None if count == MOST_MARKS else document["marks"][0]["time"])


def test_active_alarms_come_first_and_returned_ones_hide_none(model: Model) -> None:
    rows = [Alarm(priority=AlarmPriority.LOW) for _ in AlarmKind]
    rows[AlarmKind.MODE] = Alarm(AlarmState.ACKNOWLEDGED, 1, priority=AlarmPriority.CRITICAL)
    rows[AlarmKind.SECOND_BAND] = Alarm(AlarmState.RETURNED, 0, priority=AlarmPriority.HIGH)
    rows[AlarmKind.SCAN_OVERRUN] = Alarm(AlarmState.UNACKNOWLEDGED, 1, priority=AlarmPriority.LOW)
    model.put_alarms(rows)
    assert [one["name"] for one in alarms_document(model)][:3] == ["scan overrun", "mode", "t5 band"]


def test_a_message_has_only_what_changed_and_numbers_that_json_has(model: Model) -> None:
    model.put("control_plc", process(2, level=float("nan")))
    model.changed.clear()
    model.put("control_plc", process(3, level=float("nan")))
    document = state_document(model, model.changed)
    assert not document["whole"]
    assert document["values"]["control_plc.process.tick"] == 3
    assert "control_plc.process.load" not in document["values"]
    whole = json.loads(encoded(state_document(model)))
    assert whole["values"]["control_plc.process.y.L1"] is None


def test_what_is_sent_is_json_even_when_numbers_or_words_are_none(model: Model) -> None:
    model.put("control_plc", process(2, level=float("nan")))
    model.put("plant", SessionPace(1, 1, 0.0, 0))
    model.put_updates([Optimization(1, 2, 4, 3, 3, 0, *(float("inf"),) * 11)])
    model.put_alarms([Alarm(state=99, priority=77) for _ in AlarmKind])
    trend = json.loads(encoded(trend_document(model, ["L1"], 0, 10, 100)), parse_constant=pytest.fail)
    assert trend["series"]["L1"] == [60.0, None]
    state = json.loads(encoded(state_document(model)), parse_constant=pytest.fail)
    assert state["alarms"][0]["state"] == "99"


def test_loads_and_alarms_are_marked_on_the_trends(model: Model) -> None:
    model.put("control_plc", process(100))
    kinds = (EventKind.LIVE_LOAD, EventKind.BOOT, EventKind.ALARM_RAISED)
    model.put_events(JournalEntry.of("plant", Event(i, 1, 50 + i, kind=kind), COLD_BOX) for i, kind in enumerate(kinds))
    marks = trend_document(model, ["L1"], 0, 100, 100)["marks"]
    assert [(mark["kind"], mark["time"]) for mark in marks] == [("load", 12.5), ("alarm", 13.0)]


async def test_a_browser_that_is_too_slow_is_begun_anew_and_others_do_not_wait() -> None:
    whole: Iterator[int] = iter(range(100))
    broadcast = Broadcast(lambda: b"whole %d" % next(whole), most=2)
    streams = [broadcast.begin(Party(address, has_session=False)) for address in ("10.0.0.1", "10.0.0.2")]
    slow, quick = (broadcast.messages(stream) for stream in streams if stream is not None)
    assert await anext(slow) == b"whole 0"
    assert await anext(quick) == b"whole 1"
    assert broadcast.begin(Party("10.0.0.3", has_session=False)) is None, "as many as there may be"
    for number in range(WAITING + 2):
        broadcast.send(b"change %d" % number)
        assert await asyncio.wait_for(anext(quick), 60) == b"change %d" % number
    assert (await anext(slow)).startswith(b"whole"), "what waited is void: it gets the whole state"
    await quick.aclose()
    assert len(broadcast) == 1


def test_a_stream_gives_way_to_who_has_logged_in_and_to_who_has_fewer() -> None:
    broadcast = Broadcast(lambda: b"", most=4)
    greedy, other, anna, lena = (
        Party(name, has_session=name in {"anna", "lena"}) for name in ("10.0.0.1", "10.0.0.2", "anna", "lena")
    )
    assert all(broadcast.begin(greedy) for _ in range(4))
    assert broadcast.begin(greedy) is None, "the same address has them all already"
    streams = [broadcast.begin(party) for party in (other, anna, lena, anna)]
    assert all(streams), "each of them takes the place of one of the address that has most"
    assert [broadcast.begin(party) for party in (greedy, other)] == [None, None]
    assert broadcast.begin(anna) is not None, "the last stranger's"
    assert broadcast.begin(anna) is None, "she has three, and nobody has more"
    assert broadcast.begin(lena) is not None
    assert len(broadcast) == 4


def test_cells_of_a_table_are_no_formulas() -> None:
    assert [safe_cell(text) for text in ("=1+1", "@x", "-5.5", "plain", 3)] == ["'=1+1", "'@x", "-5.5", "plain", 3]


def test_metrics_of_a_silent_service_say_only_that_it_is_silent(model: Model, clock: Clock) -> None:
    model.put("control_plc", LadderStatus(1, 2, 0, 1, 0, 0))
    model.put_alarms([Alarm() for _ in AlarmKind])
    text = exposition(page_families(model, 2)).decode()
    assert 'coldloop_up{service="control_plc"} 1.0' in text
    assert "coldloop_control_plc_ladder_mode 1.0" in text
    assert 'coldloop_alarm_state{alarm="t5 band"} 0.0' in text
    if shutil.which("promtool"):
        done = subprocess.run(["promtool", "check", "metrics"], input=text, text=True, capture_output=True, check=False)
        assert (done.returncode, done.stdout + done.stderr) == (0, "")
    clock.time += 60
    text = exposition(page_families(model, 2)).decode()
    assert 'coldloop_up{service="control_plc"} 0.0' in text
    assert "coldloop_control_plc_ladder_mode" not in text


def test_metrics_have_the_qualities_of_the_page(model: Model, clock: Clock) -> None:
    def told(*signals: str) -> list[int]:
        text = exposition(page_families(model, 0)).decode()
        return [int(float(text.partition(f'coldloop_quality{{signal="{one}"}} ')[2].split()[0])) for one in signals]

    first, second = (f"y.{name}" for name in OUTPUT_NAMES[:2])
    signals = [f"control_plc.process.{first}", f"control_plc.process.{second}", f"plant.measurement.{first}"]
    assert told(*signals) == [0, 0, 0]
    model.put("control_plc", LadderStatus(Mode.MPC, 0, 0, 1, 1, 0))
    assert told(*signals) == [2, 0, 3], "held; its raw reading is bad"
    model.put_updates([Optimization(*(1,) * len(Optimization._fields))])
    assert told("update") == [0]
    model.put("control_plc", LadderStatus(Mode.MANUAL, 0, 0, 1, 1, 0))
    clock.time += 10
    for service in model.maps:
        model.heard(service)
    assert told(*signals, "update") == [4, 4, 4, 4], "the tick does not move; no update is in force"
