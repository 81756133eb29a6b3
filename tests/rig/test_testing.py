"""`coldloop_rig.testing` and the fixture `coldloop_rigs`: rigs for test suites, ours and others'."""

import importlib.metadata
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from coldloop.errors import LinkError, RequestRefusedError, UsageError
from coldloop.registers.control_plc import Mode, OperatorMode, PlantLinkState
from coldloop_rig.testing import LiveRig, Rigs, up


@pytest.fixture(scope="module")
def live_rig() -> Iterator[LiveRig]:
    with up(load="e") as one:
        yield one


@pytest.fixture
def rig(live_rig: LiveRig) -> LiveRig:
    return live_rig


def mode(rig: LiveRig) -> Mode:
    return Mode(rig.control_plc.read("ladder.mode"))


def test_a_test_suite_that_does_not_name_the_plugin_has_nothing_of_it() -> None:
    assert not [
        entry for entry in importlib.metadata.distribution("coldloop").entry_points if entry.group == "pytest11"
    ]


def test_lock_step_moves_as_far_as_it_is_let_and_no_further(rig: LiveRig) -> None:
    before = rig.time_s
    assert rig.advance(5) == before + 5
    assert rig.time_s == before + 5


def test_registers_are_read_by_name_as_value_array_and_block(rig: LiveRig) -> None:
    assert rig.plant.read("identity.magic") == pytest.approx(123.456)
    outputs = rig.plant.read("measurement.y")
    assert rig.plant.read("measurement.y.L1") == outputs[0] == pytest.approx(60, abs=1)
    assert rig.plant.read_block("measurement").y == outputs
    assert rig.plant.read("load table.watts", row=0) > 0


def test_an_operator_writes_by_name(rig: LiveRig) -> None:
    rig.control_plc.write("operator.mode", OperatorMode.CLASSICAL)
    rig.wait_until(lambda: mode(rig) is Mode.CLASSICAL)
    rig.control_plc.write("operator.mode", OperatorMode.AUTO)
    rig.wait_until(lambda: mode(rig) is Mode.MPC)


def test_a_block_with_a_crc_is_sealed_when_it_is_written(rig: LiveRig) -> None:
    rig.plant.write_block("live load", tick=0, watts=430.0)
    rig.advance(0.5)
    assert rig.plant.read("load status.watts") == 430.0


def test_a_refusal_has_its_exception_code(rig: LiveRig) -> None:
    with pytest.raises(RequestRefusedError, match="exception 2") as refused:
        rig.plant.write_block("measurement", tick=1)
    assert refused.value.exception_code == 2


@pytest.mark.parametrize(
    ("act", "part"),
    [
        (lambda rig: rig.plant.read("measurement.y.T55"), "did you mean measurement.y.T5"),
        (lambda rig: rig.plant.read_block("oven"), "unknown block 'oven'; choose from identity"),
        (lambda rig: rig.plant.read("load table.watts", row=5000), "rows 0 to 2047"),
        (lambda rig: rig.control_plc.write_block("operator", speed=1), "no register 'speed'; it has mode"),
        (lambda rig: rig.control_plc.write("operator.mode", "manual"), "block 'operator' cannot hold mode='manual'"),
        (lambda rig: rig.control_plc.write("operator.mode", 70000), "cannot hold mode=70000"),
        (lambda rig: rig.advance(0.1), "multiple of 0.25"),
        (lambda rig: rig.log("boiler"), "unknown service 'boiler'"),
        (lambda rig: rig.fault("meteor").__enter__(), "fault 'meteor'"),
        (lambda rig: rig.fault("kill").__enter__(), "process: Field required"),
        (lambda rig: rig.fault("kill", process="plant", duration_s=3).__enter__(), "duration_s belongs to a plan"),
        (lambda rig: rig.fault("sensor", output="T55", shows="nan").__enter__(), "unknown output 'T55'"),
    ],
)
def test_what_cannot_be_done_is_one_line(rig: LiveRig, act: "object", part: str) -> None:
    with pytest.raises(UsageError, match=part) as error:
        act(rig)  # type: ignore[operator]
    assert "\n" not in str(error.value)


def test_a_killed_service_comes_back_and_the_session_goes_on(rig: LiveRig) -> None:
    before = rig.time_s
    with rig.fault("kill", process="control"):
        pass
    assert rig.advance(10) >= before + 10
    rig.wait_until(lambda: mode(rig) is Mode.MPC)


@pytest.mark.usefixtures("processes", "realtime")
def test_the_links_of_a_rig_in_real_time_can_be_disturbed_and_its_ports_closed_by_stopping_it(
    tmp_path: Path,
) -> None:
    with Rigs(tmp_path) as rigs:
        rig = rigs.up(load="e", mode="realtime", factor=10)

        def until(name: str, condition: Callable[[Any], bool]) -> None:
            rig.wait_until(lambda: condition(rig.control_plc.read(name)), within_s=900)

        until("plant link.state", lambda state: state == PlantLinkState.SYNCHRONISED)
        with rig.fault("freeze", link="plant"):
            until("plant link.state", lambda state: state == PlantLinkState.SEARCHING)
        until("plant link.state", lambda state: state == PlantLinkState.SYNCHRONISED)
        with rig.fault("sensor", output="T5", shows="nan"):
            until("ladder.bad_sensors", lambda sensors: sensors != 0)
        assert rig.log("plant").is_file()
        assert rig.log("plant").is_relative_to(tmp_path)
    for endpoint in rig.endpoints:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((endpoint.host, endpoint.port))


@pytest.mark.usefixtures("processes")
def test_a_service_that_ends_by_itself_is_named_with_its_log(tmp_path: Path) -> None:
    with up(load="e", folder=tmp_path) as rig:
        rig._services.processes["plant"].kill()  # noqa: SLF001 nobody ends a service by itself otherwise
        with pytest.raises(LinkError, match=r"the plant service was ended by SIGKILL .*plant\.log"):
            rig.advance(60)


def test_waiting_for_what_does_not_come_ends_after_plant_time(rig: LiveRig) -> None:
    before = rig.time_s
    with pytest.raises(TimeoutError, match=r"within 2 s of plant time: control_plc ladder\.mode = \d$"):
        rig.wait_until(lambda: rig.control_plc.read("ladder.mode") == 77, within_s=2)
    assert rig.time_s == before + 2


@pytest.mark.parametrize(
    ("arguments", "part"),
    [({"load": "nowhere"}, "nowhere"), ({"mode": "warp"}, "mode"), ({"plant": {"colour": 1}}, "colour")],
)
def test_a_rig_that_cannot_be_is_refused_before_anything_starts(arguments: dict[str, object], part: str) -> None:
    with pytest.raises(UsageError, match=part), up(**arguments):  # type: ignore[arg-type]
        pass
