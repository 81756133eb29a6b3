"""What operators are told of their commands: what would be done, what was, what was not, and what nobody knows."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import pytest

from coldloop.errors import LinkError, PeerUnreachableError, RequestRefusedError, UsageError
from coldloop.operating.commands import (
    Command,
    PlayLoad,
    SetFactor,
    SetLoad,
    SetMode,
    SetPaused,
    SetSetpoint,
    TreatAlarm,
    clock_text,
    duration_text,
)
from coldloop.operating.execution import lead_ticks
from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.registers.common import (
    ALL_ALARMS,
    Alarm,
    AlarmAction,
    AlarmCommand,
    AlarmKind,
    AlarmState,
    Identity,
    SessionPace,
)
from coldloop.registers.control_plc import Cause, LadderStatus, Mode, Operator, OperatorMode
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.plant import LoadAhead, LoadStatus
from coldloop.service.journal import Journal
from coldloop_control_plc.alarms import AlarmPanel
from coldloop_hmi.operator_desk import CONFIRM_WITHIN_S, CommandResult, OperatorDesk, PremisesChangedError
from coldloop_hmi.process_image import Model
from tests.harness.records import MAPS
from tests.hmi.conftest import Clock

R = TypeVar("R", bound=tuple[Any, ...])


class Peer:
    """A service by direct calls: what is written counts at once, unless a test says what happens instead."""

    def __init__(self, register_map: RegisterMap, *records: tuple[Any, ...]) -> None:
        self.map, self.process = register_map, register_map.process
        self.records: dict[type, tuple[Any, ...]] = {type(record): record for record in records}
        self.panel = AlarmPanel(Journal())
        self.written: list[tuple[Any, ...]] = []
        self.failures: list[LinkError | None] = []
        """What becomes of the next requests to write."""
        self.is_absent = False
        self.has_written = False

    async def connect(self, _patience_s: float) -> None:
        if self.is_absent:
            raise PeerUnreachableError("nobody listens there")

    async def read(self, record: type[R]) -> R:
        return self.records.get(record) or record()  # type: ignore[return-value]

    async def read_rows(self, _record: type[Alarm], start: int, count: int) -> list[Alarm]:
        return self.panel.rows[start : start + count]

    async def write(self, record: tuple[Any, ...]) -> None:
        failure = self.failures.pop(0) if self.failures else None
        self.has_written |= not isinstance(failure, RequestRefusedError)
        if failure is not None:
            raise failure
        self.written.append(record)
        self.records[type(record)] = record
        if isinstance(record, AlarmCommand):
            self.panel.command(record)

    def close(self) -> None:
        pass


SILENT = PeerUnreachableError("plant did not answer in time")
PAST = RequestRefusedError("plant refused function 16: exception 3, illegal value", 3)


class Desk:
    """A desk, the services that it writes to, and somebody at it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = Clock(100.0)
        self.model = Model(COLD_BOX, self.clock, 300)
        pace = SessionPace(1, 1, 1.0, 0)
        self.model.put("plant", pace)
        self.plant = Peer(MAPS["plant"], Identity(session=1, tick=1000), pace, LoadStatus(watts=400.0, free=4096))
        auto = Operator(OperatorMode.AUTO, (43.0, 75.0, 36.0))
        ladder = LadderStatus(Mode.MPC, Cause.NONE, 0, 1, 0, 0)
        self.control = Peer(MAPS["control_plc"], Identity(session=1, tick=1000), auto, ladder)
        self.optimizer = Peer(MAPS["optimizer_plc"], Identity(session=1))
        self.desk = OperatorDesk({}, self.model, self.clock, training=False)
        peers = {"plant": self.plant, "control_plc": self.control, "optimizer_plc": self.optimizer}
        monkeypatch.setattr(self.desk, "_clients", lambda services: {service: peers[service] for service in services})

    async def asked(self, command: Command) -> str:
        return (await self.desk.prepare(command, "anna")).text

    async def outcome(self, command: Command, missing: Peer | None = None) -> CommandResult:
        """Prepare and confirm a command; in between a service may disappear."""
        token, *_ = await self.desk.prepare(command, "anna")
        if missing is not None:
            missing.is_absent = True
        return await self.desk.confirm(token, "anna")


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    monkeypatch.setattr("coldloop.operating.execution.EFFECT_S", 0.2)
    return Desk(monkeypatch)


