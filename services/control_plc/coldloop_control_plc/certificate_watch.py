"""The alarm about certificates that must be renewed."""

import asyncio
import logging
from collections.abc import Callable, Sequence
from typing import Final

from coldloop.errors import ConfigurationError
from coldloop.modbus.settings import TlsSettings
from coldloop.registers.audit import EventKind
from coldloop.registers.safety import AlarmKind
from coldloop_control_plc.program import ControlProgram

log = logging.getLogger("coldloop.control_plc")

EXPIRES_SOON: Final = 1
"""Causes of the alarm CERTIFICATE."""
EXPIRED: Final = 2
UNREADABLE: Final = 3
PERIOD_S: Final = 3600.0
"""Between two looks at the certificates, in real time."""


class CertificateWatch:
    """Raises the alarm while a certificate has expired, or will soon.

    Args:
        certificates: Those of our server and of our client, with the days of warning.
        program: Whose alarm it is.
        show: Shows the alarms.
    """

    def __init__(self, certificates: Sequence[TlsSettings], program: ControlProgram, show: Callable[[], None]) -> None:
        self._certificates = certificates
        self._program = program
        self._show = show
        self._noted = 0

    async def run(self) -> None:
        """Look every hour, until cancelled."""
        while self._certificates:
            try:
                days = await asyncio.to_thread(self._days_of_those_to_renew)  # no scan waits for a disk
            except ConfigurationError as error:  # they may be being renewed: keep what was read at the start
                log.warning("certificates unreadable", extra={"reason": str(error)})
                self._program.alarms.raised(AlarmKind.CERTIFICATE, UNREADABLE)
            else:
                self._judge(days)
            self._show()
            await asyncio.sleep(PERIOD_S)

    def _days_of_those_to_renew(self) -> list[float]:
        from coldloop.modbus.tls import certificate_days_left  # noqa: PLC0415 not needed without TLS

        return [days for tls in self._certificates if (days := certificate_days_left(tls)) < tls.warn_days]

    def _judge(self, days: Sequence[float]) -> None:
        """Take the days that are left of those to be renewed."""
        least, program = min(days, default=0.0), self._program
        cause = (EXPIRED if least < 0.0 else EXPIRES_SOON) if days else 0
        program.alarms.report(AlarmKind.CERTIFICATE, condition=bool(days), cause=cause)
        if cause and cause != self._noted:
            program.journal.note(program.alarms.now, EventKind.CERTIFICATE, cause, value=least)
        self._noted = cause
