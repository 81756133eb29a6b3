"""Rigs that were started on this machine: where they keep their state, their ports, how they are found and ended."""

import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from coldloop.errors import ColdloopError, UsageError
from coldloop.modbus.endpoints import CONTROL_PORT, OPTIMIZER_PORT, PLANT_PORT
from coldloop.parsing import parsed_json
from coldloop_rig.cosim.endpoints import REQUIRED, RigEndpoints
from coldloop_rig.interpreter import PYTHON
from coldloop_rig.interruption import INTERRUPTION
from coldloop_rig.live.private_folder import base_folder, is_private, make_own_folder, new_own, read_own, write_own
from coldloop_rig.live.process_identity import identity_of

DEFAULT_PORTS: Final = (PLANT_PORT, CONTROL_PORT, OPTIMIZER_PORT)
STATE_FILE: Final = "rig.json"
"""What `coldloop down`, `status` and `set` know of a rig that is up: process, ports, certificates."""
LOCK_FILE: Final = "lock"
"""Locked by the process of a rig while it runs."""
LOOK_UP_S: Final = 0.05
"""Between two looks at the process of a rig."""
ANSWER_S: Final = 5.0
"""How long a connection to a port of this machine may take."""


class ServiceProcess(NamedTuple):
    """Process of a service."""

    pid: int
    identity: str
    """See `coldloop_rig.live.process_identity`."""

    @classmethod
    def of(cls, pid: int) -> Self:
        """Return the process that has this number now."""
        return cls(pid, identity_of(pid) or "")

    @classmethod
    def parsed(cls, content: Any) -> Self:  # noqa: ANN401 any JSON
        """Return the process that a state file names.

        Raises:
            ValueError: It names none.
        """
        process = cls(*content)
        if type(process.pid) is not int or not 1 < process.pid < 2**31 or not isinstance(process.identity, str):
            raise ValueError("its process id is invalid")
        return process


class RunningRig(NamedTuple):
    """A rig that was started on this machine."""

    pid: int
    identity: str
    """Of its process; see `coldloop_rig.live.process_identity`."""
    ports: tuple[int, ...]
    tls: str
    """Folder of certificates that it was started with; empty when none."""
    services: dict[str, ServiceProcess]
    """Those that were started: an optimiser may be somebody else's."""
    cuttable: bool
    """Whether its links can be cut; see `coldloop_rig.live.link_cuts`."""

    @classmethod
    def of_this_process(cls, ports: Sequence[int], tls: str, services: Mapping[str, int], *, cuttable: bool) -> Self:
        """Return the rig that this process keeps up, with the processes of its services."""
        processes = {service: ServiceProcess.of(pid) for service, pid in services.items()}
        return cls(*ServiceProcess.of(os.getpid()), tuple(ports), tls, processes, cuttable)

    def write(self) -> None:
        """Write the state file, from which commands know of this rig."""
        write_own(state_folder(self.ports[0]) / STATE_FILE, json.dumps(self._asdict()) + "\n")

    @classmethod
    def parsed(cls, text: str) -> Self:
        """Return the rig that a state file describes.

        Raises:
            ValueError: It was not written by `coldloop up`, or by another version.
        """
        try:
            content: dict[str, Any] = parsed_json(text)
            own = ServiceProcess.parsed([content["pid"], content["identity"]])
            services = {
                service: ServiceProcess.parsed(content["services"][service])
                for service in RigEndpoints._fields
                if service in REQUIRED or service in content["services"]
            }
            rig = cls(*own, tuple(content["ports"]), content["tls"], services, content["cuttable"] is True)
        except (ValueError, KeyError, TypeError):
            raise ValueError("not what `coldloop up` of this version writes") from None
        ports_fit = len(rig.ports) == len(DEFAULT_PORTS) and all(
            type(port) is int and 0 < port < 0x10000 for port in rig.ports
        )
        if not ports_fit or not isinstance(rig.tls, str) or "\0" in rig.tls:
            raise ValueError("a port or a folder in it is invalid")
        return rig

    @property
    def alive(self) -> bool:
        """Whether its process is there, and not another one that has its number."""
        return self.identity == identity_of(self.pid)

    @property
    def place(self) -> str:
        """Options that select this rig."""
        return f"--port-base {self.ports[0]} (process {self.pid})"


