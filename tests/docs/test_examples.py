"""What README and docs tell a reader to type is executed: each page's blocks in their order, in a folder of its own.

A block of `sh`, `console` or `python` that is not executed here says so in a comment in front of it, with the reason.
"""

import io
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import Coldloop, first_of_three_ports

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?:^<!-- (?P<marker>.*?) -->\n)?^```(?P<language>sh|console|python)\n(?P<text>.*?)^```"
    r"(?:\n\n```text\n(?P<printed>.*?)^```)?",
    re.MULTILINE | re.DOTALL,
)
NOT_EXECUTED = "not executed: "
TEST_SUITE = "executed: as a test suite"

SHORTENED = {
    r"^coldloop run(?!.*--(attach|duration))": r"coldloop run --duration 10s",
    r"^(coldloop run(?!.*--attach|.*my_load).*)--duration \S+": r"\1--duration 10s",
    r"^coldloop chaos (kill|freeze)": r"coldloop chaos short_plan.toml",
    r"^(coldloop chaos .*)--duration \S+": r"\1--duration 20s",
    r"^scripts/run": r"scripts/run --duration 10s",
}
"""What is executed instead of what the pages say, so that it takes seconds; the tutorial's own load is run whole."""

FOLLOWS = "--follow"
"""Commands with it are read until their first line, and then interrupted."""

PLAN = """name = "short"
description = "The optimiser's link loses frames"
load = "a"
duration_s = 20
seed = 1

[[faults]]
kind = "drop"
link = "optimizer"
at_s = 5
duration_s = 5
share = 0.2
"""


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


def shortened(command: str) -> str:
    for pattern, replacement in SHORTENED.items():
        command = re.sub(pattern, replacement, command)
    return command


class Reader:
    """Does what a page says, in a folder with the files that pages take as given."""

    def __init__(self, folder: Path, coldloop: Coldloop, mbpoll: str) -> None:
        self._folder = folder
        self._coldloop = coldloop
        self._mbpoll = mbpoll
        self._stack = ExitStack()
        self._base: int | None = None
        (folder / "short_plan.toml").write_text(PLAN)
        (folder / "my_plan.toml").write_text(PLAN)
        for name, watts in (("my_hours.csv", 400), ("another.csv", 370)):
            (folder / name).write_text(f"time_s,load_w\n0,384\n5,{watts}\n")

    def follow(self, page: Path) -> None:
        """Execute all blocks of a page that have no marker."""
        names: dict[str, object] = {"__name__": "__main__"}
        blocks = examples(page)
        if any("runs/" in each.text for each in blocks):
            made = {name for each in blocks for name in re.findall(r"--out runs/(\w+)", each.text)}
            for name in {"a", "b"} - made:
                self._run(f"coldloop run --in-process --load {name} --duration 10s --figures png --out runs/{name}")
        for each in blocks:
            if each.marker.startswith(NOT_EXECUTED):
                continue
            with self._stack:
                self._base = None
                if each.marker == TEST_SUITE:
                    self._test_suite(each)
                elif each.language == "python":
                    with redirect_stdout(io.StringIO()) as printed:
                        exec(compile("\n" * each.line + each.text, str(page), "exec"), names)  # noqa: S102 our own page
                    assert each.printed in {None, printed.getvalue()}
                else:
                    for command in each.commands:
                        self._run(shortened(command))

    def _run(self, command: str) -> None:
        if re.match(r"(coldloop|scripts/)\s*up\b", command):
            self._base = self._stack.enter_context(self._up(command))
            return
        if self._base is None and re.search(r"127\.0\.0\.1:502|coldloop (status|set)|mbpoll", command):
            self._base = self._stack.enter_context(self._up("coldloop up --load e --factor 5"))
        words = [self._word(word) for word in shlex.split(self._on_our_ports(command))]
        if FOLLOWS in words:
            self._read_first_line(words)
        elif words[0] == "coldloop":
            outcome = self._coldloop(*words[1:])
            assert outcome.code == 0, (command, outcome.complaints)
        else:
            done = subprocess.run(
                words, cwd=self._folder, check=False, stdin=subprocess.DEVNULL, capture_output=True, text=True
            )
            assert done.returncode == 0, (command, done.stdout[-2000:], done.stderr[-2000:])
            if words[0] == self._mbpoll:
                assert re.search(r"\[\d+\]: \t[\d.]+|Written 1 references", done.stdout), done.stdout

    def _word(self, word: str) -> str:
        if word == "mbpoll":
            return self._mbpoll
        return str(ROOT / word) if word.startswith("scripts/") else word

    def _on_our_ports(self, command: str) -> str:
        if self._base is None:
            return command
        for place in range(3):
            command = re.sub(rf"(127\.0\.0\.1:|-p )502{place}\b", rf"\g<1>{self._base + place}", command)
        return re.sub(r"^coldloop (status|set)\b", rf"coldloop \1 --port-base {self._base}", command)

    @contextmanager
    def _up(self, command: str) -> Iterator[int]:
        """Keep a rig up; its first port is not that of the page."""
        base = first_of_three_ports()
        words = [*self._executable(shlex.split(command)), "--port-base", str(base)]
        with subprocess.Popen(
            words, cwd=self._folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        ) as up:
            assert up.stdout is not None
            try:
                said = next((line for line in up.stdout if "the rig is up" in line), "")
                assert said, f"{command} ended with {up.wait()}"
                yield base
            finally:
                up.send_signal(signal.SIGINT)
                up.communicate(timeout=60)
        assert up.returncode in {0, 128 + signal.SIGINT}

    def _read_first_line(self, words: list[str]) -> None:
        with subprocess.Popen(self._executable(words), cwd=self._folder, stdout=subprocess.PIPE, text=True) as follower:
            assert follower.stdout is not None
            assert follower.stdout.readline().strip()
            follower.send_signal(signal.SIGINT)
            follower.communicate(timeout=60)
        assert follower.returncode in {0, 128 + signal.SIGINT}

    def _executable(self, words: list[str]) -> list[str]:
        return [sys.executable, "-m", "rig", *words[1:]] if words[0] == "coldloop" else [*map(self._word, words)]

    def _test_suite(self, example: Example) -> None:
        """Run a block as somebody else's test suite, which knows Coldloop as an installed package only."""
        suite = self._folder / "somebody_elses_project"
        suite.mkdir()
        (suite / "test_with_coldloop.py").write_text(example.text, encoding="utf-8")
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--rootdir", str(suite), str(suite)],
            cwd=suite, check=False, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
        assert f"{example.text.count('def test_')} passed" in done.stdout


