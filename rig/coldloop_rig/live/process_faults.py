"""Faults of the processes of a rig that was started on this machine."""

import asyncio
import os
import signal
from contextlib import suppress

from coldloop.errors import UsageError
from coldloop_rig.live.process_identity import identity_of
from coldloop_rig.live.started_rigs import ServiceProcess, find_rig, no_rig


def process_of(first_port: int | None, service: str) -> ServiceProcess:
    """Return the process of a service of the rig on these ports, or of the only one.

    Raises:
        UsageError: No rig was started here, it has no such service, or that does not run at present.
    """
    rig = find_rig(first_port)
    if rig is None:
        raise no_rig(first_port)
    process = rig.services.get(service)
    if process is None:
        raise UsageError(f"the rig was started without an {service} service")
    if not _runs(process):
        raise UsageError(f"the {service} service does not run: `coldloop up` starts it again, or has given it up")
    return process


def kill(process: ServiceProcess) -> None:
    """End a process at once."""
    _signal(process, signal.SIGKILL)


async def pause(process: ServiceProcess, seconds: float) -> bool:
    """Suspend a process for a while; it is resumed in any case. Return whether it runs."""
    _signal(process, signal.SIGSTOP)
    try:
        await asyncio.sleep(seconds)
    finally:
        _signal(process, signal.SIGCONT)
    return _runs(process)


def _runs(process: ServiceProcess) -> bool:
    return process.identity == identity_of(process.pid)


def _signal(process: ServiceProcess, number: signal.Signals) -> None:
    """Send a signal, unless the process has ended meanwhile and another one may have its number."""
    if _runs(process):
        with suppress(ProcessLookupError):
            os.kill(process.pid, number)
