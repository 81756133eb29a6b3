"""Rigs that were started on this machine: where they keep their state, their ports, how they are found and ended.

What others must neither read nor change is in a private folder: `coldloop` in `XDG_RUNTIME_DIR`, if that is a folder
of this user, or `coldloop-UID` in the folder for temporary files. Folders are used only if they belong to this user and
are closed to others, and are not links: another user may have made them first where everybody can write. Files are
opened without following links.
"""

import asyncio
import fcntl
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Annotated, Any, Final, NamedTuple, Self, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from coldloop.errors import ColdloopError, UsageError
from coldloop.modbus.settings import CONTROL_PORT, OPTIMIZER_PORT, PLANT_PORT
from coldloop.text import replace_file
from coldloop_rig import PYTHON, interruption
from coldloop_rig.cosim.wiring import REQUIRED, RigEndpoints

T = TypeVar("T", bound=tuple[Any, ...])
MOST_BYTES: Final = 65536
"""Size of a file about a rig, at most."""
DEFAULT_PORTS: Final = (PLANT_PORT, CONTROL_PORT, OPTIMIZER_PORT)
STATE_FILE: Final = "rig.json"
"""File from which `coldloop down`, `status` and `set` know a running rig: process, ports, certificates."""
LOCK_FILE: Final = "lock"
"""Locked by the process of a rig while it runs."""
LOOK_UP_S: Final = 0.05
"""Interval at which the process of a rig is polled, s."""
_HOLDER: Final = "a rig in containers, or another program (ss -ltnp names it): end it, or give another --port-base"


def base_folder() -> Path:
    """Return where the folders of all rigs of this user are; it need not be there."""
    runtime = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    if runtime.is_absolute() and runtime.is_dir() and runtime.stat().st_uid == os.getuid():
        return runtime / "coldloop"
    return Path(tempfile.gettempdir()) / f"coldloop-{os.getuid()}"


def make_private(folder: Path) -> Path:
    """Make a folder within one that exists, closed to others; return it.

    Raises:
        UsageError: It cannot be made, or its place is taken by a file of another user.
    """
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except FileExistsError:
        pass  # not a folder: said below
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; set XDG_RUNTIME_DIR to a folder of your own") from None
    if not is_private(folder):
        raise UsageError(
            f"{folder}: not a folder of this user alone (owner, mode 0700, no link); remove it, or set XDG_RUNTIME_DIR "
            "to a folder of your own"
        )
    return folder


def make_own_folder(name: str) -> Path:
    """Make a private folder of this name in the one of all rigs; return it.

    Raises:
        UsageError: It cannot be made, or belongs to another user.
    """
    return make_private(make_private(base_folder()) / name)


def is_private(folder: Path) -> bool:
    """Return whether something is a folder that belongs to this user and is closed to all others."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077


def read_own(file: Path) -> str:
    """Return the text of a small file in a private folder.

    Raises:
        OSError: It is not there, or cannot be read.
        ValueError: It is not a regular file of this user, is too large, or is not UTF-8 text.
    """
    with open(file, "rb", opener=_not_following) as content:
        status = os.fstat(content.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid():
            raise ValueError("not a file of this user")
        data = content.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise ValueError("too large")
    return data.decode("utf-8")


def new_own(file: Path) -> IO[bytes]:
    """Return a new file in a private folder, open for writing; what was there under its name is removed.

    Raises:
        OSError: It cannot be made.
    """
    file.unlink(missing_ok=True)
    return open(file, "xb", opener=_not_following)


def write_own(file: Path, text: str) -> None:
    """Write a file in a private folder, which appears whole; what was there under its name is replaced.

    Raises:
        OSError: It cannot be written.
    """
    try:
        replace_file(file, text.encode(), private=True, alone=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(file)) from None


def _not_following(path: str, flags: int) -> int:
    """Open without following a link, and without waiting for a pipe's other end."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, mode=0o600)


