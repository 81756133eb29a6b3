"""All commands and their options as Markdown: `python -m coldloop_rig.cli.command_listing` makes `docs/commands.md`."""

import argparse
import sys
from collections.abc import Iterator
from typing import Final

from coldloop_rig.cli import GROUPS, make_parser
from coldloop_rig.text_tables import markdown_table

HEADER: Final = ("option", "meaning")


def command_listing() -> str:
    """Return a section for each group of commands, with a table of the options of each."""
    parts = []
    for group, commands in GROUPS.items():
        parts.append(f"## {group[0].upper()}{group[1:]}\n")
        for name in commands:
            parts += _of(_subparsers(make_parser(name))[name], f"coldloop {name}", "###")
    return "\n".join(parts)


def _of(parser: argparse.ArgumentParser, name: str, level: str) -> Iterator[str]:
    summary = (parser.description or "").partition(": ")[2] or parser.description or ""
    yield f"{level} `{name}`\n"
    if summary.strip():
        yield f"{_cell(summary.strip()[0].upper() + summary.strip()[1:])}\n"
    actions = [each for each in parser._actions if each.dest != "help"]  # noqa: SLF001 argparse has no other way
    rows = [
        (_name(each), _cell(each.help or ""))
        for each in actions
        if each.help != argparse.SUPPRESS and not isinstance(each, argparse._SubParsersAction)  # noqa: SLF001
    ]
    if rows:
        yield f"{markdown_table(HEADER, rows)}\n"
    for sub, one in _subparsers(parser).items():
        yield from _of(one, f"{name} {sub}", f"{level}#")


def _subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found: dict[str, argparse.ArgumentParser] = {}
    for each in parser._actions:  # noqa: SLF001
        if isinstance(each, argparse._SubParsersAction):  # noqa: SLF001
            found |= each.choices
    return found


def _name(action: argparse.Action) -> str:
    """Return how an option or an argument is written, with its value."""
    value = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    values = " ".join(value) if isinstance(value, tuple) else value
    if not action.option_strings:
        return f"`{values}`".replace("|", "\\|")
    shown = (f"{option} {values}" if action.nargs != 0 else option for option in action.option_strings)
    return f"`{', '.join(shown)}`".replace("|", "\\|")


def _cell(text: str) -> str:
    return " ".join(text.replace("%%", "%").split()).replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(command_listing())
