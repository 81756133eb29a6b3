"""The documentation says what is so."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel

from coldloop.process.declaration import Process
from coldloop_rig.cli import make_parser
from coldloop_rig.cli.commands.help import anchor, headings
from coldloop_rig.cli.listings import command_listing, key_listing
from coldloop_rig.cli.registers import FORMATS
from coldloop_rig.plc_sizing.plc import PlcProfile
from coldloop_rig.settings import Settings
from tests.harness.path_options import path_table
from tests.harness.records import MAPS

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_the_register_page_is_what_the_command_prints() -> None:
    page = (ROOT / "docs" / "registers.md").read_text(encoding="utf-8")
    assert page.endswith(FORMATS["markdown"](list(MAPS.values())))


@pytest.mark.parametrize(
    ("model", "page"), [(Process, "keys.md"), (PlcProfile, "keys.md"), (Settings, "configuration.md")]
)
def test_the_pages_of_keys_are_what_the_commands_print(model: type[BaseModel], page: str) -> None:
    tables = key_listing(model)
    assert tables in (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert "|  |\n" not in tables, "each key has a meaning"


def test_the_page_of_commands_is_what_the_parsers_say() -> None:
    assert (ROOT / "docs" / "commands.md").read_text(encoding="utf-8").endswith(command_listing())


def test_the_table_of_paths_is_what_the_parsers_say() -> None:
    assert path_table() in (ROOT / "docs" / "files.md").read_text(encoding="utf-8")


def test_the_map_from_the_paper_to_the_code_names_what_is_there() -> None:
    rows = re.findall(r"^\| I{1,3}.*|^\| [IV]+-.*", (ROOT / "docs" / "science.md").read_text("utf-8"), re.MULTILINE)
    named = [path for row in rows for path in re.findall(r"`((?:services|shared|rig|beside|tests)/[^`]+)`", row)]
    assert len(named) > 30
    assert [path for path in named if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target, section in re.findall(r"\]\((?!https?:)([^)#]*)#?([^)]*)\)", page.read_text(encoding="utf-8")):
        file = page.parent / target if target else page
        assert file.exists(), f"{page.name} links to {target}"
        if section:
            known = {anchor(words) for *_, words in headings(file.read_text(encoding="utf-8"))}
            assert section in known, f"{page.name} links to {target}#{section}"


def test_each_page_is_listed_by_its_purpose_once() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = [name for name in re.findall(r"\]\(([\w-]+\.md)\)", index) if not name.startswith("for-")]
    doors = set(re.findall(r"\]\((for-[\w-]+\.md)\)", index))
    assert sorted([*listed, *doors, "index.md"]) == sorted(page.name for page in PAGES[1:])


def test_every_coldloop_command_of_the_pages_is_understood() -> None:
    blocks = [block for page in PAGES for block in re.findall(r"```sh\n(.*?)```", page.read_text("utf-8"), re.DOTALL)]
    lines = [line.partition(" > ")[0].removeprefix(".venv/bin/") for block in blocks for line in block.splitlines()]
    commands = [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("coldloop ")]
    assert len(commands) > 30
    for line in commands:
        words = line[2:] if line[0] == "--process" else line
        make_parser(words[0]).parse_args(words)


def test_every_mbpoll_line_in_the_readme_reads_declared_floats() -> None:
    lines = re.findall(r"mbpoll .* -p (\d+) -t 4:float -B -r (\d+) -c 1", (ROOT / "README.md").read_text("utf-8"))
    assert len(lines) >= 3
    ports = {"5020": "plant", "5021": "control_plc", "5022": "optimizer_plc"}
    for port, address in lines:
        registers = [register for block in MAPS[ports[port]].blocks for register in block.registers()]
        assert any(r.address == int(address) and r.kind.label == "float32" for r in registers), (port, address)


def test_the_hosted_workflows_call_scripts_that_exist_with_pinned_actions_on_each_python() -> None:
    folder = ROOT / ".github" / "workflows"
    workflow, night = (yaml.safe_load((folder / name).read_text("utf-8")) for name in ("ci.yml", "night.yml"))
    steps = [step for one in (workflow, night) for job in one["jobs"].values() for step in job["steps"]]
    scripts = [step["run"].split()[0] for step in steps if step.get("run", "").startswith("scripts/")]
    assert {"scripts/check", "scripts/test", "scripts/traces"} <= set(scripts)
    assert all((ROOT / script).is_file() for script in scripts)
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step["uses"]) for step in steps if "uses" in step)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    supported = [each.rpartition(" ")[2] for each in project["classifiers"] if "Python :: 3." in each]
    whole, fast = (workflow["jobs"][job]["strategy"]["matrix"]["python"] for job in ("tests", "between"))
    assert (whole, fast) == ([supported[0], supported[-1]], supported[1:-1])
