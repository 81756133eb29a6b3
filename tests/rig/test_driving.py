"""Mode, cause, driver, bad and faulty sensors of each tick, from events."""

import math

import numpy as np
import pytest

from coldloop.process.cold_box import COLD_BOX, L1, OUTPUT_NAMES
from coldloop.registers.common import Event, EventKind
from coldloop.registers.control_plc import Cause, Mode
from coldloop.registers.plant import SensorFaultKind
from coldloop_rig.results.file_sinks import DrivingHistory
from coldloop_rig.results.recording import CONTROL, PLANT


def mode(tick: int, subject: Mode, cause: Cause = Cause.NONE) -> Event:
    return Event(tick=tick, kind=EventKind.MODE, subject=subject, cause=cause)


def sensor(tick: int, output: int, *, bad: bool) -> Event:
    return Event(tick=tick, kind=EventKind.SENSOR, subject=output, cause=int(bad))


def fault(tick: int, kind: SensorFaultKind, value: float = 0.0) -> Event:
    return Event(tick=tick, kind=EventKind.SENSOR_FAULT, subject=L1, cause=kind, value=value)


def history(service: str, *events: Event) -> DrivingHistory:
    taken = DrivingHistory(COLD_BOX)
    for event in events:
        taken.event(service, event)
    return taken


def modes(taken: DrivingHistory, first: int, end: int) -> list[str | None]:
    modes: list[str | None] = taken.columns(np.arange(first, end))[0].to_pylist()
    return modes


def shown(taken: DrivingHistory, first: int, end: int) -> list[float | None]:
    """What the sensor of L1 shows where the level is the tick."""
    y = np.repeat(np.arange(first, end, dtype=np.float32)[:, None], len(OUTPUT_NAMES), axis=1)
    values: list[float | None] = taken.measured(np.arange(first, end), y)[0].to_pylist()
    return values


def test_a_mode_holds_from_its_tick_to_the_next_one() -> None:
    taken = history(
        CONTROL, mode(0, Mode.HOLD, Cause.SESSION_STARTED), mode(2, Mode.MPC, Cause.SEQUENCE_BEGAN),
        mode(4, Mode.MANUAL, Cause.OPERATOR),
    )  # fmt: skip
    names, causes, drivers, bad = (column.to_pylist() for column in taken.columns(np.arange(5)))
    assert names == ["hold", "hold", "mpc", "mpc", "manual"]
    assert causes == ["session started"] * 2 + ["sequence began"] * 2 + ["operator"]
    assert drivers == ["nobody", "nobody", "optimizer", "optimizer", "operator"]
    assert bad == [""] * 5


def test_before_the_first_event_the_mode_is_not_known() -> None:
    assert modes(history(CONTROL, mode(1, Mode.MPC)), 0, 2) == [None, "mpc"]


def test_what_a_control_plc_notes_after_going_back_holds_from_there_on() -> None:
    taken = history(CONTROL, mode(0, Mode.HOLD), mode(5, Mode.MPC), mode(4, Mode.HOLD), mode(7, Mode.MPC))
    assert modes(taken, 3, 8) == ["hold", "hold", "hold", "hold", "mpc"]


def test_blocks_one_after_the_other_have_the_modes_of_one_block() -> None:
    events = [mode(0, Mode.HOLD), mode(3, Mode.MPC), sensor(5, L1, bad=True), mode(6, Mode.CLASSICAL)]
    whole, parts = history(CONTROL, *events), history(CONTROL, *events)
    expected = [column.to_pylist() for column in whole.columns(np.arange(9))]
    found: list[list[str]] = [[], [], [], []]
    for first in range(0, 9, 3):
        for column, values in zip(found, parts.columns(np.arange(first, first + 3)), strict=True):
            column.extend(values.to_pylist())
        parts.forget(first + 3)
    assert found == expected


def test_bad_sensors_are_named_while_they_are_bad() -> None:
    taken = history(
        CONTROL, mode(0, Mode.MPC), sensor(1, L1, bad=True), sensor(2, 6, bad=True), sensor(3, L1, bad=False)
    )
    assert taken.columns(np.arange(4))[3].to_pylist() == [
        "", OUTPUT_NAMES[L1], f"{OUTPUT_NAMES[L1]} {OUTPUT_NAMES[6]}", OUTPUT_NAMES[6],
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (SensorFaultKind.NOT_A_NUMBER, [0.0, None, None, 3.0]),
        (SensorFaultKind.FROZEN, [0.0, 1.0, 1.0, 3.0]),
        (SensorFaultKind.VALUE, [0.0, 7.5, 7.5, 3.0]),
    ],
)
def test_a_faulty_sensor_shows_its_fault_until_it_is_healed(kind: SensorFaultKind, expected: list[float]) -> None:
    taken = history(PLANT, fault(1, kind, 7.5), fault(3, SensorFaultKind.NONE))
    assert shown(taken, 0, 4) == expected


def test_a_sensor_that_froze_in_an_earlier_block_still_shows_the_same() -> None:
    taken = history(PLANT, fault(1, SensorFaultKind.FROZEN))
    assert shown(taken, 0, 3) == [0.0, 1.0, 1.0]
    taken.forget(3)
    assert shown(taken, 3, 5) == [1.0, 1.0]


def test_a_new_session_begins_with_healthy_sensors() -> None:
    taken = history(PLANT, fault(900, SensorFaultKind.VALUE, math.pi), Event(kind=EventKind.SESSION))
    assert shown(taken, 0, 2) == [0.0, 1.0]
