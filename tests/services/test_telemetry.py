"""Telemetry: what a broker knows of a service, and that control never waits for it."""

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiomqtt
import pytest

from coldloop.service.monitoring import Telemetry
from coldloop.service.settings import TelemetrySettings
from tests.harness.waiting import until

if TYPE_CHECKING:
    from tests.services.conftest import Broker, Serve, ServeFrozen, Start

PATIENCE_S = 60.0
ONLINE, OFFLINE = {"state": "online"}, {"state": "offline"}


async def keeps(broker: "Broker", topic: str, value: object) -> None:
    await until(lambda: broker.retained(topic), lambda now: now == value)


@contextlib.asynccontextmanager
async def publishing(
    port: int,
    snapshot: Callable[[], Mapping[str, object]],
    **settings: Any,  # noqa: ANN401 - any setting
) -> AsyncIterator["asyncio.Task[None]"]:
    chosen = TelemetrySettings(**{"broker": "127.0.0.1", "port": port, "period_s": 0.02, "timeout_s": 1.0, **settings})
    task = asyncio.create_task(Telemetry(chosen, "plant", snapshot).run())
    try:
        yield task
    finally:
        while not task.done():
            for one in [task, *(one for one in asyncio.all_tasks() if one.get_name().startswith("telemetry"))]:
                one.cancel()
            await asyncio.wait({task}, timeout=1)


async def test_a_service_is_online_shows_itself_and_goes_offline_in_good_order(broker: "Serve", free_port: int) -> None:
    ticks = iter(range(1000))
    async with broker(free_port) as known:
        async with publishing(free_port, lambda: {"tick": next(ticks), "inputs": {"CV155": 43.0}}):
            await keeps(known, "coldloop/plant/state", ONLINE)
            first = await until(lambda: known.retained("coldloop/plant/telemetry"), lambda now: now is not None)
            assert first["inputs"] == {"CV155": 43.0}
            await until(lambda: known.retained("coldloop/plant/telemetry"), lambda now: now["tick"] > first["tick"])
        await keeps(known, "coldloop/plant/state", OFFLINE)


async def test_a_service_that_is_killed_leaves_its_last_will(broker: "Serve", free_port: int, start: "Start") -> None:
    async with broker(free_port) as known:
        service = start(
            "control_plc", "telemetry.broker=127.0.0.1", f"telemetry.port={free_port}",
            "telemetry.prefix=hall-3",
        )  # fmt: skip
        await keeps(known, "hall-3/control_plc/state", ONLINE)
        telemetry = await until(lambda: known.retained("hall-3/control_plc/telemetry"), lambda now: now is not None)
        assert telemetry["mode"] == "hold"
        assert set(telemetry["inputs"]) == {"CV155", "NCR22_A", "CV156"}
        service.kill()
        await keeps(known, "hall-3/control_plc/state", OFFLINE)


async def test_a_broker_that_comes_late_gets_the_newest_snapshots(broker: "Serve", free_port: int) -> None:
    taken = 0

    def snapshot() -> dict[str, object]:
        nonlocal taken
        taken += 1
        return {"number": taken}

    async def number() -> int:
        return taken

    async with publishing(free_port, snapshot, queue=3) as task:
        await until(number, lambda now: now > 10)
        assert not task.done()
        async with broker(free_port) as known:
            shown = await until(lambda: known.retained("coldloop/plant/telemetry"), lambda now: now is not None)
            assert shown["number"] > 10 - 3


async def test_without_a_broker_in_the_configuration_nothing_is_sampled() -> None:
    def snapshot() -> dict[str, object]:
        raise AssertionError

    await Telemetry(TelemetrySettings(), "plant", snapshot).run()


@pytest.mark.usefixtures("realtime")
async def test_a_service_can_be_stopped_while_its_broker_is_frozen(
    frozen_broker: "ServeFrozen", free_port: int
) -> None:
    async with frozen_broker(free_port) as known, publishing(free_port, lambda: {"tick": 1}) as task:
        await keeps(known, "coldloop/plant/state", ONLINE)
        known.frozen = True
        task.cancel()
        done, _ = await asyncio.wait({task}, timeout=PATIENCE_S)
        assert done