@pytest.mark.parametrize("page", [page for page in PAGES if examples(page)], ids=lambda page: page.name)
def test_what_a_page_says_can_be_done(
    page: Path, tmp_path: Path, coldloop: Coldloop, mbpoll: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("MPLBACKEND", "agg")
    Reader(tmp_path, coldloop, mbpoll).follow(page)


@pytest.mark.parametrize(
    "block",
    ["```sh\ncoldloop run --in-process --load nowhere\n```", "```sh\nfalse\n```", "```python\nassert 1 == 2\n```"],
)
def test_a_page_that_says_what_cannot_be_done_fails(block: str, tmp_path: Path, coldloop: Coldloop) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"# Page\n\n{block}\n")
    with pytest.raises(AssertionError):
        Reader(tmp_path, coldloop, "mbpoll").follow(page)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_block_that_is_not_executed_gives_a_reason(page: Path) -> None:
    for example in examples(page):
        if example.marker and example.marker != TEST_SUITE:
            assert example.marker.startswith(NOT_EXECUTED), f"{page.name}:{example.line}: {example.marker}"
            assert len(example.marker) > len(NOT_EXECUTED) + 10, f"{page.name}:{example.line}: no reason"


def test_what_is_shortened_occurs() -> None:
    blocks = [each for page in PAGES for each in examples(page) if each.language == "sh"]
    for pattern in SHORTENED:
        assert any(re.search(pattern, command) for each in blocks for command in each.commands), pattern


def test_commands_are_shortened_as_the_table_says() -> None:
    assert shortened("coldloop run --load a") == "coldloop run --duration 10s --load a"
    assert shortened("coldloop run --load b.csv --duration 90min") == "coldloop run --load b.csv --duration 10s"
    attached = "coldloop run --attach 127.0.0.1:5020 127.0.0.1:5021 127.0.0.1:5022 --duration 1h"
    assert shortened(attached) == attached
    assert shortened("coldloop chaos kill --out runs/kill") == "coldloop chaos short_plan.toml --out runs/kill"
