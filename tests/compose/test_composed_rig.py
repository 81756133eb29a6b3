"""The rig as `docker compose up` brings it up."""

import asyncio
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import aiomqtt
import pytest

from coldloop.errors import RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.plant import Actuators, LoadStep
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import ComposedRig

SERVICES = ("plant", "control-plc", "optimizer-plc")


R = TypeVar("R", bound=tuple[Any, ...])


def read_from_plant(rig: "ComposedRig", record: type[R]) -> R:
    async def read() -> R:
        client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=rig.plant, timeout_s=5.0)
        try:
            await client.connect(5.0)
            return await client.read(record)
        finally:
            client.close()

    return asyncio.run(read())


def identity_of_plant(rig: "ComposedRig") -> Identity:
    return read_from_plant(rig, Identity)


LATE_S = 2.0
"""By how much the rack's clock may be late on a busy machine: a rack at another factor is further away after 4 s."""
START_BROKER = ("sh", "/mosquitto/config/start.sh")
FOLDER = Path(__file__).parents[2] / "docker" / "test_site"
"""Passwords of the broker's users, those that come with the project."""


def retained(rig: "ComposedRig", *topics: str) -> dict[str, Any]:
    """Return the retained messages of these topics, as an operator reads them."""

    async def read() -> dict[str, Any]:
        found: dict[str, Any] = {}
        async with asyncio.timeout(60), broker(rig, "operator") as client:
            for topic in topics:
                await client.subscribe(topic)
            async for message in client.messages:
                if message.retain:
                    found[message.topic.value] = json.loads(bytes(message.payload))
                if len(found) == len(topics):
                    return found
        raise AssertionError("unreachable")

    return asyncio.run(read())


def broker(rig: "ComposedRig", user: str | None) -> aiomqtt.Client:
    file = FOLDER / f"{user}.password"
    password = file.read_text(encoding="utf-8").strip() if file.exists() else None
    return aiomqtt.Client("127.0.0.1", rig.mqtt, username=user, password=password)


ASK = """
import socket, sys
try:
    with socket.create_connection((sys.argv[1], int(sys.argv[2])), 5) as connection:
        connection.sendall(bytes.fromhex("000100000006ff0300000002"))
        print(connection.recv(100).hex())
except OSError as error:
    print(type(error).__name__)
"""


def ask(rig: "ComposedRig", service: str, host: str, port: int) -> str:
    """Return what a service gets that reads the first registers of another: its answer, or an error."""
    return rig.inside(service, "python", "-c", ASK, host, str(port))


def test_it_runs_in_real_time_by_itself(rig: "ComposedRig") -> None:
    before, first, after = time.monotonic(), identity_of_plant(rig), time.monotonic()
    time.sleep(4.0)
    again, second, end = time.monotonic(), identity_of_plant(rig), time.monotonic()
    assert first.session == second.session == 1
    passed_s = (second.tick - first.tick) / 4
    assert again - after - LATE_S <= passed_s <= end - before + LATE_S


def test_the_broker_keeps_what_each_service_tells(rig: "ComposedRig") -> None:
    names = ("plant", "control_plc", "optimizer_plc")
    messages = retained(rig, *[f"coldloop/{name}/{what}" for name in names for what in ("state", "telemetry")])
    assert all(messages[f"coldloop/{name}/state"] == {"state": "online"} for name in names)
    assert messages["coldloop/control_plc/telemetry"]["session"] == 1
    assert messages["coldloop/control_plc/telemetry"]["tick"] > 0


def test_each_service_reaches_its_own_neighbours_and_no_others(rig: "ComposedRig") -> None:
    answer = "000100000007ff030442f6e979"
    assert ask(rig, "control-plc", "plant.field", 5020) == answer
    assert ask(rig, "optimizer-plc", "control-plc.control", 5021) == answer
    assert ask(rig, "optimizer-plc", "plant.field", 5020) == "gaierror"
    for host, port in (("plant", 5020), ("control-plc", 5021)):  # over telemetry: connected, and closed at once
        assert ask(rig, "optimizer-plc" if host == "plant" else "plant", host, port) in {"", "ConnectionResetError"}


def test_who_comes_by_the_published_ports_is_an_operator_and_nothing_else(rig: "ComposedRig") -> None:
    async def write() -> None:
        client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=rig.plant, timeout_s=5.0)
        try:
            await client.connect(5.0)
            await client.write_rows([LoadStep(0, 385.0)])
            with pytest.raises(RequestRefusedError):
                await client.write(Actuators(0, (50.0, 50.0, 50.0), 1))
        finally:
            client.close()

    asyncio.run(write())


@pytest.mark.parametrize("user", [None, "nobody"])
def test_the_broker_lets_nobody_in_whom_it_does_not_know(rig: "ComposedRig", user: str | None) -> None:
    async def enter() -> None:
        async with broker(rig, user):
            raise AssertionError

    with pytest.raises(aiomqtt.MqttError, match="authori"):
        asyncio.run(enter())


def test_who_may_read_topics_may_not_write_them(rig: "ComposedRig") -> None:
    async def publish() -> None:
        for user in ("operator", "plant"):
            async with broker(rig, user) as client:
                await client.publish("coldloop/control_plc/command", b"{}", qos=1, retain=True)

    async def read() -> list[str]:
        async with broker(rig, "operator") as client:
            await client.subscribe("coldloop/control_plc/#")
            found = []
            async with asyncio.timeout(60):
                async for message in client.messages:
                    found.append(message.topic.value)
                    if message.topic.value.endswith("telemetry") and not message.retain:
                        return found
        raise AssertionError("unreachable")

    asyncio.run(publish())
    assert "coldloop/control_plc/command" not in asyncio.run(read())


