"""The options of commands that are paths, as their parsers declare them, and what comes of what is no good file."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from coldloop_rig.cli import USES, command_names, make_parser
from coldloop_rig.cli.listings import _subparsers
from coldloop_rig.text_tables import markdown_table

REFUSED: Final = "not a regular file"
HEADER: Final = (
    "the option is", "options", "a folder", "FIFO, device", "10 GB, one that grows", "a link"
)  # fmt: skip
HELD: Final = "what it leads to is read; files that lead outside are refused"
ANSWERS: Final = {
    "read": ("a file, read", REFUSED, REFUSED, "more than … bytes", "what it leads to is read"),
    "name": ("a name or a file, read", REFUSED, REFUSED, "more than … bytes", "what it leads to is read"),
    "folder": (
        "a folder, read; its files as above", "which file is missing", "which file is missing, or Not a directory",
        "as a FIFO", HELD,
    ),
    "export": ("a folder, whose C sources are copied, compiled and run", *["is no export"] * 3, HELD),
    "write": (
        "a file, written whole or not at all", REFUSED, REFUSED, "exists, or is replaced",
        "exists, or is replaced itself: what it leads to stays",
    ),
    "into": (
        "a folder, written into", "not empty, or written into", "File exists", "File exists",
        "what it leads to is written into",
    ),
}  # fmt: skip
"""Texts by the type of an option: its meaning, and the message or effect of each kind of path."""


class PathOption(NamedTuple):
    """An option, or an argument, that is a path."""

    command: tuple[str, ...]
    name: str
    use: str

    def __str__(self) -> str:
        return " ".join((*self.command, self.name))


def path_options() -> list[PathOption]:
    """Return all of them; those that subcommands accept again are of the command."""
    return [each for name in command_names() for each in _of(_subparsers(make_parser(name))[name], (name,))]


def _of(parser: argparse.ArgumentParser, command: tuple[str, ...]) -> Iterator[PathOption]:
    for action in parser._actions:  # noqa: SLF001 argparse has no other way
        assert action.type is not Path, "what is done with it is declared"
        if action.type in USES and action.default is not argparse.SUPPRESS:
            yield PathOption(command, (action.option_strings or [str(action.metavar)])[-1], str(action.type))
    for word, one in _subparsers(parser).items():
        yield from _of(one, (*command, word))


def path_table() -> str:
    """Return the table of `docs/files.md`: a row for each type of an option."""
    listed: dict[str, dict[str, list[str]]] = {use: {} for use in USES}
    for each in path_options():
        listed[each.use].setdefault(each.name, []).append(" ".join(each.command))
    rows = []
    for use, options in listed.items():
        shown = "; ".join(f"`{name}` of {', '.join(commands)}" for name, commands in options.items())
        rows.append((ANSWERS[use][0], shown.replace("|", "\\|"), *ANSWERS[use][1:]))
    return markdown_table(HEADER, rows)