def identity_of(pid: int) -> str | None:
    """Return what no other process has that ever had or will have this number; None if none runs that has it.

    It is the boot and the time since it at which the process was started; without /proc that time, to the second.
    """
    if sys.platform != "linux":
        shown = subprocess.run(  # noqa: S603
            ["ps", "-o", "lstart=", "-p", str(pid)],  # noqa: S607 where it is differs
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        return shown.stdout.strip() or None
    try:
        status = Path(f"/proc/{pid}/stat").read_bytes()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return None
    fields = status.rpartition(b")")[2].split()  # the name before may have anything in it
    if fields[0] in (b"Z", b"X"):  # its state: has ended, and its parent has not noticed
        return None
    return f"{boot} {int(fields[19])}"


def parsed_as(kind: type[T], text: str, writer: str, *, strict: bool = False) -> T:
    """Return the named tuple of this kind that a JSON text has.

    Raises:
        ValueError: It is none; names what should have written it.
    """
    try:
        return kind(*TypeAdapter(kind).validate_json(text, strict=strict))
    except ValidationError:
        raise ValueError(f"not what {writer} writes") from None


Pid = Annotated[int, Field(gt=1, lt=2**31)]
Port = Annotated[int, Field(gt=0, lt=0x10000)]


class ServiceProcess(NamedTuple):
    """Process of a service."""

    pid: Pid
    identity: str
    """See `identity_of`."""

    @classmethod
    def of(cls, pid: int) -> Self:
        """Return the process that has this number now."""
        return cls(pid, identity_of(pid) or "")

    @property
    def runs(self) -> bool:
        """Whether it is there, and not another one that has its number."""
        return self.identity == identity_of(self.pid)

    def send(self, number: signal.Signals) -> None:
        """Send a signal, unless the process has ended meanwhile and another one may have its number."""
        if self.runs:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)


class RunningRig(NamedTuple):
    """A rig that was started on this machine."""

    pid: Pid
    identity: str
    """Identity of its process; see `identity_of`."""
    ports: Annotated[tuple[Port, ...], Field(min_length=3, max_length=3)]
    tls: Annotated[str, Field(pattern=r"\A[^\x00]*\z")]
    """Folder of certificates that it was started with; empty when none."""
    services: dict[str, ServiceProcess]
    """Services that were started, by name: the optimiser may be somebody else's."""
    cuttable: bool
    """Whether its links can be cut; see `coldloop_rig.live.up`."""

    @classmethod
    def write(cls, ports: Sequence[int], tls: str, services: Mapping[str, int], *, cuttable: bool) -> None:
        """Write the state file, by which commands find the rig that this process keeps up, and its services."""
        processes = {service: ServiceProcess.of(pid) for service, pid in services.items()}
        rig = cls(*ServiceProcess.of(os.getpid()), tuple(ports), tls, processes, cuttable)
        write_own(state_folder(ports[0]) / STATE_FILE, json.dumps(rig._asdict()) + "\n")

    @classmethod
    def parsed(cls, text: str) -> Self:
        """Return the rig that a state file describes.

        Raises:
            ValueError: It was not written by `coldloop up`, or by another version.
        """
        rig = parsed_as(cls, text, writer := "`coldloop up` of this version", strict=True)
        if not set(REQUIRED) <= rig.services.keys() <= set(RigEndpoints._fields):
            raise ValueError(f"not what {writer} writes")
        return rig

    @property
    def process(self) -> ServiceProcess:
        """Process of the rig itself."""
        return ServiceProcess(self.pid, self.identity)


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
    return rig if rig.process.runs else None


def rigs_up() -> list[RunningRig]:
    """Return the rigs that were started here and are still there.

    Raises:
        UsageError: There is none, and its record is damaged.
    """
    found: list[RunningRig | None] = []
    damaged: UsageError | None = None
    with suppress(OSError):
        for name in sorted(folder.name for folder in base_folder().iterdir()):
            if name.isascii() and name.isdecimal() and len(name) < len("100000"):
                try:
                    found.append(running_rig(int(name)))
                except UsageError as error:
                    damaged = error
    rigs = list(filter(None, found))
    if damaged is not None and not rigs:
        raise damaged
    return rigs


def find_rig(first_port: int | None) -> RunningRig | None:
    """Return the rig that was started here on these ports, or, without ports, the only one; None if there is none.

    Raises:
        UsageError: There are several, or its record is damaged.
    """
    if first_port is not None:
        return running_rig(first_port)
    found = rigs_up()
    if len(found) > 1:
        places = ", ".join(f"--port-base {rig.ports[0]} (process {rig.pid})" for rig in found)
        raise UsageError(f"{len(found)} rigs are up: choose one of {places}")
    return found[0] if found else None


def require_rig(first_port: int | None) -> RunningRig:
    """Return the rig that was started here on these ports, or, without ports, the only one.

    Raises:
        UsageError: There is none, there are several, or its record is damaged.
    """
    rig = find_rig(first_port)
    if rig is None:
        where = "" if first_port is None else f" on port {first_port}"
        raise UsageError(f"no rig started here is up{where}: `coldloop up` starts one")
    return rig


