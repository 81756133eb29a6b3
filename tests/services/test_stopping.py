"""A service stops when it is told to, whatever it is waiting for."""

import asyncio

from coldloop.modbus.client import RegisterClient
from tests.harness.records import PLANT_MAP

PATIENCE_S = 60.0


async def test_a_client_that_waits_for_its_peer_can_be_stopped_at_any_moment(free_port: int) -> None:
    """One that is deaf goes on connecting for its patience, and then fails: it ends, but is not cancelled."""
    deaf = []
    for steps in range(1, 25):
        client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=free_port, timeout_s=PATIENCE_S)
        connecting = asyncio.create_task(client.connect(patience_s=PATIENCE_S))
        for _ in range(steps):
            await asyncio.sleep(0)
        connecting.cancel()
        await asyncio.wait({connecting})
        if not connecting.cancelled():
            deaf.append(steps)
    assert not deaf, f"went on after being cancelled in these steps of the event loop: {deaf}"
