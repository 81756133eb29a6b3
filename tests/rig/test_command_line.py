"""The command line: it starts at once, completes, and writes no control sequences where nobody sees them."""

import errno
import json
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.sections import NO_LOAD
from coldloop.process.settings import settings_of
from coldloop.session import TimeMode
from coldloop_chaos.commands import plans
from coldloop_chaos.faults import shipped_plans
from coldloop_optimizer_plc.settings import Preset, SolverName
from coldloop_plant.load import NAMED
from coldloop_rig.cli import EXTRAS, command_names, make_parser
from coldloop_rig.cli.commands import options, rig
from coldloop_rig.cli.registers import EXPORTS, FORMATS
from coldloop_studies import commands
from coldloop_studies.reproduction import APART, STUDIES
from tests.harness.installed import installed
from tests.harness.processes import Ended, Processes
from tests.harness.records import MAPS

if TYPE_CHECKING:
    from tests.conftest import Coldloop

HEAVY = {"numpy", "numba", "scipy", "matplotlib", "pydantic", "pyarrow", "distributed", "rich", "plotly", "argcomplete"}
SERVICES = {"coldloop_plant", "coldloop_control_plc", "coldloop_optimizer_plc", "coldloop_hmi"}
PATIENCE_S = 300.0
"""The first run on a machine compiles the kernels."""


Python = Callable[..., Ended]


@pytest.fixture
def python(processes: Processes) -> Python:
    """An interpreter of its own, with arguments and further variables."""

    def run(*arguments: str, **environment: str) -> Ended:
        pipe = subprocess.PIPE
        return processes.python(*arguments, stdout=pipe, stderr=pipe, more=environment).ended(PATIENCE_S)

    return run


def test_the_names_that_are_offered_are_those_that_exist() -> None:
    assert tuple(mode.value for mode in TimeMode) == options.MODES
    assert tuple(solver.value for solver in SolverName) == options.SOLVERS
    assert tuple(preset.value for preset in Preset) == options.PRESETS
    assert tuple(NAMED) == options.LOADS
    assert sorted(options.SERVICES) == sorted(MAPS)
    assert sorted(options.REGISTER_FORMATS) == sorted(FORMATS)
    assert sorted(options.TAG_FORMATS) == sorted(EXPORTS)
    assert (*STUDIES, *APART) == commands.STUDIES
    assert plans() == [plan.name for plan in shipped_plans()]


ONE_AFTER_THE_OTHER = """
import json, sys
from coldloop_rig.cli import main
for words in json.loads(sys.argv[1]):
    try: code = main(words)
    except SystemExit as end: code = end.code
    print("ended", code or 0, *words)
    print(*sorted({name.partition(".")[0] for name in sys.modules}), file=sys.stderr)
"""
"""Does commands, and says after each of them how it ended and what has been imported by then."""


def test_help_imports_nothing_that_takes_time(python: Python) -> None:
    commands = [["--help"], *([command, "--help"] for command in command_names())]
    done = python("-c", ONE_AFTER_THE_OTHER, json.dumps(commands))
    assert done.out.count("usage: coldloop") == done.out.count("ended 0") == len(commands)
    of_the_process = commands.index(["set", "--help"])  # its inputs are those of the process, a validated model
    for place, (words, loaded) in enumerate(zip(commands, done.err.splitlines(), strict=True)):
        assert not (HEAVY - {"pydantic"} if place >= of_the_process else HEAVY) & set(loaded.split()), words


OUTSIDE = {
    "broken.py": "import nowhere_to_be_found",
    "nameless.py": "COMMANDS = {}",
    "unequal.py": """
def declare(parser): parser.add_argument("--help")
def greet(options): "A greeting."; print("hello"); return 0
COMMANDS = {"unequal": (declare, greet), "greet": (lambda parser: None, greet)}
GROUP = SAID = dict.fromkeys(COMMANDS, "says hello")
""",
}
POINTS = {"crashing": "broken", "nameless": "nameless", "unequal": "unequal", "greet": "unequal", "run": "broken"}
LOOKED_UP = """
import sys
from importlib import metadata
found, groups = metadata.entry_points, []
metadata.entry_points = lambda **what: groups.append(what) or found(**what)
from coldloop_rig.cli import main
main([]), main(["greet"])
print("looked up", len(groups))
"""


