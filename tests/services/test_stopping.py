"""A service stops when it is told to, whatever it is waiting for."""

import asyncio

from coldloop.modbus.client import RegisterClient
from coldloop.registers.plant import PLANT_MAP


async def test_a_client_that_waits_for_its_peer_can_be_stopped_at_any_moment(free_port: int) -> None:
    deaf = []
    for steps in range(1, 25):
        client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=free_port, timeout_s=1.0)
        connecting = asyncio.create_task(client.connect(patience_s=30.0))
        for _ in range(steps):
            await asyncio.sleep(0)
        connecting.cancel()
        done, _ = await asyncio.wait({connecting}, timeout=0.1)
        if not done:
            deaf.append(steps)
            connecting.cancel()
            await asyncio.wait({connecting})
    assert not deaf, f"went on after being cancelled in these steps of the event loop: {deaf}"