def alarm(
    action: AlarmAction, kind: int = AlarmKind.SECOND_BAND, *, time_s: int = 0, seen: dict[str, int] | None = None
) -> TreatAlarm:
    return TreatAlarm(kind="alarm", alarm=int(kind), action=int(action), time_s=time_s, seen=seen)


def load_file(steps: Sequence[tuple[float, float]]) -> PlayLoad:
    return PlayLoad(
        kind="load_file", content="\n".join(["time_s,load_w", *(f"{time},{watts}" for time, watts in steps)])
    )


# -- what is not known -------------------------------------------------------------------------------------------------


async def test_a_command_that_was_written_and_not_answered_is_neither_applied_nor_refused(desk: Desk) -> None:
    desk.plant.failures = [SILENT]
    outcome = await desk.outcome(SetLoad(kind="load", watts=431.0))
    assert (outcome.applied, outcome.refused_because) == ("", "")
    assert "did not answer" in outcome.uncertain_because
    assert "check its effect" in outcome.uncertain_because


@pytest.mark.parametrize("how", ["absent", "refusing"])
async def test_a_command_that_was_certainly_not_taken_is_refused(desk: Desk, how: str) -> None:
    desk.plant.failures = [PAST]
    outcome = await desk.outcome(LOAD, desk.plant if how == "absent" else None)
    assert outcome.refused_because
    assert (outcome.applied, outcome.uncertain_because) == ("", "")


async def test_time_goes_as_before_when_a_service_that_follows_it_is_missing(desk: Desk) -> None:
    outcome = await desk.outcome(SetFactor(kind="factor", factor=2.0), desk.optimizer)
    assert outcome.refused_because == "nobody listens there"
    assert desk.plant.written == [], "what is told as refused has not been done at any service"


async def test_a_time_base_that_only_some_services_have_taken_is_told(desk: Desk) -> None:
    desk.control.failures = [PAST]
    outcome = await desk.outcome(SetFactor(kind="factor", factor=2.0))
    assert desk.plant.written
    assert outcome.uncertain_because


async def test_a_load_file_whose_later_part_is_refused_says_what_the_plant_has_taken(desk: Desk) -> None:
    desk.plant.failures = [None, PAST]
    outcome = await desk.outcome(load_file([(float(i), 400.0 + i) for i in range(60)]))
    taken = [record for record in desk.plant.written if isinstance(record, LoadAhead)]
    assert sum(part.length for part in taken) == 24
    assert (
        "of 60 steps the plant has taken at least the first 24, and holds 423 W from 275 s on"
        in outcome.uncertain_because
    )


async def test_a_load_file_whose_first_part_is_refused_changes_nothing_and_says_so(desk: Desk) -> None:
    desk.plant.failures = [PAST]
    outcome = await desk.outcome(load_file([(float(i), 400.0) for i in range(60)]))
    assert "refused function 16" in outcome.refused_because
    assert desk.plant.written == []


async def test_a_step_that_is_longer_than_one_request_can_say_begins_another_one(desk: Desk) -> None:
    hours = 5 * 3600.0
    outcome = await desk.outcome(load_file([(0.0, 400.0), (hours, 500.0)]))
    assert outcome.applied
    assert [part.tick - 1008 for part in desk.plant.written if isinstance(part, LoadAhead)] == [0, hours / TICK_S]


@pytest.mark.parametrize(
    ("pace", "ticks"),
    [(SessionPace(1, 1, 1.0, 0), 8), (SessionPace(1, 1, 200.0, 0), 1600), (SessionPace(1, 0, 0.0, 0), 8)],
    ids=["factor 1", "factor 200", "lock-step"],
)
def test_a_load_begins_late_enough_to_be_there_in_time(pace: SessionPace, ticks: int) -> None:
    assert lead_ticks(pace, TICK_S) == ticks


# -- alarms ------------------------------------------------------------------------------------------------------------