def test_a_command_that_cannot_be_loaded_leaves_the_others_alone(tmp_path: Path, python: Python) -> None:
    environment = installed(tmp_path / "site", OUTSIDE, {"coldloop.commands": POINTS})
    helped, greeted = (python("-m", "coldloop_rig", word, **environment) for word in ("--help", "greet"))
    assert (helped.code, helped.err, greeted.out) == (0, "", "hello\n")
    unloaded = helped.out.partition("commands that cannot be loaded:\n")[2].partition("\n\n")[0].splitlines()
    assert [line.split()[0] for line in unloaded] == ["crashing", "nameless"]
    assert "from broken (package outside): ModuleNotFoundError: No module named 'nowhere_to_be_found'" in unloaded[0]
    assert "  run           run the loop" in helped.out
    assert "  study         " in helped.out
    for name, what in (
        ("crashing", "nowhere_to_be_found"),
        ("nameless", "KeyError: 'nameless'"),
        ("unequal", "--help"),
    ):
        refused = python("-m", "coldloop_rig", name, **environment)
        (line,) = refused.err.splitlines()
        assert (refused.code, refused.out, what in line) == (2, "", True)
        assert line.startswith(f"coldloop: {name}: cannot be loaded from {POINTS[name]} (package outside): ")
        assert line.endswith("; update that package, or uninstall it")
    assert python("-c", LOOKED_UP, **environment).out.endswith("looked up 1\n")


TYPOS = [
    ["run", "--load", "zz"], ["run", "--load", ""], ["run", "--solver", "simplex"], ["study", "zz"],
    ["study", "limited", "--load", "zz"], ["chaos", "kill", "--load", "zz"], ["budget", "--updating-period", "7"],
    ["budget", "--updating-period", "adaptive"], ["run", "--in-process", "--attach", "a:1", "b:2", "c:3"],
]  # fmt: skip


def test_a_typo_is_told_before_anything_that_takes_time_is_imported(python: Python) -> None:
    done = python("-c", ONE_AFTER_THE_OTHER, json.dumps(TYPOS))
    assert done.out.count("ended 2") == len(TYPOS)
    complaints, loaded = done.err.splitlines()[::2], done.err.splitlines()[1::2]
    assert all(line.startswith("coldloop") for line in complaints), complaints
    for words, names in zip(TYPOS, loaded, strict=True):  # periods are those of the process, a validated model
        assert not (HEAVY - {"pydantic"}) & set(names.split()), words


PROJECT = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
DISTRIBUTIONS = {"markdown_it": "markdown-it-py"}
"""Of packages whose name is another one."""


def test_each_extra_that_a_command_names_brings_what_it_lacks() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    for package, extra in EXTRAS.items():
        assert [one for one in extras[extra] if one.startswith(f"{DISTRIBUTIONS.get(package, package)}>=")], package


def test_the_images_install_what_the_project_asks_for() -> None:
    project, groups = PROJECT["project"], PROJECT["dependency-groups"]
    asked = {*project["dependencies"], *(one for extra in project["optional-dependencies"].values() for one in extra)}
    images = (group for name, group in groups.items() if name != "site")
    assert all(one in asked for group in images for one in group if isinstance(one, str))


WITHOUT_EXTRAS = f"import sys; sys.modules.update(dict.fromkeys({list(EXTRAS)}))" + ONE_AFTER_THE_OTHER


