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
from typing import Final

from coldloop.mqtt_publisher import BrokerError, Login, MqttPublisher
from coldloop.telemetry_settings import TelemetrySettings

log = logging.getLogger("coldloop.telemetry")

FAREWELL_S: Final = 1.0
"""How long a service that ends waits for its broker."""
KEEPALIVE_S: Final = 60
"""Without a word for this time, and two periods, the broker publishes that the service is offline."""

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
            except Exception as error:  # noqa: BLE001 - a service never ends because of its telemetry
                log.warning(
                    "broker lost", extra={"broker": self._settings.broker, "reason": str(error) or "no answer in time"}
                )
            await asyncio.sleep(self._settings.timeout_s)

    async def _publish(self) -> None:
        s, state = self._settings, f"{self._topic}/state"
        online, offline = (json.dumps({"state": word}) for word in ("online", "offline"))
        login = Login(s.username, s.password(), state, offline, min(0xFFFF, KEEPALIVE_S + math.ceil(2 * s.period_s)))
        async with MqttPublisher.connected(s.broker, s.port, login, s.timeout_s) as broker:
            await broker.publish(state, online)
            try:
                await self._forward(broker)
            except asyncio.CancelledError:  # a clean end calls for no last will
                with contextlib.suppress(BrokerError, OSError, TimeoutError, EOFError):
                    async with asyncio.timeout(FAREWELL_S):
                        await broker.publish(state, offline)
                        await broker.disconnect()
                raise

    async def _forward(self, broker: MqttPublisher) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            while self._waiting:
                await broker.publish(f"{self._topic}/telemetry", self._waiting[0])
                self._waiting.popleft()


def _finite(value: object) -> object:
    """Return the value with null for each number that JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    return value
