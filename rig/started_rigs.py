"""Rigs that were started on this machine: where they keep their state, their ports, how they are started and ended."""

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from coldloop.endpoints import CONTROL_PORT, OPTIMIZER_PORT, PLANT_PORT
from coldloop.errors import ColdloopError, UsageError
from rig.rig_endpoints import RigEndpoints

DEFAULT_PORTS: Final = (PLANT_PORT, CONTROL_PORT, OPTIMIZER_PORT)
STATE_FILE: Final = "rig.json"
"""What `coldloop down`, `status` and `set` know of a rig that is up: process, ports, certificates."""


LOOK_UP_S: Final = 0.05
"""Between two looks at the process of a rig."""


class RunningRig(NamedTuple):
    """A rig that was started on this machine."""

    pid: int
    ports: tuple[int, ...]
    tls: str
    """Folder of certificates that it was started with; empty when none."""

    @property
    def alive(self) -> bool:
        """Whether its process is there."""
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            return True
        return True


def state_folder(first_port: int) -> Path:
    """Return where a rig on these ports keeps its state and its logs."""
    base = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(base) / f"coldloop-{os.getuid()}-{first_port}"


def running_rig(first_port: int) -> RunningRig | None:
    """Return the rig that was started on these ports and is still there."""
    folder = state_folder(first_port)
    try:
        if folder.stat().st_uid != os.getuid():  # somebody else's, in a folder that all may write to
            return None
        content: dict[str, Any] = json.loads((folder / STATE_FILE).read_text(encoding="utf-8"))
        rig = RunningRig(int(content["pid"]), tuple(content["ports"]), str(content["tls"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return rig if rig.alive else None


def ports_from(base: int | None) -> tuple[int, ...]:
    """Return three ports in a row, or the usual ones."""
    return DEFAULT_PORTS if base is None else (base, base + 1, base + 2)


def check_ports(ports: Sequence[int]) -> None:
    """Refuse ports that are in use.

    Raises:
        UsageError: One is, and who could hold it.
    """
    for service, port in zip(RigEndpoints._fields, ports, strict=True):
        with socket.socket() as one:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                one.bind(("127.0.0.1", port))
            except OSError as error:
                raise UsageError(f"port {port} of the {service}: {error.strerror}; {_holder(ports[0])}") from None


def _holder(first_port: int) -> str:
    rig = running_rig(first_port)
    if rig is not None:
        return f"a rig is up here (process {rig.pid}): end it with `coldloop down`, or give another --port-base"
    return "a rig in containers, or another program (ss -ltnp names it): end it, or give another --port-base"


def detached(ports: Sequence[int]) -> int:
    """Start the same command in a process of its own; return its exit code, or 0 when the rig is up.

    Raises:
        ColdloopError: It has ended.
    """
    folder = state_folder(ports[0])
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    (folder / STATE_FILE).unlink(missing_ok=True)
    words = [word for word in sys.argv[1:] if word != "--detach"]
    output = folder / "up.log"
    with output.open("wb") as log:
        process = subprocess.Popen(  # noqa: S603 our own command
            [sys.executable, "-m", "rig", *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            start_new_session=True,
        )  # fmt: skip
    while process.poll() is None and not (folder / STATE_FILE).exists():
        time.sleep(LOOK_UP_S)
    if process.poll() is not None:
        lines = output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise ColdloopError((lines or ["the rig has ended"])[-1].removeprefix("coldloop: "))
    sys.stdout.write(output.read_text(encoding="utf-8"))
    return 0


def take_down(first_port: int, patience_s: float) -> int:
    """End the rig on these ports and wait for it; return its process.

    Raises:
        UsageError: There is none that was started here.
        ColdloopError: It does not end.
    """
    rig = running_rig(first_port)
    if rig is None:
        raise UsageError(f"no rig was started here on port {first_port}: `coldloop up` starts one")
    os.kill(rig.pid, signal.SIGTERM)
    deadline = time.monotonic() + patience_s
    while rig.alive:
        if time.monotonic() > deadline:
            raise ColdloopError(f"process {rig.pid} has not ended after {patience_s:g} s")
        time.sleep(LOOK_UP_S)
    return rig.pid
