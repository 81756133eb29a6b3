"""Services as programs of their own: how they end when they cannot begin, and when they are told to."""

import asyncio
import signal
import socket
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.modbus.client import RegisterClient
from coldloop.process.model_file import read_document, write_document
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop.registers.common import Alarm, AlarmKind
from coldloop.registers.control_plc import PlantLinkState, PlantLinkStatus
from tests.harness.records import CONTROL_MAP
from tests.harness.waiting import until

if TYPE_CHECKING:
    from tests.harness.processes import Process
    from tests.services.conftest import Start

USAGE, FAILURE = 2, 1
PATIENCE_S = 60.0
SERVICES = ("plant", "control_plc", "optimizer_plc")


def assert_ended(process: "Process", code: int, *parts: str) -> None:
    """Wait for the end; the one line that it has written has all the parts."""
    ended_with, complaint = process.popen.wait(PATIENCE_S), process.said
    assert ended_with == code, complaint
    assert len(complaint.splitlines()) == 1, complaint
    for part in parts:
        assert part in complaint


def test_each_service_names_a_wrong_key_and_leaves_the_sections_of_others_alone(start: "Start") -> None:
    others = [f"{service}.nonsense=1" for service in SERVICES]
    started = {service: start(service, *others) for service in SERVICES}
    for service, process in started.items():
        assert_ended(process, USAGE, f"{service}.nonsense", "no such key")


def test_a_port_in_use_is_named_with_what_to_do(start: "Start") -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        process = start("plant", port=port)
        assert_ended(process, FAILURE, f"127.0.0.1:{port}", "in use", "another port")


async def test_a_control_plc_waits_for_a_rack_that_is_absent_at_power_up(
    start: "Start",
    free_port: int,
    realtime: None,  # noqa: ARG001 a mark
) -> None:
    """It says so in its registers, and goes on by itself when the rack comes."""
    alone = ("session.autostart=true", "session.mode=realtime", "session.factor=20")
    process = start("control_plc", f"control_plc.plant.port={free_port}", "control_plc.power_up_s=0.5", *alone)
    client = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=process.port, timeout_s=PATIENCE_S)
    await client.connect(PATIENCE_S)
    await until(lambda: is_lost(client))
    assert (await client.read(PlantLinkStatus)).state == PlantLinkState.SEARCHING
    assert process.alive
    start("plant", *alone, port=free_port)
    await until(lambda: is_in_step(client))
    client.close()


async def is_lost(client: RegisterClient) -> bool:
    """Tell whether the control PLC says that its rack is lost."""
    return bool((await client.read_rows(Alarm, AlarmKind.PLANT_LOST, 1))[0].active)


async def is_in_step(client: RegisterClient) -> bool:
    """Tell whether the control PLC writes to its rack."""
    return (await client.read(PlantLinkStatus)).state == PlantLinkState.SYNCHRONISED


def test_an_optimiser_refuses_a_control_plc_with_another_model(start: "Start", tmp_path: Path) -> None:
    document = read_document(DEFAULT_MODEL_FILE)
    document["B"][0][0] *= 1.001
    other = tmp_path / "model.json"
    write_document(other, document)
    control = start("control_plc", f"model.file={other}")
    process = start("optimizer_plc", f"optimizer_plc.control_plc.port={control.port}")
    digests = [f"{read_document(file)['digest'][:8]}" for file in (DEFAULT_MODEL_FILE, other)]
    assert_ended(process, FAILURE, "same model.file", *digests)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
async def test_a_service_that_is_told_to_stop_ends_in_good_order(number: signal.Signals, start: "Start") -> None:
    process = start("control_plc", level="info")
    client = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=process.port, timeout_s=PATIENCE_S)
    await client.connect(PATIENCE_S)
    client.close()
    assert await asyncio.to_thread(process.interrupt, number) == 0
    assert "Traceback" not in process.said