async def test_all_alarms_out_of_service_is_read_back_as_such(desk: Desk) -> None:
    outcome = await desk.outcome(alarm(AlarmAction.OUT_OF_SERVICE, ALL_ALARMS))
    assert outcome.applied == f"of {len(AlarmKind)} alarms {len(AlarmKind)} out of service"
    outcome = await desk.outcome(alarm(AlarmAction.IN_SERVICE, ALL_ALARMS))
    assert outcome.applied == f"of {len(AlarmKind)} alarms {len(AlarmKind)} normal"


async def test_all_alarms_are_shelved_but_one_that_cannot_be(desk: Desk) -> None:
    await desk.outcome(alarm(AlarmAction.OUT_OF_SERVICE))
    outcome = await desk.outcome(alarm(AlarmAction.SHELVE, ALL_ALARMS, time_s=60))
    assert outcome.applied == f"of {len(AlarmKind)} alarms {len(AlarmKind) - 1} shelved; not t5 band"


async def test_what_the_control_plc_ignores_is_not_told_as_applied(desk: Desk) -> None:
    await desk.outcome(alarm(AlarmAction.OUT_OF_SERVICE))  # by somebody else, between the two steps
    outcome = await desk.outcome(alarm(AlarmAction.SHELVE, time_s=60))
    assert outcome.refused_because == "t5 band: out of service; the control PLC did not take it"
    assert outcome.uncertain_because == ""


async def test_an_alarm_that_was_raised_again_is_not_acknowledged_unseen(desk: Desk) -> None:
    desk.control.panel.raised(AlarmKind.SECOND_BAND)
    desk.control.panel.raised(AlarmKind.MODE, 1)
    seen = {"t5 band": 1, "mode": 1}
    desk.control.panel.raised(AlarmKind.MODE, 2)
    outcome = await desk.outcome(alarm(AlarmAction.ACKNOWLEDGE, AlarmKind.MODE, seen=seen))
    assert outcome.refused_because == "raised again since it was shown: mode; look at it first"
    desk.control.panel.raised(AlarmKind.SENSOR_BAD)
    outcome = await desk.outcome(alarm(AlarmAction.ACKNOWLEDGE, ALL_ALARMS, seen=seen))
    assert outcome.applied == (
        "alarm t5 band: acknowledged; raised again since they were shown, and left: mode, sensor bad"
    )
    states = [desk.control.panel.rows[kind].state for kind in (AlarmKind.MODE, AlarmKind.SENSOR_BAD)]
    assert states == [AlarmState.UNACKNOWLEDGED] * 2


async def test_nothing_to_acknowledge_is_said(desk: Desk) -> None:
    outcome = await desk.outcome(alarm(AlarmAction.ACKNOWLEDGE, ALL_ALARMS, seen={}))
    assert outcome.refused_because == "no alarm waits for an acknowledgement any more"


@pytest.mark.parametrize(
    ("pace", "part"),
    [
        (SessionPace(1, 1, 1.0, 0), "Shelve: alarm t5 band for 15 min"),
        (SessionPace(1, 1, 20.0, 0), "for 15 min of plant time, 45 s by the clock at factor 20"),
        (SessionPace(1, 1, 20.0, 1), "for 15 min of plant time, which is paused"),
        (SessionPace(1, 0, 1.0, 0), "for 15 min of plant time, which advances as it is granted"),
    ],
    ids=["factor 1", "factor 20", "paused", "lock-step"],
)
async def test_how_long_an_alarm_is_shelved_is_said_by_the_clock_too(desk: Desk, pace: SessionPace, part: str) -> None:
    desk.model.put("plant", pace)
    assert (await desk.asked(alarm(AlarmAction.SHELVE, time_s=900))).endswith(part)


# -- what else a command would do --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command", [SetLoad(kind="load", watts=431.0), load_file([(0.0, 431.0)])], ids=["load", "file"]
)
async def test_that_the_rest_of_a_load_is_dropped_is_said_before(desk: Desk, command: Command) -> None:
    assert "dropped" not in await desk.asked(command)
    desk.model.put("plant", LoadStatus(400.0, 1200, 500.0, 14_400, upcoming=7))
    assert (await desk.asked(command)).endswith(
        "; the 7 steps of the load still to come, until 1:00:00, will be dropped"
    )