# -- where they keep their state ---------------------------------------------------------------------------------------


def state_folder(first_port: int) -> Path:
    """Return where a rig on these ports keeps its state and its logs."""
    return base_folder() / str(first_port)


def running_rig(first_port: int) -> RunningRig | None:
    """Return the rig that was started on these ports and is still there.

    Raises:
        UsageError: Its record is damaged.
    """
    folder = state_folder(first_port)
    if not (is_private(folder.parent) and is_private(folder)):  # another user's, where all may write
        return None
    file = folder / STATE_FILE
    try:
        rig = RunningRig.parsed(read_own(file))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UsageError(f"{file}: {reason}; remove it, and end what is left of the rig by its process") from None
    return rig if rig.alive else None


def rigs_up() -> list[RunningRig]:
    """Return the rigs that were started here and are still there.

    Raises:
        UsageError: There is none, and its record is damaged.
    """
    found: list[RunningRig] = []
    damaged: UsageError | None = None
    with suppress(OSError):
        for name in sorted(folder.name for folder in base_folder().iterdir()):
            if not (name.isascii() and name.isdecimal() and len(name) < len("100000")):
                continue
            try:
                rig = running_rig(int(name))
            except UsageError as error:
                damaged = error
                continue
            if rig is not None:
                found.append(rig)
    if damaged is not None and not found:
        raise damaged
    return found


def find_rig(first_port: int | None) -> RunningRig | None:
    """Return the rig that was started here on these ports, or, without ports, the only one; None if there is none.

    Raises:
        UsageError: There are several, or its record is damaged.
    """
    if first_port is not None:
        return running_rig(first_port)
    found = rigs_up()
    if len(found) > 1:
        raise UsageError(f"{len(found)} rigs are up: choose one of {', '.join(rig.place for rig in found)}")
    return found[0] if found else None


def no_rig(first_port: int | None) -> UsageError:
    """Return the message if `find_rig` finds none."""
    where = "" if first_port is None else f" on port {first_port}"
    return UsageError(f"no rig started here is up{where}: `coldloop up` starts one")


class RigLock:
    """Keeps a second rig from being started on the same ports; an open file that is locked until it is closed.

    Args:
        first_port: Of the rig.
        inherited: Descriptor of the file that another process has locked for this one.

    Raises:
        UsageError: A rig is up on these ports or is being started, or its folder is not ours.
    """

    def __init__(self, first_port: int, inherited: int | None = None) -> None:
        folder = make_own_folder(str(first_port))
        if inherited is not None:
            self.descriptor = inherited
            self._sign()
            return
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            self.descriptor = os.open(folder / LOCK_FILE, flags, mode=0o600)
        except OSError as error:
            raise UsageError(f"{folder / LOCK_FILE}: {error.strerror}; remove it") from None
        try:
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self.descriptor)
            raise UsageError(f"port {first_port}: {self._holder(first_port)}, or give another --port-base") from None
        self._sign()

    def _sign(self) -> None:
        """Leave our number, for those who come later."""
        with suppress(OSError):  # the disk may be full
            os.ftruncate(self.descriptor, 0)
            os.pwrite(self.descriptor, str(os.getpid()).encode(), 0)

    @staticmethod
    def _holder(first_port: int) -> str:
        rig = running_rig(first_port)
        if rig is not None:
            return f"a rig is up here (process {rig.pid}): end it with `coldloop down`"
        try:
            number = int(read_own(state_folder(first_port) / LOCK_FILE))
        except (OSError, ValueError):
            return "a rig is being started here: wait for it"
        return f"a rig is being started here: wait for it, or end it (process {number})"


