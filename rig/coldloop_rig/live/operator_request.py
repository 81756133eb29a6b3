"""What commands ask of a rig that is up, with the role of an operator."""

from collections.abc import Awaitable, Callable, Iterable
from contextlib import AsyncExitStack, nullcontext

from coldloop.errors import LinkError, RequestRefusedError
from coldloop.operating.execution import Clients, clients_of, connected, reason_of
from coldloop.process.declaration import Process
from coldloop_rig.cosim.answer_time import answered_in_time
from coldloop_rig.cosim.endpoints import RigEndpoints

Work = Callable[[Clients], Awaitable[str]]


async def ask(rig: RigEndpoints, process: Process, services: Iterable[str], work: Work, *, limited: bool = True) -> str:
    """Connect to the services of a request, carry it out, and return the result.

    Args:
        rig: Where it is.
        process: Which it runs.
        services: Which ones.
        work: Is given their clients, connected.
        limited: It may not take longer than a rig takes to answer.

    Raises:
        LinkError: A service is not there, refuses, or answers too late.
        UsageError: It is not possible now.
    """
    clients = clients_of({service: getattr(rig, service) for service in services}, process)
    async with AsyncExitStack() as stack:
        async with answered_in_time("to connect"):
            await stack.enter_async_context(connected(clients))
        async with answered_in_time("the command") if limited else nullcontext():
            try:
                return await work(clients)
            except RequestRefusedError as error:
                raise LinkError(reason_of(error)) from None
