"""What README and docs tell a reader to type is executed: each block in a folder of its own, or a page in its order.

A block of `sh`, `console` or `python` that is not executed here says so in a comment in front of it, with the reason.
"""

import asyncio
import io
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import pytest

from coldloop.modbus.client import RegisterClient
from coldloop.registers.control_plc import LadderStatus, Mode
from coldloop_rig import cli
from tests.conftest import Coldloop, draw_nothing
from tests.harness.processes import Process, Processes
from tests.harness.records import CONTROL_MAP

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?:^<!-- (?P<marker>.*?) -->\n)?^```(?P<language>sh|console|python)\n(?P<text>.*?)^```"
    r"(?:\n\n```text\n(?P<printed>.*?)^```)?",
    re.MULTILINE | re.DOTALL,
)
PATIENCE_S = 900.0
"""The first run on a machine compiles the kernels, and others may keep it busy."""
NOT_EXECUTED = "not executed: "
TEST_SUITE = "executed: as a test suite"

SHORTENED = {
    r"^coldloop run(?!.*--(attach|duration))": r"coldloop run --duration 10s",
    r"^(coldloop run(?!.*--attach|.*my_load).*)--duration \S+": r"\1--duration 10s",
    r"^coldloop chaos (kill|freeze)": r"coldloop chaos short_plan.toml",
    r"^(coldloop chaos .*)--duration \S+": r"\1--duration 20s",
    r"^(coldloop --process \S+ run)": r"\1 --duration 10s",
    r"^scripts/run": r"scripts/run --duration 10s",
    r"^scripts/test\b": r"scripts/test --help",
}
"""What is executed instead of what the pages say, so that it takes seconds; the tutorial's own load is run whole."""
IN_ONE_PROCESS = {r"^coldloop run(?!.*--(in-process|attach|mode|config))": "coldloop run --in-process"}
"""And but for the night, where no way to run is named: three processes leave the same, and take longer to start."""

AT_NIGHT = r"^coldloop (export plc|budget --plc|run --mode realtime)"
"""What takes long is left to the night; tests/plc_export, tests/rig/test_plc_profile.py and test_real_time.py do it."""

IN_ORDER = {"README.md", "commands.md", "tutorial.md", "tutorial-plc.md", "tutorial-rule.md"}
"""Pages whose blocks need what the blocks before them have left, and nothing else but the files of a reader."""

NEEDS_A_RIG = re.compile(r"127\.0\.0\.1:502|port=502|coldloop (status|set|events|fault|record)|mbpoll")
STARTS_A_RIG = re.compile(r"^(coldloop |scripts/)up\b", re.MULTILINE)
READ_FIRST = {"README.md", "tutorial.md"}
BY_THE_CLOCK = re.compile(r"realtime|(coldloop |scripts/)up\b")

OWN_INTERPRETER = "--process"
"""Commands with it are of another process than this interpreter's."""
FOLLOWS = "--follow"
"""Commands with it are read until their first line, and then interrupted."""

PLAN = """name = "short"
description = "The optimiser's link is slow"
load = "a"
duration_s = 20
seed = 1

[[faults]]
kind = "delay"
link = "optimizer"
at_s = 5
duration_s = 5
delay_ms = 1
"""


BEGIN = datetime(2026, 3, 2, 6, tzinfo=timezone(timedelta(hours=1)))
"""Of what a historian has recorded."""


class Example(NamedTuple):
    """A block of a page."""

    marker: str
    language: str
    text: str
    line: int
    printed: str | None
    """What the page says that it prints; None where it says nothing."""

    @property
    def commands(self) -> list[str]:
        """The commands of a block of `sh`, without comments."""
        return [shlex.join(words) for line in self.text.splitlines() if (words := shlex.split(line, comments=True))]


class Lesson(NamedTuple):
    """Blocks of a page that are executed one after the other."""

    page: Path
    blocks: tuple[Example, ...]

    @property
    def needs_a_rig(self) -> bool:
        """Whether a rig is to be up that the blocks do not start."""
        first = self.blocks[0]
        return bool(NEEDS_A_RIG.search(first.text)) and not STARTS_A_RIG.search(first.text)

    def leaves(self) -> set[str]:
        """Return the names of the runs that the blocks make themselves."""
        return {name for each in self.blocks for name in re.findall(r"--out runs/(\w+)", each.text)}

    def says(self, pattern: str | re.Pattern[str]) -> bool:
        return any(re.search(pattern, each.text) for each in self.blocks)