# -- ports -------------------------------------------------------------------------------------------------------------


def ports_from(base: int | None) -> tuple[int, ...]:
    """Return three ports in a row, or the usual ones."""
    return DEFAULT_PORTS if base is None else (base, base + 1, base + 2)


def check_ports(ports: Sequence[int]) -> None:
    """Refuse ports that are in use, or that only an administrator may use.

    Raises:
        UsageError: One is, and who could hold it.
    """
    for service, port in zip(RigEndpoints._fields, ports, strict=True):
        with socket.socket() as one:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                one.bind(("127.0.0.1", port))
            except OSError as error:
                remedy = "give a --port-base from 1024 on" if isinstance(error, PermissionError) else _HOLDER
                raise UsageError(f"port {port} of the {service}: {error.strerror}; {remedy}") from None


_HOLDER: Final = "a rig in containers, or another program (ss -ltnp names it): end it, or give another --port-base"


def require_listener(port: int) -> None:
    """Reject a port of this machine without a listener.

    Raises:
        UsageError: No rig was started here, and there is none in containers either.
    """
    try:
        socket.create_connection(("127.0.0.1", port), ANSWER_S).close()
    except OSError:
        raise UsageError(
            f"no rig is up: none was started here, and nothing listens on port {port}; `coldloop up` starts one, --rig "
            "says where another one is"
        ) from None


# -- start and end -----------------------------------------------------------------------------------------------------


def detached(ports: Sequence[int], lock: RigLock) -> int:
    """Start the same command in a background process; return 0 when the rig is up, 130 when Ctrl-C has ended it.

    Args:
        ports: Of the rig.
        lock: Which the other process is to hold.

    Raises:
        ColdloopError: It has ended.
    """
    from coldloop_rig.cosim.local_services import bound_log  # noqa: PLC0415 other commands start without it

    folder = state_folder(ports[0])
    output = folder / "up.log"
    ended_by: list[signal.Signals] = []
    with new_own(output) as log, INTERRUPTION.passed_to(ended_by.append):
        process = subprocess.Popen(  # noqa: S603 our own command
            [*PYTHON, "-m", "coldloop_rig", *sys.argv[1:], "--locked", str(lock.descriptor)],
            stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, pass_fds=[lock.descriptor],
        )  # fmt: skip
        bound_log(process.pid)
        while process.poll() is None and not (ended_by or _is_up(ports[0], process.pid)):
            time.sleep(LOOK_UP_S)
        if ended_by:
            process.terminate()
            process.wait()
            return 128 + ended_by[0]
    if process.poll() is not None:
        lines = output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise ColdloopError((lines or ["the rig has ended"])[-1].removeprefix("coldloop: "))
    sys.stdout.write(output.read_text(encoding="utf-8"))
    return 0


def _is_up(first_port: int, pid: int) -> bool:
    try:
        rig = running_rig(first_port)
    except UsageError:  # what another one has left, until it is replaced
        return False
    return rig is not None and rig.pid == pid


def take_down(first_port: int | None, patience_s: float) -> int:
    """End a rig that was started here, on these ports or the only one, and wait for it; return its process.

    Raises:
        UsageError: There is none that was started here.
        ColdloopError: It does not end.
    """
    rig = find_rig(first_port)
    if rig is None:
        raise no_rig(first_port)
    with suppress(ProcessLookupError):
        for number in (signal.SIGTERM, signal.SIGCONT):  # one that is stopped could not end
            os.kill(rig.pid, number)
    deadline = time.monotonic() + patience_s
    while rig.alive:
        if time.monotonic() > deadline:
            raise ColdloopError(f"process {rig.pid} has not ended after {patience_s:g} s")
        time.sleep(LOOK_UP_S)
    return rig.pid
