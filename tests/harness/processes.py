"""Programs that tests start: services, `coldloop`, Python. What is still running at the end of a test is killed."""

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from pydantic import BaseModel

from coldloop.config import PREFIX, to_environment
from coldloop_rig.cosim.wiring import ReservedPorts

END_S: Final = 60.0
"""A process that is told to end has failed when it takes longer; the machine may be busy with something else."""

PROGRAM_S: Final = 900.0
"""Longest time of a program given as lines of Python, s: kernels that are in no cache may have to be compiled."""


def environment(settings: BaseModel | None = None, more: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return the variables for a process: no configuration from outside, that of `settings`, and `more`."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith(PREFIX)}
    return {**outside, **(to_environment(settings) if settings else {}), **(more or {})}


class Ended(NamedTuple):
    """Exit code and output of a program that has ended."""

    code: int
    out: str
    err: str


class Process:
    """A program as a process. Its standard error goes to `log`, unless `stderr` says otherwise."""

    def __init__(
        self, words: Sequence[str], log: Path, *, port: int = 0, env: Mapping[str, str] | None = None,
        cwd: Path | None = None, stdout: int | None = None, stderr: int | None = None,
    ) -> None:  # fmt: skip
        self.log = log
        self.port = port
        with log.open("ab") as lines:
            self.popen = subprocess.Popen(
                words, env=environment() if env is None else env, cwd=cwd, stdin=subprocess.DEVNULL,
                stdout=lines if stdout is None else stdout, stderr=lines if stderr is None else stderr, text=True,
            )  # fmt: skip

    @property
    def alive(self) -> bool:
        return self.popen.poll() is None

    @property
    def said(self) -> str:
        """Text that it has written to its log so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def pause(self) -> None:
        self.popen.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self.popen.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        self.popen.kill()
        self.popen.wait()
        for pipe in (self.popen.stdout, self.popen.stderr):
            if pipe is not None:
                pipe.close()

    def ended(self, within_s: float = END_S) -> Ended:
        """Wait until it ends; return its exit code and what it has written to its pipes."""
        out, err = self.popen.communicate(timeout=within_s)
        return Ended(self.popen.returncode, out or "", err or "")

    def interrupt(self, number: signal.Signals = signal.SIGINT, within_s: float = END_S) -> int:
        """Send a signal; return the exit code."""
        self.popen.send_signal(number)
        return self.popen.wait(within_s)

    async def terminated(self, within_s: float = END_S) -> int:
        """Tell it to stop; return its exit code."""
        return await asyncio.to_thread(self.interrupt, signal.SIGTERM, within_s)


class Processes:
    """Starts programs; a service gets a port that nobody else gets, or that of the one it replaces.

    Args:
        folder: For their logs.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._ports: list[ReservedPorts] = []
        self._started: list[Process] = []

    def said_last(self, lines: int) -> str:
        """Return the last lines of each program's log, for who has to find out why a test failed."""
        logs = dict.fromkeys(one.log for one in self._started)
        return "\n".join(
            f"-- {log.name}\n" + "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-lines:])
            for log in logs
            if log.exists()
        )

    def free_port(self) -> int:
        """Return a port on localhost that nobody else gets while these processes live."""
        self._ports.append(ReservedPorts(1))
        return self._ports[-1].numbers[0]

    def three_ports(self) -> int:
        """Return the first of three ports in a row, as `coldloop up` takes them, that nobody else gets."""
        while True:
            first = self.free_port()
            try:
                self._ports.append(ReservedPorts(2, first + 1))
            except (OSError, OverflowError):  # taken by somebody else
                continue
            return first

    def service(
        self, name: str, *assignments: str, port: int | None = None, settings: BaseModel | None = None,
        level: str = "info", stderr: int | None = None,
    ) -> Process:  # fmt: skip
        """Start a service with a configuration and `--set` assignments to it; port 0 is any free one."""
        port = self.free_port() if port is None else port
        place = f"{name}.port" if name == "hmi" else f"{name}.server.port"
        chosen = [f"--set={text}" for text in (f"{place}={port}", *assignments)]
        words = [sys.executable, "-m", f"coldloop_{name}", "--log-level", level, *chosen]
        return self._start(words, f"{name}-{port}", port=port, env=environment(settings), stderr=stderr)

    def coldloop(
        self, *arguments: object, cwd: Path | None = None, stdout: int | None = None, stderr: int | None = None,
        more: Mapping[str, str] | None = None,
    ) -> Process:  # fmt: skip
        """Start `coldloop` with arguments."""
        words = [sys.executable, "-m", "coldloop_rig", *map(str, arguments)]
        return self._start(words, "coldloop", env=environment(more=more), cwd=cwd, stdout=stdout, stderr=stderr)

    def python(
        self, *arguments: str, stdout: int | None = None, stderr: int | None = None,
        more: Mapping[str, str] | None = None,
    ) -> Process:  # fmt: skip
        """Start an interpreter with arguments."""
        words = [sys.executable, *arguments]
        return self._start(words, "python", env=environment(more=more), stdout=stdout, stderr=stderr)

    def script(self, file: Path, *arguments: str, stdout: int | None = None, stderr: int | None = None) -> Process:
        """Start a program that is a file, with arguments."""
        return self._start([str(file), *arguments], file.name, stdout=stdout, stderr=stderr)

    def run_python(self, program: str) -> tuple[str, str]:
        """Run lines of Python to their successful end; return what they wrote on standard output and standard error."""
        code, out, err = self.python("-c", program, stdout=subprocess.PIPE, stderr=subprocess.PIPE).ended(PROGRAM_S)
        assert code == 0, err
        return out, err

    def _start(
        self, words: Sequence[str], name: str, *, port: int = 0, env: Mapping[str, str] | None = None,
        cwd: Path | None = None, stdout: int | None = None, stderr: int | None = None,
    ) -> Process:  # fmt: skip
        log = self._folder / f"{name}.log"
        if name in {"coldloop", "python"}:
            log = self._folder / f"{name}-{len(self._started)}.log"
        self._started.append(Process(words, log, port=port, env=env, cwd=cwd, stdout=stdout, stderr=stderr))
        return self._started[-1]

    def end(self) -> None:
        """Kill what still runs."""
        for process in self._started:
            with suppress(ProcessLookupError):
                process.kill()
        self._started.clear()
        for ports in self._ports:
            ports.release()
        self._ports.clear()