def examples(page: Path) -> list[Example]:
    text = page.read_text(encoding="utf-8")
    return [
        Example(
            found["marker"] or "",
            found["language"],
            found["text"],
            text.count("\n", 0, found.start("text")),
            found["printed"],
        )
        for found in BLOCK.finditer(text)
    ]


def lessons(page: Path) -> list[Lesson]:
    """Return what is executed of a page; a rig that is up is shared by all pages, so what needs it stands alone."""
    alone = [Lesson(page, (each,)) for each in examples(page) if not each.marker.startswith(NOT_EXECUTED)]
    if page.name not in IN_ORDER:
        return alone
    rest = tuple(each.blocks[0] for each in alone if not each.needs_a_rig)
    return [Lesson(page, rest), *(each for each in alone if each.needs_a_rig)]


def shortened(command: str, *, whole: bool = False) -> str:
    for pattern, replacement in {**SHORTENED, **({} if whole else IN_ONE_PROCESS)}.items():
        command = re.sub(pattern, replacement, command)
    return command


def historian_export() -> str:
    """Return the record of the tank as a historian writes it: tags, dates, decimal commas; some readings are bad."""
    record = (ROOT / "examples" / "processes" / "quadruple_tank_record.csv").read_text(encoding="utf-8")
    lines = ["Zeitstempel;P101.SP;P102.SP;FI7.SP;LT1.PV;LT2.PV;Quality"]
    for k, row in enumerate(record.splitlines()[1:]):
        seconds, *cells = row.split(",")
        stamp = (BEGIN + timedelta(seconds=float(seconds))).isoformat()
        lines.append(";".join([stamp, *(cell.replace(".", ",") for cell in cells), "192" if k % 97 != 50 else "0"]))
    return "\r\n".join(lines) + "\r\n"


class Reader:
    """Does what a page says, in a folder with the files that pages take as given.

    Args:
        folder: The current one.
        coldloop: The command.
        processes: Starts programs.
        whole: As much as the page says, if it takes no longer than seconds.
    """

    def __init__(self, folder: Path, coldloop: Coldloop, processes: Processes, *, whole: bool = False) -> None:
        self._folder = folder
        self._coldloop = coldloop
        self._processes = processes
        self._whole = whole
        self._runs = 0
        (folder / "short_plan.toml").write_text(PLAN)
        (folder / "my_plan.toml").write_text(PLAN)
        for name, example in (("my_box", "smaller_turbine"), ("efficient_refrigerator", "efficient_refrigerator")):
            (folder / f"{name}.toml").write_bytes((ROOT / "examples" / f"{example}.toml").read_bytes())
        (folder / "export.csv").write_text(historian_export())
        record = (ROOT / "examples" / "processes" / "quadruple_tank_record.toml").read_text(encoding="utf-8")
        (folder / "tank.toml").write_text(record.replace("quadruple_tank_record.csv", "record.csv"), encoding="utf-8")
        for name, watts in (("my_hours.csv", 400), ("another.csv", 370)):
            (folder / name).write_text(f"time_s,load_w\n0,384\n5,{watts}\n")

    def follow(self, lesson: Lesson, base: int | None = None) -> None:
        """Execute all blocks; `base` is the first port of a rig that is up."""
        names: dict[str, object] = {"__name__": "__main__"}
        for each in lesson.blocks:
            if each.marker == TEST_SUITE:
                self._test_suite(each)
            elif each.language == "python":
                with redirect_stdout(io.StringIO()) as printed:
                    text = each.text if base is None else re.sub(r"port=502(\d)", f"port={base}+\\1", each.text)
                    exec(compile("\n" * each.line + text, str(lesson.page), "exec"), names)  # noqa: S102 our own page
                assert each.printed in {None, printed.getvalue()}
            else:
                printed = self._execute(each.commands, base)
                if self._whole and each.printed is not None:
                    assert each.printed in printed

    def _execute(self, commands: list[str], base: int | None) -> str:
        """Return what commands of ours have printed."""
        printed = ""
        with ExitStack() as rigs:
            for command in commands:
                if STARTS_A_RIG.search(command):
                    base = rigs.enter_context(self._up(command))
                else:
                    printed += self._run(_on_ports(shortened(command, whole=self._whole), base))
        return printed

    def _run(self, command: str) -> str:
        words = shlex.split(command)
        if ">" in words:
            (self._folder / words[-1]).write_text(self._run(shlex.join(words[:-2])), encoding="utf-8")
        elif FOLLOWS in words:
            self._read_first_line(words)
        elif not self._whole and re.search(AT_NIGHT, command):
            return ""
        elif words[0] == "coldloop" and OWN_INTERPRETER not in words:
            if words[1] == "run" and "--out" not in words:  # names of folders that are chosen have seconds only
                self._runs += 1
                words += ["--out", f"runs/run-{self._runs}"]
            outcome = self._coldloop(*words[1:])
            assert outcome.code == 0, (command, outcome.complaints)
            return str(outcome.out)
        elif words[0].startswith("scripts/") or OWN_INTERPRETER in words:
            ended = self._started(words).ended(PATIENCE_S)
            assert ended.code == 0, (command, ended)
            return str(ended.out)
        else:
            if words[0] == "mbpoll":
                words[1:1] = ["-o", "10"]  # s; a busy machine may need more than its usual one
            done = subprocess.run(words, check=False, stdin=subprocess.DEVNULL, capture_output=True, text=True)
            assert done.returncode == 0, (command, done.stdout[-2000:], done.stderr[-2000:])
            if words[0] == "mbpoll":
                assert re.search(r"\[\d+\]: \t[\d.]+|Written 1 references", done.stdout), done.stdout
            return done.stdout
        return ""

    def _started(self, words: list[str]) -> Process:
        program, *arguments = words
        if program == "coldloop":
            return self._processes.coldloop(*arguments, stdout=subprocess.PIPE)
        return self._processes.script(ROOT / program, *arguments, stdout=subprocess.PIPE)

    @contextmanager
    def _up(self, command: str) -> Iterator[int]:
        """Keep a rig up; its first port is not that of the page."""
        base = self._processes.three_ports()
        rig = self._started([*shlex.split(command), "--port-base", str(base)])
        wait_until_up(rig, base)
        yield base
        assert rig.interrupt() in {0, 130}

    def _read_first_line(self, words: list[str]) -> None:
        follower = self._started(words)
        assert follower.popen.stdout is not None
        assert follower.popen.stdout.readline().strip()
        assert follower.interrupt() in {0, 130}

    def _test_suite(self, example: Example) -> None:
        """Run a block as somebody else's test suite, which knows Coldloop as an installed package only."""
        suite = self._folder / "somebody_elses_project"
        suite.mkdir()
        (suite / "test_with_coldloop.py").write_text(example.text, encoding="utf-8")
        words = ("-m", "pytest", "-p", "no:cacheprovider", "--rootdir", str(suite), str(suite))
        ended = self._processes.python(*words, stdout=subprocess.PIPE).ended(PATIENCE_S)
        assert ended.code == 0, ended.out
        assert f"{example.text.count('def test_')} passed" in ended.out


