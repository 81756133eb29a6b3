"""Tables as text, text that fits a terminal, and colours of a state that only a terminal has."""

import sys

import pytest

from coldloop_rig.text_tables import Colour, aligned, coloured, cut, fitted, markdown_table

ROWS = [
    ("solver", "paper s", "dense s", "default follows", "periods"),
    ("ode", "0.25", "0.034", "paper", "19"),
    ("daqp", "", "0.011", "one solve in 5 s", "5"),
]
TEXT = f"""the problem with ode fits, in 13 of 1,000 kB; it updates every 0.5 s at the soonest

{aligned(ROWS, numbers=True)}
late       no mode grows: no period loses the plant; it leaves its band
"""


@pytest.mark.parametrize("columns", [30, 40, 60])
def test_text_within_the_width_keeps_its_words(columns: int) -> None:
    shown = fitted(TEXT, columns)
    assert max(map(len, shown.splitlines())) <= columns
    assert set(shown.split()) == set(TEXT.split())


def test_a_table_continues_below_its_first_column() -> None:
    assert "solver  periods\node          19\n" in fitted(TEXT, 45)
    assert "           leaves its band\n" in fitted(TEXT, 60), "a label keeps its text behind it"


def test_text_for_a_file_is_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    assert fitted(TEXT, None) == TEXT
    assert cut(TEXT, None) == TEXT
    assert coloured("mpc", Colour.GOOD) == "mpc"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert coloured("mpc", Colour.GOOD) == "\x1b[32mmpc\x1b[0m"
    monkeypatch.setenv("NO_COLOR", "1")
    assert coloured("mpc", Colour.GOOD) == "mpc"


def test_a_line_that_is_longer_is_cut() -> None:
    assert cut("123456", 4) == "123…"
    assert cut("1234", 4) == "1234"


def test_names_are_aligned_to_the_left_and_numbers_to_the_right() -> None:
    rows = [("", "a", "longer"), ("name", "10.5", "1")]
    assert aligned(rows) == "      a     longer\nname  10.5  1\n"
    assert aligned(rows, numbers=True) == "         a  longer\nname  10.5       1\n"


def test_a_table_in_markdown_rounds_numbers_and_cuts_digests() -> None:
    text = markdown_table(("what", "value"), [("cost", 1 / 3), ("trace", "0" * 64), ("count", 7)], "**Caption**")
    assert text.splitlines() == [
        "**Caption**", "", "| what | value |", "|---|---|", "| cost | 0.3333 |", "| trace | 000000000000… |",
        "| count | 7 |",
    ]  # fmt: skip