def test_a_plain_installation_says_which_extra_a_command_needs(tmp_path: Path, python: Python) -> None:
    run = [["run", "--in-process", "--load", "a", "--duration", "30s", "--out", f"{tmp_path}/r", "--figures", "svg"]]
    lacking = [
        ["report", f"{tmp_path}/r"], ["export", f"{tmp_path}/r", "--hdf5"], ["page", f"{tmp_path}/r"],
        ["study", "periods", "--quick"], ["reproduce", "--quick"], ["run", "--solver", "qpoases", "--in-process"],
        ["import", f"{tmp_path}/export.csv", "--inputs", "a", "--out", f"{tmp_path}/record.csv"],
    ]  # fmt: skip
    done = python("-c", WITHOUT_EXTRAS, json.dumps(run + lacking))
    complaints = [line for line in done.err.splitlines() if line.startswith("coldloop")]
    assert (done.out.count("ended 0"), done.out.count("ended 2")) == (1, len(lacking)), done.err
    assert [line.count("coldloop[") for line in complaints] == [1] * len(lacking), complaints


def test_commands_to_a_rig_import_nothing_that_takes_time(free_port: int, python: Python) -> None:
    base = ["--port-base", str(free_port)]
    commands = [["status", *base], ["set", "load", "400", *base], ["set", "mode", "manual", *base], ["down", *base]]
    done = python("-c", ONE_AFTER_THE_OTHER, json.dumps(commands))
    complaints, loaded = done.err.splitlines()[::2], set(done.err.split())
    assert all("no rig" in line for line in complaints)
    assert len(complaints) == len(commands)
    assert "coldloop" in loaded
    assert not loaded & (HEAVY - {"pydantic"} | SERVICES)


@pytest.mark.parametrize("key", ["plant.seed=3", "optimizer_plc.program.solver=osqp", "plat.seed=3"])
def test_a_setting_without_effect_on_a_rig_that_is_up_is_refused(key: str, coldloop: "Coldloop") -> None:
    outcome = coldloop("status", "--set", key)
    assert (outcome.code, len(outcome.complaints)) == (2, 1)


def test_options_are_taken_before_and_behind_what_is_to_be_done() -> None:
    parser = make_parser("set")
    before = parser.parse_args(["set", "--port-base", "6020", "--set", "a=1", "load", "-1"])
    behind = parser.parse_args(["set", "load", "-1", "--port-base", "6020"])
    assert before.port_base == behind.port_base == 6020
    assert (before.new_load, before.assignments) == ("-1", ["a=1"])


@pytest.mark.parametrize(
    ("words", "cut"),
    [
        (("page", "--port", "3"), "--port"),
        (("run", "--dur", "1h"), "--dur"),
        (("set", "load", "400", "--a", "3"), "--a"),
        (("fault", "sensor", "T5", "stuck", "--port-b", "6020"), "--port-b"),
    ],
)
def test_an_abbreviation_of_an_option_is_none(words: tuple[str, ...], cut: str, coldloop: "Coldloop") -> None:
    outcome = coldloop(*words)
    assert outcome.code == 2
    assert cut in outcome.complaints[-1]


def test_a_load_of_a_process_that_has_none_is_refused(coldloop: "Coldloop") -> None:
    with settings_of(COLD_BOX.model_copy(update={"load": NO_LOAD, "bath": None})):
        outcome = coldloop("run", "--load", "a")
    assert (outcome.code, outcome.complaints) == (2, ["coldloop: load 'a': cold-box has no load; leave it out"])


def test_version_is_an_option_and_a_command(coldloop: "Coldloop") -> None:
    option, command = coldloop("--version"), coldloop("version")
    assert option.code == command.code == 0
    assert option.out == command.out
    assert option.out.startswith("coldloop ")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "tcsh"])
def test_a_shell_gets_a_script_for_completion(shell: str, coldloop: "Coldloop") -> None:
    assert "coldloop" in coldloop("completion", shell).out


@pytest.mark.parametrize(
    ("line", "offered"),
    [("coldloop run --so", "--solver"), ("coldloop study tra", "trade-off"), ("coldloop chaos ki", "kill")],
)
def test_a_line_is_completed(line: str, offered: str, tmp_path: Path, python: Python) -> None:
    answer = tmp_path / "answer"
    answer.touch()
    python(
        "-m", "coldloop_rig", _ARGCOMPLETE="1", COMP_LINE=line, COMP_POINT=str(len(line)), _ARGCOMPLETE_IFS="\n",
        _ARGCOMPLETE_STDOUT_FILENAME=str(answer),
    )  # fmt: skip
    assert offered in answer.read_text().split()


