"""Telemetry to an MQTT broker, off unless one is configured. Control never waits for it.

Topics, under `prefix` (default `coldloop`):
    <prefix>/<service>/state      retained: {"state": "online"}; "offline" is the last will
    <prefix>/<service>/telemetry  retained: the newest snapshot as JSON, every `period_s` of real time
"""

import asyncio
import contextlib
import json
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

from coldloop.service.settings import TelemetrySettings

if TYPE_CHECKING:
    import aiomqtt

log = logging.getLogger("coldloop.service.telemetry")

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
            self._waiting.append(json.dumps(_finite(self._snapshot())))
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


def _finite(value: object) -> object:
    """Return the value with null for each number that JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    return value
