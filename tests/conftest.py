"""What all tests share: their lanes, how Hypothesis searches, coroutines as tests, no configuration from outside,
processes and a free port, the command line, and Debian's mbpoll.
"""

import asyncio
import inspect
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
from _pytest.fixtures import FixtureDef
from hypothesis import settings

from coldloop.config import PREFIX
from coldloop_rig import cli
from coldloop_rig.cosim.wiring import ReservedPorts
from coldloop_rig.figures.worker import FigureProcess
from tests.harness.budget import BudgetPlugin
from tests.harness.changed import can_reach, changed_files
from tests.harness.lanes import USES, Lane, Watch, judge, lane_of, table
from tests.harness.processes import Processes

QUICK: Final = settings(deadline=None, print_blob=True, max_examples=20, derandomize="CI" in os.environ)
settings.register_profile("quick", QUICK)
settings.register_profile("all", QUICK, max_examples=100)
settings.register_profile("thorough", QUICK, max_examples=5000)
settings.load_profile("quick")
"""Examples of each property: few by default, more in the night; `--hypothesis-profile=thorough` is for a night. A test
that needs more or fewer names a multiple or a part of them. Each run looks elsewhere and begins with what failed
before, but with `CI` set the examples are always the same. None has a deadline: the machine may be busy."""

SHARED: Final = (
    "site",
    "start_site",
    "served",
    "shared_rack",
    "three_processes",
    "live_rig",
    "page_rig",
    "up",
    "client",
    "_engine",
    "problems",
)
"""Fixtures that start processes, or compute for long, for many tests: those that have the same one run in one worker,
which does that once. It ends with the last of them."""

# Whoever started the tests may ignore these (a script in the background, nohup); what the tests start must not.
for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)


LANES: Final = pytest.StashKey[Lane]()
SHARED_BY: Final = pytest.StashKey[FixtureDef[Any] | None]()
WATCH: Final = Watch()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("lanes")
    for option, help_text in {
        "--fast": "the fast lane, which is the default: no program, no compiler, no clock, no browser",
        "--system": "the system lane: programs, rigs in real time, the page in a browser",
        "--night": "the night lane: many configurations, long searches, the composed rig; 100 examples a property",
        "--all": "all lanes, with 100 examples of each property",
    }.items():
        group.addoption(option, action="store_true", help=help_text)
    group.addoption(
        "--lanes", action="store_true", help="run nothing: print the table of which tests are in which lane"
    )
    group.addoption("--changed", metavar="BASE", help="only tests that what differs from this commit can reach")
    group.addoption("--over-budget", metavar="FILE", help="write the folders that are over their budget to a file")


def asked_lanes(config: pytest.Config) -> set[Lane]:
    """Return the lanes that the options ask for."""
    if config.getoption("--all"):
        return set(Lane)
    return {lane for lane in Lane if config.getoption(f"--{lane}")} or {Lane.FAST}


def pytest_configure(config: pytest.Config) -> None:
    if Lane.NIGHT in asked_lanes(config) and not config.getoption("--hypothesis-profile"):
        settings.load_profile("all")
    config.pluginmanager.register(BudgetPlugin(lambda item: item.stash.get(LANES, Lane.FAST)), "budget")


def shared_fixture(item: pytest.Item) -> FixtureDef[Any] | None:
    """Return the shared fixture that a test requests, itself or through others; a fixture of one test is not shared."""
    definitions = getattr(item, "_fixtureinfo").name2fixturedefs if hasattr(item, "_fixtureinfo") else {}  # noqa: B009
    found = (definitions[name][-1] for name in SHARED if name in definitions)
    return next((each for each in found if each.scope != "function"), None)


def keep_together(item: pytest.Item, group: str) -> None:
    """Have a test done by the worker that does the others of its group."""
    item.add_marker(pytest.mark.xdist_group(group))
    identity = getattr(item, "_id", None)
    if identity is not None and hasattr(item.config, "workerinput"):
        # pytest 9.2 has the name of a test there; what pytest-xdist 3.8 appends the group to, it does not read any more
        item._id = type(identity).parse(f"{item.nodeid}@{group}")  # type: ignore[attr-defined]  # noqa: SLF001


