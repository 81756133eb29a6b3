"""Processes that need the same kernels at once: each is compiled once, and whoever ends in between harms nobody."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import pytest

PROGRAM = """
import sys
from numba import types
from numba.core import event
from coldloop.kernels.compiled import kernel
from coldloop.kernels.cache import kernels_of

@kernel
def inner(x):
    return x + 1

@kernel
def outer(x):
    return 2 * inner(x)

@kernel
def impossible(x):
    return x.nothing

class Compiled(event.Listener):
    def on_start(self, event):
        print("compiled", event.data["dispatcher"].__name__, flush=True)
    def on_end(self, event):
        pass

event.register("numba:compile", Compiled())
print("ready", flush=True)
for line in sys.stdin:
    with kernels_of("a test", 7):
        try:
            print("is", eval(line), flush=True)
        except Exception as error:
            print("raises", type(error).__name__, flush=True)
"""
LINE = "coldloop: compiling the kernels of a test; this takes about 7 s and happens once\n"


class Worker:
    """A process that evaluates what it is sent."""

    def __init__(self, program: Path, environment: dict[str, str]) -> None:
        pipe: Any = subprocess.PIPE
        self.process = subprocess.Popen(
            [sys.executable, program], env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdin is not None
        self.output, self.input = self.process.stdout, self.process.stdin
        assert self.output.readline() == "ready\n"

    def send(self, expression: str) -> None:
        self.input.write(f"{expression}\n")
        self.input.flush()

    def answer(self) -> tuple[list[str], str]:
        """Return what was compiled, and the last line."""
        compiled = []
        while (line := self.output.readline()).startswith("compiled"):
            compiled.append(line.split()[1])
        return compiled, line.strip()

    def end(self) -> str:
        """End it; return what it wrote on standard error."""
        return self.process.communicate()[1]


class Start(Protocol):
    """Starts a worker."""

    def __call__(self, **environment: str) -> Worker: ...


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    program = tmp_path / "some_kernels.py"
    program.write_text(PROGRAM)
    workers: list[Worker] = []

    def one(**environment: str) -> Worker:
        cache = {"COLDLOOP_CACHE_DIR": str(tmp_path / "cache"), **environment}
        workers.append(Worker(program, {**os.environ, **cache}))
        return workers[-1]

    yield one
    for worker in workers:
        worker.process.kill()
        worker.process.communicate()


@pytest.mark.usefixtures("programs")
def test_processes_that_need_a_kernel_at_once_compile_it_once_and_one_of_them_says_so(start: Start) -> None:
    workers = [start() for _ in range(3)]
    for worker in workers:
        worker.send("outer(1.5)")
    answers = [worker.answer() for worker in workers]
    assert [last for _, last in answers] == ["is 5.0"] * 3
    assert sorted(name for compiled, _ in answers for name in compiled) == ["inner", "outer"]
    assert sorted(worker.end() for worker in workers) == ["", "", LINE]


@pytest.mark.night
def test_kernels_for_different_types_that_are_compiled_at_once_are_kept_apart(start: Start) -> None:
    numbers, workers = ("1.5", "1", "1j"), [start() for _ in range(3)]
    for worker, number in zip(workers, numbers, strict=True):
        worker.send(f"outer({number})")
    assert [worker.answer()[1] for worker in workers] == ["is 5.0", "is 4", "is (2+2j)"]
    later = start()
    for number, answer in zip(numbers, ("is 5.0", "is 4", "is (2+2j)"), strict=True):
        later.send(f"outer({number})")
        assert later.answer() == ([], answer)
    assert not later.end()


@pytest.mark.night
def test_who_fails_to_compile_a_kernel_keeps_nobody_waiting(start: Start) -> None:
    first, second = start(), start()
    for worker in (first, second):
        worker.send("impossible(1.5)")
        assert worker.answer()[1] == "raises TypingError"
    first.send("outer(1.5)")
    assert first.answer()[1] == "is 5.0"


@pytest.mark.usefixtures("programs")
def test_the_kernel_of_a_process_that_is_killed_is_compiled_by_who_waits(start: Start) -> None:
    killed, waiting = start(), start()
    killed.send("outer._cache.load_overload((types.float64,), outer.targetctx)")  # which locks it
    assert killed.answer() == ([], "is None")
    waiting.send("outer(1.5)")
    killed.process.kill()
    assert waiting.answer() == (["outer", "inner"], "is 5.0")


@pytest.mark.usefixtures("programs")
def test_without_a_folder_to_write_to_kernels_are_compiled_all_the_same(start: Start, tmp_path: Path) -> None:
    occupied = tmp_path / "a file"
    occupied.touch()
    worker = start(COLDLOOP_CACHE_DIR=str(occupied), TMPDIR=str(tmp_path))
    worker.send("outer(1.5)")
    assert worker.answer() == (["outer", "inner"], "is 5.0")
    assert list(tmp_path.glob("coldloop-kernels-*"))


@pytest.mark.usefixtures("programs")
def test_an_edit_compiles_what_reaches_it_and_no_more(start: Start, tmp_path: Path) -> None:
    def compiled() -> list[str]:
        worker = start()
        worker.send("outer(1.5)")
        return worker.answer()[0]

    program = tmp_path / "some_kernels.py"
    assert compiled() == ["outer", "inner"]
    program.write_text("# a comment\n" + PROGRAM)
    os.utime(program, (1e9, 1e9))
    assert not compiled()
    program.write_text(PROGRAM.replace("2 * inner(x)", "3 * inner(x)"))
    assert compiled() == ["outer"]
    program.write_text(PROGRAM.replace("x + 1", "x + 2"))
    assert compiled() == ["outer", "inner"]
    program.write_text(PROGRAM)
    assert not compiled(), "what was compiled first one is still there"