DUMB = pytest.param({"NO_COLOR": "1", "COLUMNS": "20", "TERM": "dumb"}, marks=pytest.mark.night)


@pytest.mark.parametrize("environment", [{}, DUMB])
def test_a_run_that_is_piped_writes_no_control_sequences(
    environment: dict[str, str], tmp_path: Path, python: Python
) -> None:
    out = tmp_path / "run"
    done = python("-m", "coldloop_rig", "run", "--in-process", "--duration", "2s", "--out", str(out), **environment)
    assert done.code == 0
    assert "\x1b" not in done.out + done.err
    assert "\r" not in done.out + done.err


def test_a_full_standard_output_is_one_line(processes: Processes) -> None:
    with Path("/dev/full").open("w") as full:
        done = processes.coldloop("registers", stdout=full.fileno(), stderr=subprocess.PIPE).ended()
    assert done.code == 1
    assert done.err == "coldloop: standard output: No space left on device\n"


def test_an_error_that_is_not_the_outputs_is_not_called_so(
    coldloop: "Coldloop", monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(_: object) -> int:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(rig, "execute_down", refused)
    assert coldloop("down").complaints == ["coldloop: down: Operation not permitted"]


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["run", "--factor", "3"], "--mode realtime"),
        (["run", "--set", "plant.server.port=6020"], "--set plant.server.port: has no effect"),
        (["run", "--set", "session.autostart=true"], "--set session.autostart: has no effect"),
        (["study", "cholesky", "--load", "a"], "--load would have no effect"),
        (["study", "limited", "--quick", "--seeds", "2"], "not allowed with"),
        (["chaos", "kill", "--set", "session.factor=3"], "--factor"),
        (["chaos", "kill", "--set", "optimizer_plc.program.updating_period_s=1"], "of the plan"),
        (["chaos", "kill", "--set", "control_plc.server.port=6020"], "control_plc.server.port"),
        (["chaos", "kill", "--set", "plant.retain.file=x"], "in the folder of the results"),
        (["run", "--log-level", "debug"], "--log-level"),
    ],
)
def test_an_option_without_effect_is_refused(words: list[str], part: str, coldloop: "Coldloop", tmp_path: Path) -> None:
    outcome = coldloop(*words, "--out", tmp_path / "out")
    assert outcome.code == 2
    assert part in outcome.complaints[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["run", "up", "chaos kill"])
def test_a_place_that_a_command_has_itself_is_refused_wherever_it_was_set(
    command: str, coldloop: "Coldloop", tmp_path: Path
) -> None:
    """The default may be repeated: `coldloop config` writes it."""
    file = tmp_path / "config.toml"
    file.write_text('[plant.server]\nhost = "0.0.0.0"\n')
    (said,) = coldloop(*command.split(), "--config", file).complaints
    assert f"{file}: plant.server.host: has no effect" in said
    file.write_text('[plant.server]\nhost = "127.0.0.1"\n')
    for variable, value in (("CONTROL_PLC__PLANT__PORT", "7000"), ("PLANT__SERVER__HOST", "::1")):
        name = f"COLDLOOP__{variable}"
        refused = coldloop(*command.split(), "--config", file, environment={name: value})
        assert refused.code == 2
        assert refused.complaints[0].startswith(f"coldloop: {name}: has no effect on this command: ")


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize("command", ["run --in-process --duration 2s", "certificates", "model", "chaos kill"])
def test_a_device_as_the_place_for_results_is_refused_and_stays(command: str, coldloop: "Coldloop") -> None:
    outcome = coldloop(*command.split(), "--out", "/dev/full")
    assert outcome.code == 2
    assert len(outcome.complaints) == 1
    assert "/dev/full" in outcome.complaints[0]
    assert Path("/dev/full").is_char_device()


def test_a_parser_is_made_for_each_command() -> None:
    overview = make_parser(None).format_help()
    for command in command_names():
        assert f"\n  {command} " in overview
        assert make_parser(command).format_help()
