"""Files, names and paths as others might have them, drawn: read alike, told apart, held in their folder."""

import codecs
import contextlib
from keyword import iskeyword
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coldloop.errors import UsageError
from coldloop.registers.common import IDENTITY_BLOCK
from coldloop.registers.declaration import Block, RegisterMap, f32
from coldloop.table import TIME, read_table
from coldloop.text import held_file, read_text
from coldloop_export.st_printer import LONGEST, Names
from coldloop_rig.cli.registers import exported

one_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
ENCODINGS: Final = {
    "utf-8": b"", "utf-8-sig": b"", "utf-16-le": codecs.BOM_UTF16_LE, "utf-16-be": codecs.BOM_UTF16_BE,
}  # fmt: skip
numbers = st.floats(-1e6, 1e6).map(lambda value: float(f"{value:.6f}"))
tables = st.lists(st.tuples(numbers, numbers), min_size=2, max_size=8)
names = st.text(st.characters(categories=["L", "N"], include_characters="_. -"), min_size=1, max_size=40)


@one_folder
@given(
    rows=tables, separator=st.sampled_from([",", ";", "\t"]), comma=st.booleans(), quoted=st.booleans(),
    end=st.sampled_from(["\n", "\r\n"]), encoding=st.sampled_from([*ENCODINGS, "cp1252"]), units=st.booleans(),
    blank=st.sampled_from(["", " ", "  "]), preamble=st.sampled_from(["", "Export of LT1", "Export, 2 tags\n"]),
    empty=st.booleans(), capitals=st.booleans(),
)  # fmt: skip
def test_a_table_in_any_dress_has_its_numbers(
    tmp_path: Path, rows: list[tuple[float, float]], separator: str, comma: bool, quoted: bool, end: str,  # noqa: FBT001
    encoding: str, units: bool, blank: str, preamble: str, empty: bool, capitals: bool,  # noqa: FBT001
) -> None:  # fmt: skip
    comma = comma and separator != ","
    cells = [[f"{cell:.6f}" for cell in (float(k), *row)] for k, row in enumerate(rows)]
    if comma:
        cells = [[cell.replace(".", ",") for cell in row] for row in cells]
    head = [TIME, "Level" if capitals else "level", "T [\u00b0C]"]
    lines = [head, *([["s", "m", "\u00b0C"]] if units else []), *cells, *([[""] * 3] if empty else [])]
    written = [separator.join(f'"{cell}"' if quoted else f"{blank}{cell}{blank}" for cell in row) for row in lines]
    text = end.join([*preamble.split("\n"), *written, ""]) if preamble else end.join([*written, ""])
    (tmp_path / "t.csv").write_bytes(ENCODINGS.get(encoding, b"") + text.encode(encoding))
    found = read_table(tmp_path / "t.csv", [TIME, "level"], "name a table").columns([TIME, "level", "T"])
    assert found == [[float(k) for k in range(len(rows))], [row[0] for row in rows], [row[1] for row in rows]]


@one_folder
@given(
    text=st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\ufeff")),
    encoding=st.sampled_from([*ENCODINGS]),
)
def test_a_text_in_any_encoding_is_itself(tmp_path: Path, text: str, encoding: str) -> None:
    (tmp_path / "t.txt").write_bytes(ENCODINGS[encoding] + text.encode(encoding))
    assert read_text(tmp_path / "t.txt", "") == text


@given(wanted=st.lists(names, min_size=2, max_size=12))
def test_names_in_structured_text_are_told_apart_whatever_capitals(wanted: list[str]) -> None:
    made = Names()
    found = [made(key, name) for key, name in enumerate(wanted)]
    assert len({name.lower() for name in found}) == len(wanted)
    assert all(name.isascii() and len(name) <= LONGEST and "__" not in name for name in found)


@given(
    wanted=st.sets(
        names.filter(lambda name: name[0].isalpha() and name.isidentifier() and not iskeyword(name)),
        min_size=2,
        max_size=12,
    )
)
def test_tags_are_told_apart_whatever_letters(wanted: set[str]) -> None:
    States = NamedTuple("States", [(name, Annotated[float, f32("a state")]) for name in sorted(wanted)])  # type: ignore[misc]
    tags = [*exported(RegisterMap("plant", 1, (IDENTITY_BLOCK, Block("x", 100, States, ""))))]
    assert len({tag.name.lower() for tag in tags}) == len(tags)


@one_folder
@given(
    parts=st.lists(st.sampled_from(["..", ".", "a", "b", "link", "\u00e4", "a b", "~", "\0"]), min_size=1, max_size=5)
)
def test_a_path_leads_to_a_file_of_its_folder_or_is_refused(tmp_path: Path, parts: list[str]) -> None:
    held = tmp_path / "held"
    (held / "a" / "b").mkdir(parents=True, exist_ok=True)
    for place in (tmp_path / "b", held / "\u00e4", held / "a" / "a b"):
        place.write_bytes(b"")
    if not (held / "link").is_symlink():
        (held / "link").symlink_to(tmp_path / "b")
    with contextlib.suppress(UsageError):
        found = held_file(held, "/".join(parts), "make it again")
        assert found.resolve().is_relative_to(held.resolve())
        assert found.is_file()


@pytest.mark.parametrize("name", ["/etc/hostname", "../b", "link", "a", "nothing"])
def test_what_is_no_file_of_the_folder_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "held" / "a").mkdir(parents=True)
    (tmp_path / "b").write_bytes(b"")
    (tmp_path / "held" / "link").symlink_to(tmp_path / "b")
    with pytest.raises(UsageError, match="make it again"):
        held_file(tmp_path / "held", name, "make it again")
