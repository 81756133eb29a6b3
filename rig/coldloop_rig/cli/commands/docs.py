"""`coldloop docs`: the pages of the documentation, one of them, or a section of it."""

import argparse
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from coldloop.errors import UsageError

HEADING: Final = re.compile(r"^(#+) +(.+)$")
FENCE: Final = "```"
INSTALLED: Final = Path(__file__).parents[2] / "pages"
"""Where a wheel has them."""
CHECKOUT: Final = Path(__file__).parents[4] / "docs"


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("page", nargs="?", metavar="PAGE[#SECTION]",
                        help="such as fail-safe, or budget#what-a-run-grants (default: list pages)")  # fmt: skip


def execute(options: argparse.Namespace) -> int:
    """List the pages, or print what is asked for: as Markdown, laid out where it goes to a terminal."""
    found = (INSTALLED if INSTALLED.is_dir() else CHECKOUT).glob("*.md")
    pages = {path.stem: path for path in sorted(found, key=lambda path: path.stem)}
    if options.page is None:
        width = max(map(len, pages), default=0)
        titles = {name: _title(path.read_text(encoding="utf-8")) for name, path in pages.items()}
        sys.stdout.write("".join(f"{name:{width}}  {title}\n" for name, title in titles.items()))
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
        raise UsageError(f"docs: no page '{name}'; there are {', '.join(pages)}")
    text = pages[name].read_text(encoding="utf-8")
    if not section:
        return text
    texts = (
        (text, pages[evidence].read_text(encoding="utf-8")) if (evidence := f"evidence-{name}") in pages else (text,)
    )
    if part := next(filter(None, (_section(each, section) for each in texts)), None):
        return part
    known = ", ".join(anchor(words) for *_, words in headings(text))
    raise UsageError(f"docs: {name} has no section '{section}'; it has {known}")


def headings(text: str) -> Iterator[tuple[int, int, str]]:
    """Yield line, level and words of each heading."""
    in_code = False
    for number, line in enumerate(text.splitlines()):
        in_code ^= line.startswith(FENCE)
        if not in_code and (found := HEADING.match(line)):
            yield number, len(found[1]), found[2]


def _title(text: str) -> str:
    return next((words for *_, words in headings(text)), "")


def anchor(words: str) -> str:
    """Return the name by which links lead to a heading."""
    return re.sub(r"[^\w\- ]", "", words.lower()).replace(" ", "-")


def _section(text: str, section: str) -> str | None:
    parts = list(headings(text))
    for place, (first, level, words) in enumerate(parts):
        if anchor(words) == section:
            last = next((line for line, other, _ in parts[place + 1 :] if other <= level), None)
            return "\n".join(text.splitlines()[first:last]) + "\n"
    return None
