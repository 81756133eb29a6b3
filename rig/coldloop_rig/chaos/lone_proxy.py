"""A stand-alone proxy in front of any Modbus/TCP server: disturbs the link by plan, in real time."""

import asyncio
from collections.abc import Callable

from coldloop.errors import UsageError
from coldloop.modbus.endpoints import Endpoint
from coldloop_rig.chaos.link_plan import LinkPlan
from coldloop_rig.chaos.proxy import LinkProxy


async def disturb(plan: LinkPlan, listen: tuple[str, int], target: Endpoint, say: Callable[[str], object]) -> None:
    """Pass frames on, under the faults of a plan, until it is cancelled.

    Args:
        plan: What goes wrong, and when.
        listen: Address and port to listen at.
        target: The server.
        say: Called with lines: where the proxy listens, faults that begin and end, refused connections.

    Raises:
        UsageError: It cannot listen there.
    """
    host, port = listen
    loop = asyncio.get_running_loop()
    proxy = LinkProxy(port, target, str(plan.seed), host=host, tell=say)
    try:
        await proxy.start()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UsageError(f"--listen {host}:{port}: {reason}; name an address and a free port of this machine") from None
    try:
        say(f"{host}:{proxy.port} -> {target.host}:{target.port}")
        began = loop.time()
        for change in plan.changes():
            await asyncio.sleep(began + change.at_s - loop.time())
            (proxy.begin if change.begins else proxy.end)(change.fault)
            say(f"{change.at_s:9.1f} s  {'begin' if change.begins else 'end'} {change.fault.in_words}")
        await loop.create_future()
    finally:
        await proxy.close()
