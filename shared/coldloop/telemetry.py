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
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator

if TYPE_CHECKING:
    import aiomqtt

log = logging.getLogger("coldloop.telemetry")

FAREWELL_S = 1.0
"""How long a service that ends waits for its broker."""

Snapshot = Callable[[], Mapping[str, object]]


class TelemetrySettings(BaseModel):
    """Where to publish to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    broker: str = ""
    """Host of the broker; empty is off."""
    port: Annotated[int, Field(ge=1, le=65535)] = 1883
    username: str = ""
    """Name at the broker; empty is a broker that asks for none."""
    password_file: Path | None = None
    """File that holds the password for it, on one line. It is read at each connection; without TLS it is sent as it
    is, so this is for a network of its own."""
    prefix: Annotated[str, Field(pattern=r"^[^#+]+$")] = "coldloop"
    period_s: PositiveFloat = 1.0
    """Real time between snapshots."""
    queue: Annotated[int, Field(ge=1)] = 100
    """Snapshots kept while the broker is away; the oldest go first."""
    timeout_s: PositiveFloat = 5.0

    @model_validator(mode="after")
    def _password_belongs_to_a_name(self) -> Self:
        if self.password_file and not self.username:
            raise ValueError("a password needs a name: set telemetry.username")
        return self

    def password(self) -> str | None:
        """Return the password; None is none.

        Raises:
            OSError: The file cannot be read.
        """
        if self.password_file is None:
            return None
        return self.password_file.read_text(encoding="utf-8").rstrip("\r\n")


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
            except Exception as error:  # noqa: BLE001 - a service never ends because of its telemetry
                log.warning("broker lost", extra={"broker": self._settings.broker, "reason": str(error)})
            await asyncio.sleep(self._settings.timeout_s)

    async def _publish(self) -> None:
        import aiomqtt  # noqa: PLC0415 a tenth of what a service loads at its start, and most have no broker

        s = self._settings
        offline = aiomqtt.Will(f"{self._topic}/state", json.dumps({"state": "offline"}), qos=1, retain=True)
        name = s.username or None
        async with aiomqtt.Client(
            s.broker, s.port, username=name, password=s.password(), will=offline, timeout=s.timeout_s
        ) as client:
            await client.publish(f"{self._topic}/state", json.dumps({"state": "online"}), qos=1, retain=True)
            try:
                await self._forward(client)
            except asyncio.CancelledError:  # a clean end calls for no last will
                with contextlib.suppress(aiomqtt.MqttError, TimeoutError):
                    async with asyncio.timeout(FAREWELL_S):
                        await client.publish(f"{self._topic}/state", offline.payload, qos=1, retain=True)
                raise

    async def _forward(self, client: "aiomqtt.Client") -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            while self._waiting:
                await client.publish(f"{self._topic}/telemetry", self._waiting[0], qos=1, retain=True)
                self._waiting.popleft()


def _finite(value: object) -> object:
    """Return the value with null for each number that JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    return value
