"""`coldloop docs`: what messages point at is there, in a checkout and in a wheel."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from hatch_build import Pages

if TYPE_CHECKING:
    from tests.conftest import Coldloop

POINTED_AT = sorted(
    {
        place
        for folder in ("rig", "services", "shared")
        for file in Path(folder).rglob("*.py")
        for place in re.findall(r"`coldloop docs ([a-z-]+(?:#[a-z-]+)?)`", file.read_text(encoding="utf-8"))
    }
)


def test_pages_are_listed_with_their_titles(coldloop: "Coldloop") -> None:
    listed = coldloop("docs").out.splitlines()
    assert [line.split()[0] for line in listed] == sorted(path.stem for path in Path("docs").glob("*.md"))
    assert next(line for line in listed if line.startswith("budget ")).split(maxsplit=1)[1]


@pytest.mark.parametrize("place", POINTED_AT)
def test_what_messages_point_at_is_printed(place: str, coldloop: "Coldloop") -> None:
    code, out, complaints = coldloop("docs", place)
    assert (code, out.startswith("#")) == (0, True), complaints


def test_a_section_ends_where_the_next_one_begins(coldloop: "Coldloop") -> None:
    page = Path("docs/fail-safe.md").read_text(encoding="utf-8")
    section = coldloop("docs", "docs/fail-safe.md#no-answer").out
    assert section in page
    assert len(re.findall(r"^#", section, re.MULTILINE)) == 1


def test_a_section_that_has_moved_to_the_evidence_of_its_page_is_found(coldloop: "Coldloop") -> None:
    assert coldloop("docs", "plc-export#memory-and-time").out.startswith("## Memory and time")


@pytest.mark.parametrize(("place", "part"), [("fail-save", "fail-safe"), ("fail-safe#no", "no-answer")])
def test_what_is_not_there_is_one_line_that_lists_what_is(place: str, part: str, coldloop: "Coldloop") -> None:
    code, _, complaints = coldloop("docs", place)
    assert (code, len(complaints)) == (2, 1)
    assert part in complaints[0]


@pytest.mark.parametrize(("version", "names"), [("standard", {"keys.md", "scada.md"}), ("editable", set())])
def test_a_wheel_has_the_pages_where_the_command_looks(version: str, names: set[str]) -> None:
    data: dict[str, Any] = {"force_include": {}}
    Pages.initialize(SimpleNamespace(root="."), version, data)  # type: ignore[arg-type]
    assert names <= {target.removeprefix("coldloop_rig/pages/") for target in data["force_include"].values()}
    assert bool(data["force_include"]) == bool(names)
