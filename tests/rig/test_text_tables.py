"""Tables as text."""

from coldloop_rig.text_tables import aligned, markdown_table


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