def _on_ports(command: str, base: int | None) -> str:
    """Return a command for the rig at other ports than the page's."""
    if base is None:
        return command
    for place in range(3):
        command = re.sub(rf"(127\.0\.0\.1:|-p )502{place}\b", rf"\g<1>{base + place}", command)
    return re.sub(r"^coldloop (status|set|fault|record|events(?= --| *$))", rf"coldloop \1 --port-base {base}", command)


def wait_until_up(rig: Process, base: int) -> None:
    """Wait until a rig says that it is up, and its session has begun: what an operator says before does not count."""
    assert rig.popen.stdout is not None
    assert next((line for line in rig.popen.stdout if "the rig is up" in line), ""), rig.ended()

    async def begun() -> None:
        plc = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=base + 1, timeout_s=PATIENCE_S)
        async with asyncio.timeout(PATIENCE_S):
            while (await plc.read(LadderStatus)).mode != Mode.MPC:  # noqa: ASYNC110 it is another process that changes
                await asyncio.sleep(0.05)
        plc.close()

    asyncio.run(begun())


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short runs, `a` and `b`."""
    folder = tmp_path_factory.mktemp("recorded")
    with pytest.MonkeyPatch.context() as monkeypatch:
        draw_nothing(monkeypatch)
        for name in "ab":
            words = ["run", "--in-process", "--load", name, "--duration", "10s", "--out", str(folder / name)]
            assert cli.main(words) == 0
    return folder


@pytest.fixture(scope="module")
def page_rig(tmp_path_factory: pytest.TempPathFactory, shared_processes: Processes) -> Iterator[int]:
    """The first port of a rig that is up for all pages."""
    base, files = shared_processes.three_ports(), {"XDG_RUNTIME_DIR": str(tmp_path_factory.mktemp("runtime"))}
    words = ("up", "--load", "e", "--factor", "5", "--port-base", base)
    rig = shared_processes.coldloop(*words, stdout=subprocess.PIPE, more=files)
    wait_until_up(rig, base)
    yield base
    assert rig.interrupt() in {0, 130}


@pytest.fixture
def reader(
    tmp_path: Path, coldloop: Coldloop, processes: Processes, monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> Reader:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("MPLBACKEND", "agg")
    whole = bool(request.config.getoption("--all") or request.config.getoption("--night"))
    if not whole:
        draw_nothing(monkeypatch)
    return Reader(tmp_path, coldloop, processes, whole=whole)


def marks(lesson: Lesson) -> list[pytest.MarkDecorator]:
    """Return the marks of a lesson; pages that are read later are executed in the night."""
    by_the_clock = lesson.needs_a_rig or lesson.says(BY_THE_CLOCK)
    found = [pytest.mark.realtime] if by_the_clock else []
    return found if lesson.page.name in READ_FIRST else [*found, pytest.mark.night]


LESSONS = [
    pytest.param(lesson, id=f"{lesson.page.name}:{lesson.blocks[0].line}", marks=marks(lesson))
    for page in PAGES for lesson in lessons(page)
]  # fmt: skip
ALONE = [each for each in LESSONS if not each.values[0].needs_a_rig]
ON_A_RIG = [each for each in LESSONS if each.values[0].needs_a_rig]


@pytest.mark.parametrize("lesson", ALONE)
def test_what_a_page_says_can_be_done(
    lesson: Lesson, reader: Reader, recorded: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if lesson.says("mbpoll"):
        request.getfixturevalue("mbpoll")
    if lesson.says("runs/[ab]") and lesson.page.name not in IN_ORDER:
        shutil.copytree(recorded, tmp_path / "runs")
        for name in lesson.leaves():
            shutil.rmtree(tmp_path / "runs" / name, ignore_errors=True)
    reader.follow(lesson)


@pytest.mark.parametrize("lesson", ON_A_RIG)
def test_what_a_page_says_can_be_done_with_a_rig_that_is_up(
    lesson: Lesson, reader: Reader, page_rig: int, request: pytest.FixtureRequest
) -> None:
    if lesson.says("mbpoll"):
        request.getfixturevalue("mbpoll")
    reader.follow(lesson, page_rig)


@pytest.mark.parametrize(
    "block",
    ["```sh\ncoldloop run --in-process --load nowhere\n```", "```sh\nfalse\n```", "```python\nassert 1 == 2\n```"],
)
def test_a_page_that_says_what_cannot_be_done_fails(block: str, tmp_path: Path, reader: Reader) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"# Page\n\n{block}\n")
    (lesson,) = lessons(page)
    with pytest.raises(AssertionError):
        reader.follow(lesson)


def test_every_block_that_has_no_marker_is_executed_once() -> None:
    executed = [(each.values[0].page, block.line) for each in LESSONS for block in each.values[0].blocks]
    assert sorted(executed) == sorted(
        (page, each.line) for page in PAGES for each in examples(page) if not each.marker.startswith(NOT_EXECUTED)
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_block_that_is_not_executed_gives_a_reason(page: Path) -> None:
    for example in examples(page):
        if example.marker and example.marker != TEST_SUITE:
            assert example.marker.startswith(NOT_EXECUTED), f"{page.name}:{example.line}: {example.marker}"
            assert len(example.marker) > len(NOT_EXECUTED) + 10, f"{page.name}:{example.line}: no reason"


def test_what_is_shortened_occurs() -> None:
    blocks = [each for page in PAGES for each in examples(page) if each.language == "sh"]
    for pattern in (*SHORTENED, *IN_ONE_PROCESS, AT_NIGHT):
        assert any(re.search(pattern, command) for each in blocks for command in each.commands), pattern


def test_commands_are_shortened_as_the_table_says() -> None:
    assert shortened("coldloop run --load a", whole=True) == "coldloop run --duration 10s --load a"
    assert shortened("coldloop run --load a") == "coldloop run --in-process --duration 10s --load a"
    assert shortened("coldloop run --mode realtime --duration 90min") == "coldloop run --mode realtime --duration 10s"
    attached = "coldloop run --attach 127.0.0.1:5020 127.0.0.1:5021 127.0.0.1:5022 --duration 1h"
    assert shortened(attached) == attached
    assert shortened("coldloop chaos kill --out runs/kill") == "coldloop chaos short_plan.toml --out runs/kill"