def test_the_passwords_of_the_project_are_for_one_machine(rig: "ComposedRig") -> None:
    assert "warning: the password of operator is the one that comes with the project" in rig.compose(
        "logs", "mosquitto"
    )
    started = rig.compose(
        "run", "--rm", "--no-deps", "-T", "-e", "PUBLISHED_ON=0.0.0.0", "mosquitto", *START_BROKER, check=False
    )
    assert "error: the password of operator is the one that comes with the project" in started


@pytest.mark.parametrize("service", SERVICES)
def test_a_service_can_do_no_harm(rig: "ComposedRig", service: str) -> None:
    host = rig.inspect(service)["HostConfig"]
    assert host["ReadonlyRootfs"]
    assert host["CapDrop"] == ["ALL"]
    assert "no-new-privileges:true" in host["SecurityOpt"]
    assert min(host["Memory"], host["NanoCpus"], host["PidsLimit"]) > 0
    probe = "import os, pathlib; print(os.getuid(), os.access('/', os.W_OK), os.access('/opt/coldloop', os.W_OK))"
    assert rig.inside(service, "python", "-c", probe) == "10001 False False"
    assert "Read-only" in rig.compose("exec", "-T", "-u", "0", service, "touch", "/opt/coldloop/x", check=False)


def test_the_ports_are_those_of_this_machine_only(rig: "ComposedRig") -> None:
    for service in (*SERVICES, "mosquitto"):
        bindings = [b for port in rig.inspect(service)["HostConfig"]["PortBindings"].values() for b in port]
        assert [binding["HostIp"] for binding in bindings] == ["127.0.0.1"]


@pytest.mark.parametrize(
    ("service", "absent"),
    [("control-plc", ["numpy", "numba"]), ("plant", ["osqp", "pyarrow"]), ("optimizer-plc", ["pyarrow", "matplotlib"])],
)
def test_an_image_holds_only_what_its_service_needs(rig: "ComposedRig", service: str, absent: list[str]) -> None:
    probe = f"from importlib.util import find_spec; print(any(map(find_spec, {[*absent, 'pip', 'pytest']})))"
    assert rig.inside(service, "/opt/coldloop/bin/python", "-c", probe) == "False"


@pytest.mark.parametrize("service", ["plant", "optimizer-plc"])
def test_no_kernel_is_compiled_at_the_start(rig: "ComposedRig", service: str) -> None:
    count = "find {} -name '*.nbc' | wc -l"
    baked = rig.inside(service, "sh", "-c", count.format("/opt/coldloop/kernels"))
    assert int(baked) > 0
    assert rig.inside(service, "sh", "-c", count.format("/tmp/coldloop")) == baked  # noqa: S108


def test_a_service_that_dies_is_started_again(rig: "ComposedRig") -> None:
    before = rig.inspect("optimizer-plc")["State"]["StartedAt"]
    rig.compose("exec", "-T", "optimizer-plc", "python", "-c", "import os; os.kill(1, 15)")
    wait_until_healthy(rig, "optimizer-plc", before)


def wait_until_healthy(rig: "ComposedRig", service: str, before: str) -> None:
    """Wait for a start after that one."""
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        state = rig.inspect(service)["State"]
        if state["StartedAt"] != before and state["Health"]["Status"] == "healthy":
            return
        time.sleep(1)
    pytest.fail(f"not healthy again: {state}")


def test_new_containers_go_on_where_those_before_were(rig: "ComposedRig") -> None:
    before = identity_of_plant(rig)
    started = rig.inspect("control-plc")["State"]["StartedAt"]
    rig.compose("up", "--detach", "--force-recreate", "--no-deps", "plant", "control-plc")
    wait_until_healthy(rig, "control-plc", started)
    after = identity_of_plant(rig)
    assert (after.session, after.tick >= before.tick) == (before.session, True)
    logged = [line.partition("| ")[2] for line in rig.compose("logs", "--no-color", "plant").splitlines()]
    events = [json.loads(line) for line in logged if line.startswith("{")]
    boots = [event for event in events if event["event"] == "boot"]
    assert [boot["subject"] for boot in boots] == [1], "it goes on with its retained state"


def test_an_hour_in_lock_step_is_that_of_one_process(
    rig: "ComposedRig", coldloop: "Callable[..., None]", tmp_path: Path
) -> None:
    scenario = ["--load", "a", "--duration", "1h"]
    endpoints = [f"127.0.0.1:{port}" for port in (rig.plant, rig.control_plc, rig.optimizer_plc)]
    coldloop("--attach", *endpoints, *scenario, "--out", str(tmp_path / "composed"))
    coldloop("--in-process", *scenario, "--out", str(tmp_path / "one process"))
    composed, one_process = (
        json.loads((tmp_path / name / "summary.json").read_text()) for name in ("composed", "one process")
    )
    assert composed["ticks"] == 4 * 3600
    assert composed["trace_sha256"] == one_process["trace_sha256"]
    assert identity_of_plant(rig).session == 2
    assert read_from_plant(rig, SessionPace).realtime == 1, "it is given back as it was found"
