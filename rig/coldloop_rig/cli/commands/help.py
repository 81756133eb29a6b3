"""Commands about the documentation, the configuration and the shell."""

import argparse
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from coldloop import errors, service
from coldloop_rig.cli.commands.options import configuration

HEADING: Final = re.compile(r"^(#+) +(.+)$")
INSTALLED: Final = Path(__file__).parents[2] / "pages"
"""Folder of the pages in a wheel."""
CHECKOUT: Final = Path(__file__).parents[4] / "docs"


def _declare_docs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("page", nargs="?", metavar="PAGE[#SECTION]",
                        help="such as fail-safe, or budget#what-a-run-grants (default: list pages)")  # fmt: skip


def execute_docs(options: argparse.Namespace) -> int:
    """The pages of the documentation, one of them, or a section of it."""
    found = (INSTALLED if INSTALLED.is_dir() else CHECKOUT).glob("*.md")
    pages = {path.stem: path for path in sorted(found, key=lambda path: path.stem)}
    if options.page is None:
        width = max(map(len, pages), default=0)
        for name, path in pages.items():
            title = next((words for *_, words in headings(path.read_text(encoding="utf-8"))), "")
            sys.stdout.write(f"{name:{width}}  {title}\n")
        return 0
    text = _asked(options.page, pages)
    if sys.stdout.isatty():
        from rich.console import Console
        from rich.markdown import Markdown

        Console().print(Markdown(text))
    else:
        sys.stdout.write(text)
    return 0


def _asked(asked: str, pages: Mapping[str, Path]) -> str:
    name, _, section = asked.removeprefix("docs/").partition("#")
    name = name.removesuffix(".md")
    if name not in pages:
        raise errors.UsageError(f"docs: no page '{name}'; there are {', '.join(pages)}")
    text = pages[name].read_text(encoding="utf-8")
    if not section:
        return text
    evidence = pages.get(f"evidence-{name}")
    for each in (text, "" if evidence is None else evidence.read_text(encoding="utf-8")):
        parts = list(headings(each))
        for place, (first, level, words) in enumerate(parts):
            if anchor(words) == section:
                last = next((line for line, other, _ in parts[place + 1 :] if other <= level), None)
                return "\n".join(each.splitlines()[first:last]) + "\n"
    known = ", ".join(anchor(words) for *_, words in headings(text))
    raise errors.UsageError(f"docs: {name} has no section '{section}'; it has {known}")


def headings(text: str) -> Iterator[tuple[int, int, str]]:
    """Yield line, level and words of each heading."""
    in_code = False
    for number, line in enumerate(text.splitlines()):
        in_code ^= line.startswith("```")
        if not in_code and (found := HEADING.match(line)):
            yield number, len(found[1]), found[2]


def anchor(words: str) -> str:
    """Return the name by which links lead to a heading."""
    return re.sub(r"[^\w\- ]", "", words.lower()).replace(" ", "-")


def _declare_config(parser: argparse.ArgumentParser) -> None:
    service.add_configuration_options(parser)
    parser.add_argument("--keys", action="store_true", help="list all keys and what they mean, as Markdown")


def execute_config(options: argparse.Namespace) -> int:
    """The effective configuration, and where each value comes from."""
    from coldloop.config import as_toml

    if options.keys:
        from coldloop_rig.cli.listings import key_listing
        from coldloop_rig.settings import Settings

        sys.stdout.write(key_listing(Settings))
        return 0
    rows = configuration(options).effective()
    texts = [
        f"# {key} = not set" if value is None else f"{key} = {as_toml(value)}"  # TOML has no word for what is not set
        for key, value, _ in rows
    ]
    width = min(60, max(len(text) for text in texts))
    for text, (_, _, source) in zip(texts, rows, strict=True):
        sys.stdout.write(f"{text.ljust(width)}  # {source}\n")
    return 0


def _declare_completion(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=("bash", "zsh", "fish", "tcsh"))


def execute_completion(options: argparse.Namespace) -> int:
    """A script for a shell's start-up file, such as `eval "$(coldloop completion bash)"`."""
    from argcomplete.shell_integration import shellcode

    sys.stdout.write(shellcode(["coldloop"], shell=options.shell) + "\n")
    return 0
