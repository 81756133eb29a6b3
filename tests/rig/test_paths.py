"""Each option that is a path, given what is no file or no folder: one line, in bounded memory, without waiting.

The options are those that the parsers declare; a new one needs a line here that leads a command to it.
"""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import Event, Thread
from typing import Final

import pytest

from coldloop_rig import PYTHON, cli
from tests.conftest import draw_nothing
from tests.harness.path_options import PathOption, path_options
from tests.harness.processes import environment

MOST_KB: Final = 500_000
EXAMPLES: Final = Path(__file__).parents[2] / "examples" / "processes"
LINES: Final = {
    line.partition(" ")[0]: line for line in (
        "run --in-process --load a --duration 2s --out OUT", "rerun RUN", "plot RUN", "report RUN --out OUT",
        "compare RUN RUN --out OUT.png", "export RUN --csv --out OUT", "chaos undisturbed --duration 5s --out OUT",
        "up", "down", "status", "set load 400", "fault kill plant", "record --out OUT", "page RUN", "events",
        "proxy PLAN --listen 1 --to 127.0.0.1:502", "certificates --out OUT", "new OUT",
        f"process {EXAMPLES}/quadruple_tank.toml --out OUT", "budget --plc siemens-s7-1511-1-pn", "model", "design",
        f"import {EXAMPLES}/quadruple_tank_record.csv --inputs v1 v2 --out OUT", "identify RUN", "exergy",
        "study periods --load a --out OUT", "reproduce --quick", "config",
    )
} | {
    "export --plc": "export plc --target c --ticks 200 --out OUT",
    "study --variants": "study compare --load a --out OUT",
}  # fmt: skip
"""Of each command a line with what it needs besides the option; a positional argument is its second word."""
OPTIONS: Final = [each for each in path_options() if each.name not in ("--config", "--tls") or each.command == ("run",)]


def words(option: PathOption, path: Path, run: Path) -> list[str]:
    """Return a line of the command with this option."""
    places = {"RUN": str(run), "OUT": str(path.with_name("out")), "OUT.png": str(path.with_name("out.png"))}
    line = [places.get(word, word) for word in LINES.get(str(option), LINES[option.command[0]]).split()]
    value = f"export:{path}" if option.use == "export" else str(path)
    if not option.name.startswith("--"):
        line[len(option.command)] = value
    elif option.name in line:
        line[line.index(option.name) + 1] = value
    else:
        line += [option.name, value]
    return [word for word in line if option.use != "export" or word != "--in-process"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        draw_nothing(monkeypatch)
        assert cli.main(["run", "--in-process", "--load", "a", "--duration", "20s", "--out", str(folder)]) == 0
    return folder


def sparse(place: Path) -> None:
    place.touch()
    os.truncate(place, 10 << 30)


KINDS: Final[dict[str, Callable[[Path], object]]] = {
    "folder": Path.mkdir, "FIFO": os.mkfifo, "10 GB": sparse, "device": lambda place: place.symlink_to("/dev/zero"),
    "grows": Path.touch,
}  # fmt: skip
GIVEN: Final = {
    "read": (*KINDS,), "name": (*KINDS,), "folder": ("folder", "FIFO", "device", "10 GB"),
    "export": ("folder", "FIFO", "device", "10 GB"), "write": ("folder", "FIFO"), "into": ("FIFO", "10 GB"),
}  # fmt: skip
"""A device is never named as something to write: a test that fails would replace it."""


@contextmanager
def growing(place: Path) -> Iterator[None]:
    """Let a file grow as long as something reads it."""
    done = Event()

    def grow() -> None:
        size = 0
        while not done.wait(0.001):
            size += 1 << 24
            os.truncate(place, min(size, 10 << 30))

    thread = Thread(target=grow)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.mark.night
@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize("option", OPTIONS, ids=str)
def test_what_is_no_file_is_one_line_in_bounded_memory(option: PathOption, tmp_path: Path, run: Path) -> None:
    for kind in GIVEN[option.use]:
        folder = tmp_path / kind
        folder.mkdir()
        place = folder / ("given.png" if option.use == "write" else "given")
        KINDS[kind](place)
        with growing(place) if kind == "grows" else nullcontext(), (folder / "said").open("w+") as said:
            process = subprocess.Popen(
                [*PYTHON, "-m", "coldloop_rig", *words(option, place, run)], cwd=folder, stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=said, env=environment(more={"XDG_RUNTIME_DIR": str(folder)}),
            )  # fmt: skip
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            said.seek(0)
            lines = [line for line in said.read().splitlines() if "compiling the kernels" not in line]
        assert (process.returncode in (1, 2), len(lines)) == (True, 1), (kind, lines)
        assert "given" in lines[0] or "no rig is up" in lines[0], (kind, lines)
        assert used.ru_maxrss < MOST_KB, kind
