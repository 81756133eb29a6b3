"""The plant's rack: a watchdog over the control PLC, sensors that fail on purpose, and a session that survives."""

import math
from pathlib import Path
from typing import Any

import pytest

from coldloop.process import L1, T5
from coldloop.registers.declaration import Block
from coldloop.registers.plant import (
    PLANT_MAP,
    Actuators,
    Measurement,
    PlantSample,
    SensorFault,
    SensorFaultKind,
)
from coldloop.registers.safety import WatchdogState, WatchdogStatus, WatchdogTime
from coldloop.seal import is_intact, sealed
from coldloop.session import Pace
from plant.runtime import PlantRack
from plant.settings import PlantSettings


class Rack:
    """A rack whose clock is the test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **plant: object) -> None:
        later: list[Any] = []
        self._later = later

        class Loop:
            def call_soon(self, what: Any) -> None:  # noqa: ANN401 - as asyncio has it
                later.append(what)

        monkeypatch.setattr("plant.runtime.asyncio.get_running_loop", Loop)
        section = {"session": {"autostart": True}, "plant": {"load": "a", **plant}}
        self.rack = PlantRack(PlantSettings.model_validate(section))

    @property
    def tick(self) -> int:
        return self.rack.snapshot()["tick"]  # type: ignore[return-value]

    def write(self, record: Any, row: int = 0) -> None:  # noqa: ANN401 - any record of the map
        self.rack.bank.put(record, row)
        block: Block = PLANT_MAP.block_of(type(record))
        self.rack.on_write(block)

    def exchange(self, *u: float, **changed: int) -> Measurement:
        self.write(sealed(Actuators(self.tick, *u, 1))._replace(**changed))
        for what in self._later:
            what()
        self._later.clear()
        return self.rack.bank.get(Measurement)

    def passes(self, ticks: int) -> None:
        """Let the plant move by the clock, without the control PLC."""
        for _ in range(ticks):
            self.rack._moving = True  # noqa: SLF001 - what its clock does
            self.rack._advance()  # noqa: SLF001

    def outputs(self) -> tuple[float, ...]:
        return self.rack.snapshot()["inputs"].values()  # type: ignore[attr-defined,no-any-return]


U = (43.0, 80.0, 36.0)


@pytest.mark.parametrize(("action", "expected"), [("hold", U), ("safe", (30.0, 50.0, 40.0))])
def test_outputs_hold_or_go_to_the_safe_state_when_the_control_plc_is_silent(
    monkeypatch: pytest.MonkeyPatch, action: str, expected: tuple[float, ...]
) -> None:
    safe_state = {"timeout_s": 5.0, "action": action, "safe_state": (30.0, 50.0, 40.0)}
    rack = Rack(monkeypatch, watchdog=safe_state)
    rack.exchange(*U)
    rack.passes(18)
    assert tuple(rack.outputs()) == U
    assert rack.rack.bank.get(WatchdogStatus).state == WatchdogState.RUNNING
    rack.passes(2)
    assert tuple(rack.outputs()) == expected
    shown = rack.rack.bank.get(WatchdogStatus)
    assert (shown.time, shown.state, shown.trips) == (20, WatchdogState.EXPIRED, 1)
    assert rack.rack.bank.get(Actuators)[1:4] == expected, "the control PLC reads back what is applied"
    rack.exchange(*U)
    assert tuple(rack.outputs()) == U
    assert rack.rack.bank.get(WatchdogStatus).state == WatchdogState.RUNNING


def test_the_watchdog_is_set_by_register(monkeypatch: pytest.MonkeyPatch) -> None:
    rack = Rack(monkeypatch)
    rack.exchange(*U)
    rack.write(WatchdogTime(4))
    rack.passes(4)
    assert rack.rack.bank.get(WatchdogStatus).trips == 1
    rack.write(WatchdogTime(0))
    rack.passes(100)
    assert rack.rack.bank.get(WatchdogStatus).trips == 1
    assert rack.rack.bank.get(WatchdogStatus).state == WatchdogState.OFF


def test_outputs_that_arrive_damaged_are_not_applied(monkeypatch: pytest.MonkeyPatch) -> None:
    rack = Rack(monkeypatch)
    rack.exchange(*U)
    rack.write(sealed(Actuators(rack.tick, 50.0, 80.0, 36.0, 1))._replace(cv155=50.5))
    assert tuple(rack.outputs()) == U
    rack.write(Actuators(rack.tick, 44.0, 80.0, 36.0, 1))
    assert tuple(rack.outputs()) == (44.0, 80.0, 36.0), "a simple client need not seal"


def test_a_measurement_is_sealed(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = Rack(monkeypatch).exchange(*U)
    assert measured.crc
    assert is_intact(measured)
    assert not is_intact(measured._replace(load=measured.load + 1.0))


def test_sensors_fail_on_purpose_and_the_history_keeps_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    rack = Rack(monkeypatch)
    rack.exchange(*U)
    rack.write(SensorFault(SensorFaultKind.NOT_A_NUMBER, 0.0), L1)
    rack.write(SensorFault(SensorFaultKind.FROZEN, 0.0), T5)
    rack.write(SensorFault(SensorFaultKind.VALUE, 12.5), 4)
    shown = rack.exchange(*U).y
    for _ in range(8):
        y = rack.exchange(*U).y
    assert math.isnan(y[L1])
    assert (y[T5], y[4]) == (shown[T5], 12.5)
    true = rack.rack.bank.get(PlantSample, rack.tick - 1).y
    assert true[T5] != shown[T5]
    assert math.isfinite(true[L1])
    for output in (L1, T5, 4):
        rack.write(SensorFault(SensorFaultKind.NONE, 0.0), output)
    assert all(map(math.isfinite, rack.exchange(*U).y))


def test_a_killed_rack_goes_on_where_it_was(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    plant = {"retain": {"file": str(tmp_path / "plant")}, "sensors": {"level": 0.1}}
    undisturbed, killed = Rack(monkeypatch, sensors={"level": 0.1}), Rack(monkeypatch, **plant)
    for _ in range(30):
        undisturbed.exchange(*U)
        killed.exchange(*U)
    again = Rack(monkeypatch, **plant)
    assert again.tick == 30
    assert tuple(again.outputs()) == U
    for _ in range(30):
        expected = undisturbed.exchange(44.0, 75.0, 36.0)
        found = again.exchange(44.0, 75.0, 36.0)
    assert found == expected, "to the bit, the sensors' noise included"


@pytest.mark.parametrize("content", [b"", b"coldloop-retained plant/1", b"\x00" * 100])
def test_a_state_that_cannot_be_trusted_is_refused_and_said_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    (tmp_path / "plant").write_bytes(content)
    rack = Rack(monkeypatch, retain={"file": str(tmp_path / "plant")})
    assert rack.tick == 0
    assert "retained state refused" in caplog.text


def test_outputs_of_another_tick_are_not_applied_and_the_answer_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    rack = Rack(monkeypatch)
    rack.exchange(*U)
    for changed in ({"tick": 0}, {"tick": 7}, {"session": 9}, {"cv155": 50}):
        answer = rack.exchange(44.0, 70.0, 37.0, **changed)
        assert answer.crc == 0, "not taken"
        assert (rack.tick, tuple(rack.outputs())) == (1, U)
        shown = rack.rack.bank.get(Actuators)
        assert shown[1:4] == U
        assert is_intact(shown), "what is applied is read back, not what was refused"
    assert rack.exchange(44.0, 70.0, 37.0).crc


def test_in_real_time_what_a_network_held_up_is_not_applied(monkeypatch: pytest.MonkeyPatch) -> None:
    rack = Rack(monkeypatch)
    monkeypatch.setattr(PlantRack, "_start_clock", lambda _self: None)
    rack.rack._pace = Pace(realtime=True, factor=1.0)  # noqa: SLF001
    rack.write(sealed(Actuators(0, *U, 1)))
    rack.passes(40)
    rack.write(sealed(Actuators(10, 30.0, 10.0, 30.0, 1)))
    assert tuple(rack.outputs()) == U
    rack.write(sealed(Actuators(39, 43.5, 80.0, 36.0, 1)))
    assert tuple(rack.outputs()) == (43.5, 80.0, 36.0)