async def test_a_confirmation_counts_once_in_time_and_from_who_asked(desk: Desk) -> None:
    command = SetMode(kind="mode", mode="auto")
    token, *_ = await desk.desk.prepare(command, "anna")
    with pytest.raises(UsageError, match="nothing to confirm"):
        await desk.desk.confirm(token, "lena")
    assert (await desk.desk.confirm(token, "anna")).applied, "somebody else's attempt has not used it up"
    with pytest.raises(UsageError, match="nothing to confirm"):
        await desk.desk.confirm(token, "anna")
    token, *_ = await desk.desk.prepare(command, "anna")
    desk.clock.time += CONFIRM_WITHIN_S + 1
    with pytest.raises(UsageError, match="within 60 s"):
        await desk.desk.confirm(token, "anna")


SETPOINT = SetSetpoint(kind="setpoint", input="CV155", value=44.0)
LOAD = SetLoad(kind="load", watts=431.0)
SESSION = Identity(session=2, tick=0)


@pytest.mark.parametrize(
    ("command", "service", "change", "part"),
    [
        (SETPOINT, "control", Operator(OperatorMode.MANUAL, (46.0, 75.0, 36.0)), "setpoint of CV155: 43 %, now 46 %"),
        (SETPOINT, "control", SESSION, "session: 1, now 2"),
        (
            SetMode(kind="mode", mode="auto"),
            "control",
            Operator(OperatorMode.AUTO, (43.0, 75.0, 36.0)),
            "manual, now auto",
        ),
        (LOAD, "plant", LoadStatus(watts=410.0), "heat load: 400 W, now 410 W"),
        (LOAD, "plant", LoadStatus(400.0, 1200, 500.0, 14_400, upcoming=7), "now changing until 1:00:00"),
        (SetPaused(kind="pause", paused=True), "plant", SessionPace(1, 1, 9.0, 0), "factor 1, now factor 9"),
    ],
)
async def test_a_confirmation_ends_when_its_premises_change(
    desk: Desk, command: Command, service: str, change: tuple[Any, ...], part: str
) -> None:
    peer: Peer = getattr(desk, service)
    desk.control.records[Operator] = Operator(OperatorMode.MANUAL, (43.0, 75.0, 36.0))
    token, *_ = await desk.desk.prepare(command, "anna")
    peer.records[type(change)] = change
    with pytest.raises(PremisesChangedError, match=part) as changed:
        await desk.desk.confirm(token, "anna")
    assert peer.written == []
    with pytest.raises(UsageError, match="nothing to confirm"):
        await desk.desk.confirm(token, "anna")
    if change is not SESSION:
        assert (await desk.desk.confirm(changed.value.preview.token, "anna")).applied, "asked again as it is now"


async def test_an_operator_learns_whose_command_came_between(desk: Desk) -> None:
    asked = await desk.desk.prepare(LOAD, "anna")
    assert asked.now == "heat load 400 W"
    other, *_ = await desk.desk.prepare(SetLoad(kind="load", watts=420.0), "bob")
    desk.plant.records[LoadStatus] = LoadStatus(watts=420.0)
    with pytest.raises(PremisesChangedError):
        await desk.desk.confirm(other, "bob")
    other, *_ = await desk.desk.prepare(SetLoad(kind="load", watts=420.0), "bob")
    assert (await desk.desk.confirm(other, "bob")).applied
    with pytest.raises(PremisesChangedError, match="bob's: Change the heat load to 420 W"):
        await desk.desk.confirm(asked.token, "anna")


@pytest.mark.parametrize(
    ("say", "seconds", "text"),
    [
        (duration_text, 900, "15 min"), (duration_text, 5400, "1 h 30 min"), (duration_text, 4.5, "4 s"),
        (duration_text, 0.18, "0.18 s"), (clock_text, 3725.75, "1:02:05"),
    ],
)  # fmt: skip
def test_times_are_said_as_people_do(say: Callable[[float], str], seconds: float, text: str) -> None:
    assert say(seconds) == text
