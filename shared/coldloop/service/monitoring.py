"""Registers of a service for others: metrics for Prometheus, and telemetry to an MQTT broker.

Metrics go over HTTP: `GET /metrics` and `/healthz`, and nothing else. Each number is a gauge, named by service, block
and register; Prometheus' package is loaded where metrics are asked for.

coldloop_plant_measurement_y{element="T5"} 12.5

Telemetry is off unless a broker is configured. Control never waits for it. Topics, under `prefix` (default `coldloop`):
    <prefix>/<service>/state      retained: {"state": "online"}; "offline" is the last will
    <prefix>/<service>/telemetry  retained: the newest snapshot as JSON, every `period_s` of real time
"""

import asyncio
import contextlib
import json
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from coldloop import __version__, errors, text
from coldloop.registers.bank import RegisterBank
from coldloop.registers.declaration import Block
from coldloop.service.settings import MetricsSettings, TelemetrySettings

if TYPE_CHECKING:
    import aiomqtt
    from prometheus_client.core import Metric

log = logging.getLogger("coldloop.service.telemetry")


_NOT_IN_NAMES: Final = re.compile(r"[^a-zA-Z0-9_]+")


def gauge(name: str, description: str, values: float | Mapping[str, float], *, label: str = "") -> "Metric":
    """Return a gauge: one number, or one for each value of a label."""
    from prometheus_client.core import GaugeMetricFamily  # noqa: PLC0415 without metrics it is not loaded

    if not isinstance(values, Mapping):
        return GaugeMetricFamily(name, description, value=values)
    family = GaugeMetricFamily(name, description, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def build_family() -> "Metric":
    """Return the version of the program as a label of the number 1."""
    return gauge("coldloop_build_info", "Version of Coldloop", {__version__: 1.0}, label="version")


def block_families(service: str, block: Block, record: tuple[Any, ...]) -> Iterator["Metric"]:
    """Yield the registers of a record; texts are left out."""
    for (name, field), value in zip(block.fields.items(), record, strict=True):
        if field.is_text or name == "crc":
            continue
        unit = field.unit or (field.units[0] if len(set(field.units)) == 1 else "")
        description = f"{field.description} ({unit})" if unit else field.description
        values = dict(zip(field.elements, value, strict=True)) if field.elements else value
        yield gauge(metric_name(service, block.name, name), description, values, label="element")


def bank_families(bank: RegisterBank) -> Iterator["Metric"]:
    """Yield all registers of a service that are not rows of a table and that no client writes."""
    yield build_family()
    for block in bank.map.shown:
        if block.rows == 1 and block.writer is None:
            yield from block_families(bank.map.service, block, bank.get(block.record))


def metric_name(*parts: str) -> str:
    """Return a name of Prometheus made of these parts."""
    return _NOT_IN_NAMES.sub("_", "_".join(("coldloop", *parts))).lower()


def exposition(families: Iterable["Metric"]) -> bytes:
    """Return families in Prometheus' text format."""
    from prometheus_client import generate_latest  # noqa: PLC0415

    return generate_latest(SimpleNamespace(collect=lambda: families))


CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
LONGEST_REQUEST: Final = 4096
PATIENCE_S: Final = 2.0
"""Within this time a request is here, and its answer read."""
MOST_OPEN: Final = 16
"""Connections at a time; the oldest gives way. The service itself needs the others that the system allows."""
KEPT_S: Final = 0.2
"""An answer serves all who ask within this time: however many do, scans are not late because of them."""


class MetricsServer:
    """Answers one request a connection with the registers of a bank; port 0 is off."""

    def __init__(self, settings: MetricsSettings, bank: RegisterBank) -> None:
        self._settings = settings
        self._bank = bank
        self._open: dict[asyncio.StreamWriter, None] = {}  # the oldest first
        self._exposition = b""
        self._kept_until = 0.0

    async def run(self) -> None:
        """Serve until cancelled; return at once where it is off (PortInUseError: another program listens there)."""
        host, port = self._settings.host, self._settings.port
        if not port:
            return
        try:
            server = await asyncio.start_server(self._answer, host, port, limit=LONGEST_REQUEST, backlog=MOST_OPEN)
        except OSError as error:
            raise errors.PortInUseError(
                f"{host}:{port}: {error.strerror}; give another one to `metrics.port` of the service"
            ) from None
        async with server:
            await server.serve_forever()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._open) >= MOST_OPEN:
            oldest = next(iter(self._open))
            del self._open[oldest]
            oldest.transport.abort()
        self._open[writer] = None
        try:
            async with asyncio.timeout(PATIENCE_S):
                head = await reader.readuntil(b"\r\n\r\n")
                writer.write(self._response(head.partition(b"\r\n")[0].decode("latin-1").split(" ")))
                writer.close()
                await writer.wait_closed()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            log.debug("malformed request for metrics")
        finally:
            self._open.pop(writer, None)
            writer.transport.abort()

    def _response(self, line: list[str]) -> bytes:
        method, path = (line[0], line[1].partition("?")[0]) if len(line) > 1 else ("", "")
        if method != "GET":
            return _encoded("405 Method Not Allowed", b"only GET\n")
        if path == "/metrics":
            now = time.monotonic()
            if now >= self._kept_until:
                self._exposition, self._kept_until = exposition(bank_families(self._bank)), now + KEPT_S
            return _encoded("200 OK", self._exposition)
        if path == "/healthz":
            return _encoded("200 OK", b"live\n")
        return _encoded("404 Not Found", b"there are /metrics and /healthz\n")