def is_named(item: pytest.Item) -> bool:
    """Return whether the command line names this test: it then runs whatever its lane."""
    return any("::" in each and item.nodeid.startswith(each.split("[")[0]) for each in item.config.args)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark each test by what it uses, and leave out what is in other lanes than those asked for."""
    asked, chosen, left_out = asked_lanes(config), list[pytest.Item](), list[pytest.Item]()
    base = config.getoption("--changed")
    changed = None if base is None else changed_files(base)
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        for mark in (mark for mark, names in USES.items() if names & fixtures):
            item.add_marker(mark)
        item.stash[LANES] = lane_of(mark.name for mark in item.iter_markers())
        item.stash[SHARED_BY] = shared = shared_fixture(item)
        runs = item.stash[LANES] in asked and (changed is None or can_reach(item.path, fixtures, changed))
        (chosen if runs or is_named(item) else left_out).append(item)
        if shared is not None:
            keep_together(item, f"{shared.baseid}/{shared.argname}")
    if config.getoption("--lanes"):
        marked = ((item.nodeid, item.stash[LANES], {mark.name for mark in item.iter_markers()}) for item in items)
        sys.stdout.write("\n".join(table(marked)) + "\n")
        left_out = [*items]
        chosen = []
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = chosen


def pytest_report_collectionfinish(config: pytest.Config) -> str:
    """Say which lanes run."""
    return f"lanes: {', '.join(sorted(asked_lanes(config)))} (also: --fast, --system, --night, --all)"


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Begin to watch what the test does."""
    WATCH.begin(item.stash[LANES])


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup() -> Generator[None, Any, Any]:
    """Fail a fixture that does what the lane may not do: so each test that requests it fails, not the first one."""
    noted = len(WATCH.notes)
    result = yield
    if len(WATCH.notes) > noted:
        judge(WATCH.lane, WATCH.notes)
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, Any, Any]:
    """Fail a test that does what its lane may not do."""
    result = yield
    judge(item.stash[LANES], WATCH.notes)
    return result


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, Any, Any]:
    """End what tests share, with its programs, after the last test that uses it."""
    result = yield
    shared = item.stash[SHARED_BY]
    if shared is not None and (nextitem is None or nextitem.stash[SHARED_BY] is not shared):
        shared.finish(item._request)  # type: ignore[attr-defined]  # noqa: SLF001 no public way before the scope's end
    return result


LAST_LINES = 12
"""Of a program's log that are shown of a test that failed."""
PATIENCE_S = 120.0
"""A coroutine has failed when it takes longer; the first one on a bus may have to compile the kernels."""


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine, in a loop of its own and within `PATIENCE_S`."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}

    async def story() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await pyfuncitem.obj(**arguments)

    asyncio.run(story())
    return True


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show what the programs of a test that failed have said last."""
    report = yield
    if report.failed:
        for fixture in getattr(item, "funcargs", {}).values():
            if isinstance(fixture, Processes):
                report.sections.append(("programs", fixture.said_last(LAST_LINES)))
    return report


@pytest.fixture(autouse=True)
def _no_configuration_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in tuple(os.environ):
        if name.startswith(PREFIX):
            monkeypatch.delenv(name)


@pytest.fixture
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """Programs that end with the test."""
    started = Processes(tmp_path_factory.mktemp("processes"))
    yield started
    started.end()


@pytest.fixture(scope="session")
def shared_processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """Programs that end with the last test."""
    started = Processes(tmp_path_factory.mktemp("shared"))
    yield started
    started.end()


@pytest.fixture(scope="session")
def programs() -> None:
    """Requested where a test starts programs without `processes`: it marks the test."""


@pytest.fixture(scope="session")
def compiles() -> None:
    """Requested where kernels are compiled that set-up does not compile: it marks the test."""


@pytest.fixture(scope="session")
def realtime() -> None:
    """Requested where plant time follows the clock: it marks the test."""


def draw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let runs in this process leave no figure: to draw one takes longer than a short run."""
    monkeypatch.setattr(FigureProcess, "start", lambda _: None)
    monkeypatch.setattr(FigureProcess, "draw", lambda *_: None)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in this process leave no figure."""
    draw_nothing(monkeypatch)


@pytest.fixture
def free_port() -> Iterator[int]:
    """A port on localhost that nobody else gets during the test; connections are refused until a server listens."""
    with ReservedPorts(1) as reserved:
        yield reserved.numbers[0]


def install(*packages: str) -> None:
    """Install Debian packages, or skip the test with the reason why that cannot be."""
    command = [str(Path(__file__).parents[1] / "scripts" / "packages"), *packages]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"needs {' '.join(packages)}: {done.stderr.strip()}")


@pytest.fixture(scope="session")
def mbpoll() -> str:
    if shutil.which("mbpoll") is None:
        install("mbpoll")
    return "mbpoll"


class Outcome(NamedTuple):
    """What a command left behind."""

    code: int
    out: str
    complaints: list[str]
    """Lines on standard error."""


Coldloop = Callable[..., Outcome]


@pytest.fixture
def coldloop(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Coldloop:
    """`coldloop` with its arguments, in this process: what it does not report as its own error fails the test."""

    def run(*arguments: object, environment: Mapping[str, str] | None = None) -> Outcome:
        with monkeypatch.context() as context:
            for name, value in (environment or {}).items():
                context.setenv(name, value)
            capsys.readouterr()
            try:
                code: Any = cli.main([str(argument) for argument in arguments])
            except SystemExit as end:
                code = end.code
        out, err = capsys.readouterr()
        return Outcome(code, out, err.splitlines())

    return run