async def test_a_service_that_is_stopped_just_as_its_broker_answers_ends(
    frozen_broker: "ServeFrozen", free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = aiomqtt.Client.publish
    answered = asyncio.Event()

    async def publish_and_forget_a_cancellation(client: aiomqtt.Client, *what: Any, **how: Any) -> None:  # noqa: ANN401
        await publish(client, *what, **how)
        answered.set()
        with contextlib.suppress(asyncio.CancelledError):  # as asyncio.wait_for of Python 3.11 does
            await asyncio.sleep(PATIENCE_S)

    async with frozen_broker(free_port) as known, publishing(free_port, lambda: {"tick": 1}) as task:
        await keeps(known, "coldloop/plant/telemetry", {"tick": 1})
        monkeypatch.setattr(aiomqtt.Client, "publish", publish_and_forget_a_cancellation)
        await answered.wait()
        monkeypatch.undo()
        task.cancel()
        done, _ = await asyncio.wait({task}, timeout=PATIENCE_S)
        assert done


async def test_a_service_can_be_stopped_though_its_connection_fails_as_it_is_closed(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    connected = asyncio.Event()

    async def publish(_: Telemetry) -> None:
        connected.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            raise OSError("disconnected unexpectedly") from None

    monkeypatch.setattr(Telemetry, "_publish", publish)
    async with publishing(free_port, lambda: {"tick": 1}) as task:
        await connected.wait()
        task.cancel()
        done, _ = await asyncio.wait({task}, timeout=PATIENCE_S)
        assert done


async def test_what_is_published_is_json_whatever_the_numbers(broker: "Serve", free_port: int) -> None:
    async with broker(free_port) as known, publishing(free_port, lambda: {"gamma": math.inf}):
        await until(lambda: known.retained("coldloop/plant/telemetry"), lambda now: now is not None)


@pytest.mark.usefixtures("realtime")
async def test_the_password_is_read_at_each_connection_and_is_not_in_the_configuration(
    frozen_broker: "ServeFrozen", free_port: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "password"
    login = {"username": "plant", "password_file": file}
    async with frozen_broker(free_port) as known:
        known.password = "schlüssel".encode()
        async with publishing(free_port, lambda: {"tick": 1}, **login):
            await until(lost(caplog), lambda reasons: any("No such file" in reason for reason in reasons))
            file.write_text("wrong", encoding="utf-8")
            await until(lost(caplog), lambda reasons: any("authori" in reason for reason in reasons))
            file.write_text("schlüssel\n", encoding="utf-8")
            await keeps(known, "coldloop/plant/state", ONLINE)
    assert "schlüssel" not in caplog.text + TelemetrySettings(**login).model_dump_json()


GIANT = b"\x30\xff\xff\xff\x7f\x00\x10coldloop/command" + bytes(10**6)
"""The beginning of a message of 256 MB."""
COMMANDS = 10_000 * b"\x30\x14\x00\x10coldloop/command{}"
UNASKED = b"\x62\x02\x00\x01"


@pytest.mark.parametrize("junk", [GIANT, COMMANDS, UNASKED, b"\xff\xff\xff\xff"])
async def test_a_broker_that_sends_what_nobody_asked_for_is_left_unread(
    free_port: int, start: "Start", junk: bytes
) -> None:
    taken: list[int] = []
    has_come_again = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1000)
        writer.write(b"\x20\x02\0\0")
        taken.append(0)
        if len(taken) > 3:
            has_come_again.set()
        try:
            while True:  # until the service has had enough
                writer.write(junk)
                await writer.drain()
                taken[-1] += len(junk)
        except ConnectionError:
            pass
        finally:
            writer.transport.abort()

    async with await asyncio.start_server(serve, "127.0.0.1", free_port):
        start("control_plc", "telemetry.broker=127.0.0.1", f"telemetry.port={free_port}", "telemetry.timeout_s=0.1")
        async with asyncio.timeout(60):
            await has_come_again.wait()  # as to any broker that was lost
    assert max(taken[:3]) < 16e6, "what fits into the buffers of the two systems, and no more"


def lost(caplog: pytest.LogCaptureFixture) -> Callable[[], Awaitable[list[str]]]:
    async def reasons() -> list[str]:
        return [str(getattr(record, "reason", "")) for record in caplog.records]

    return reasons


def test_a_password_without_a_name_is_refused() -> None:
    with pytest.raises(ValueError, match=r"telemetry\.username"):
        TelemetrySettings(password_file=Path("password"))