def _encoded(status: str, body: bytes) -> bytes:
    lines = f"HTTP/1.1 {status}", f"Content-Type: {CONTENT_TYPE}", f"Content-Length: {len(body)}", "Connection: close"
    return "\r\n".join((*lines, "", "")).encode() + body


FAREWELL_S: Final = 1.0
"""How long a service that ends waits for its broker."""
LONGEST_ANSWER: Final = 2
"""Bytes after the header of what a broker sends to one who publishes: CONNACK and PUBACK of MQTT 3.1.1."""
UNASKED_BYTES: Final = 256
"""A broker may send so much between two messages of ours."""

Snapshot = Callable[[], Mapping[str, object]]


class Telemetry:
    """Publishes snapshots of one service."""

    def __init__(self, settings: TelemetrySettings, service: str, snapshot: Snapshot) -> None:
        self._settings = settings
        self._topic = f"{settings.prefix}/{service}"
        self._snapshot = snapshot
        self._waiting: deque[str] = deque(maxlen=settings.queue)
        self._arrived = asyncio.Event()

    async def run(self) -> None:
        """Sample and publish until cancelled; return at once when telemetry is off."""
        if not self._settings.broker:
            return
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._sample(), name="telemetry sampling")
            tasks.create_task(self._keep_publishing(), name="telemetry publishing")

    async def _sample(self) -> None:
        while True:
            self._waiting.append(text.finite_json(self._snapshot()))
            self._arrived.set()
            await asyncio.sleep(self._settings.period_s)

    async def _keep_publishing(self) -> None:
        while True:
            try:
                await self._publish()
            except Exception as error:  # a service never ends because of its telemetry
                if _is_cancelled():  # and the library has raised its own error instead
                    raise asyncio.CancelledError from error
                reason = str(error) or "no answer in time"
                log.warning("broker lost", extra={"broker": self._settings.broker, "reason": reason})
            await asyncio.sleep(self._settings.timeout_s)

    async def _publish(self) -> None:
        import aiomqtt  # noqa: PLC0415 a tenth of what a service loads at its start, and most have no broker

        s = self._settings
        offline = aiomqtt.Will(f"{self._topic}/state", json.dumps({"state": "offline"}), qos=1, retain=True)
        name = s.username or None
        client = aiomqtt.Client(
            s.broker, s.port, username=name, password=s.password(), will=offline, timeout=s.timeout_s
        )
        broker = _Publisher(client)
        async with client:
            await broker.publish(f"{self._topic}/state", json.dumps({"state": "online"}))
            try:
                while True:
                    await self._arrived.wait()
                    self._arrived.clear()
                    while self._waiting:
                        await broker.publish(f"{self._topic}/telemetry", self._waiting[0])
                        self._waiting.popleft()
            except asyncio.CancelledError:  # a clean end calls for no last will
                with contextlib.suppress(aiomqtt.MqttError, TimeoutError):
                    async with asyncio.timeout(FAREWELL_S):
                        await broker.publish(f"{self._topic}/state", str(offline.payload))
                raise


class _Publisher:
    """Publishes with a client that reads acknowledgements alone; anything else from the broker ends the connection.

    The client's library takes messages of up to 256 MB, as many as a broker sends, although nothing was subscribed to.
    """

    def __init__(self, client: "aiomqtt.Client") -> None:
        self._client = client
        self._unasked = UNASKED_BYTES
        library = client._client  # noqa: SLF001 it has no public limit
        self._receive = library._sock_recv  # noqa: SLF001
        library._sock_recv = self._limited  # type: ignore[method-assign] # noqa: SLF001

    async def publish(self, topic: str, message: str) -> None:
        self._unasked = UNASKED_BYTES
        await self._client.publish(topic, message, qos=1, retain=True)
        if _is_cancelled():  # wait_for of Python 3.11 forgets a cancellation that comes with the answer
            raise asyncio.CancelledError

    def _limited(self, bufsize: int) -> bytes:
        """Return at most `bufsize` bytes from the socket; the library takes the error for a lost connection."""
        if bufsize > LONGEST_ANSWER or self._unasked <= 0:
            raise ConnectionError("the broker sent an unexpected packet")
        data: bytes = self._receive(bufsize)
        self._unasked -= len(data)
        return data


def _is_cancelled() -> bool:
    """Return whether the current task is to end."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