def lock_rig(first_port: int, inherited: int | None = None) -> int:
    """Keep a second rig from being started on the same ports; return a file that is locked until it is closed.

    Args:
        first_port: Of the rig.
        inherited: Descriptor of the file that another process has locked for this one.

    Raises:
        UsageError: A rig is up on these ports or is being started, or its folder is not ours.
    """
    file, descriptor = make_own_folder(str(first_port)) / LOCK_FILE, inherited
    if descriptor is None:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            descriptor = os.open(file, flags, mode=0o600)
        except OSError as error:
            raise UsageError(f"{file}: {error.strerror}; remove it") from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            raise UsageError(f"port {first_port}: {_holder(first_port)}, or give another --port-base") from None
    with suppress(OSError):  # our number, for those who come later; the disk may be full
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, str(os.getpid()).encode(), 0)
    return descriptor


def _holder(first_port: int) -> str:
    if (rig := running_rig(first_port)) is not None:
        return f"a rig is up here (process {rig.pid}): end it with `coldloop down`"
    try:
        number = int(read_own(state_folder(first_port) / LOCK_FILE))
    except (OSError, ValueError):
        return "a rig is being started here: wait for it"
    return f"a rig is being started here: wait for it, or end it (process {number})"


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


def require_listener(port: int) -> None:
    """Reject a port of this machine without a listener.

    Raises:
        UsageError: No rig was started here, and there is none in containers either.
    """
    try:
        socket.create_connection(("127.0.0.1", port), timeout=5.0).close()
    except OSError:
        raise UsageError(
            f"no rig is up: none was started here, and nothing listens on port {port}; `coldloop up` starts one, --rig "
            "says where another one is"
        ) from None


def detached(ports: Sequence[int], lock: int) -> int:
    """Start the same command in a background process; return 0 when the rig is up, 130 when Ctrl-C has ended it.

    Args:
        ports: Of the rig.
        lock: Descriptor of the lock, which the other process is to hold.

    Raises:
        ColdloopError: It has ended.
    """
    from coldloop_rig.cosim.networked_run import bound_log  # noqa: PLC0415 other commands start without it

    folder = state_folder(ports[0])
    output = folder / "up.log"
    ended_by: list[signal.Signals] = []
    with new_own(output) as log, interruption.INTERRUPTION.passed_to(ended_by.append):
        process = subprocess.Popen(  # noqa: S603 our own command
            [*PYTHON, "-m", "coldloop_rig", *sys.argv[1:], "--locked", str(lock)],
            stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, pass_fds=[lock],
        )  # fmt: skip
        bound_log(process.pid)
        while process.poll() is None and not ended_by:
            with suppress(UsageError):  # a file that another rig has left, until it is replaced
                if (rig := running_rig(ports[0])) is not None and rig.pid == process.pid:
                    break
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


def take_down(first_port: int | None, patience_s: float) -> int:
    """End a rig that was started here, on these ports or the only one, and wait for it; return its process.

    Raises:
        UsageError: There is none that was started here.
        ColdloopError: It does not end.
    """
    rig = require_rig(first_port)
    for number in (signal.SIGTERM, signal.SIGCONT):  # one that is stopped could not end
        rig.process.send(number)
    deadline = time.monotonic() + patience_s
    while rig.process.runs:
        if time.monotonic() > deadline:
            raise ColdloopError(f"process {rig.pid} has not ended after {patience_s:g} s")
        time.sleep(LOOK_UP_S)
    return rig.pid


def process_of(first_port: int | None, service: str) -> ServiceProcess:
    """Return the process of a service of the rig on these ports, or of the only one.

    Raises:
        UsageError: No rig was started here, it has no such service, or that does not run at present.
    """
    process = require_rig(first_port).services.get(service)
    if process is None:
        raise UsageError(f"the rig was started without an {service} service")
    if not process.runs:
        raise UsageError(f"the {service} service does not run: `coldloop up` starts it again, or has given it up")
    return process


async def pause(process: ServiceProcess, seconds: float) -> bool:
    """Suspend a process for a while; it is resumed in any case. Return whether it runs."""
    process.send(signal.SIGSTOP)
    try:
        await asyncio.sleep(seconds)
    finally:
        process.send(signal.SIGCONT)
    return process.runs
