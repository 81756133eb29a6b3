"""The site of the documentation, built by `scripts/site`: the pages as they are, in the order of `index.md`."""

import re
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
SECTION = re.compile(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL)
OUTSIDE = re.compile(r"\[([^\]]+)\]\(\.\./(?!images|[a-z-]+\.md)([^)#]+)[^)]*\)")
"""Links to files of the sources that are no pages."""

project = "Coldloop"
release = re.search(r'^version = "(.+)"', (HERE.parent / "pyproject.toml").read_text("utf-8"), re.MULTILINE)[1]
extensions = ["myst_parser"]
myst_heading_anchors = 4
exclude_patterns = ["_build"]
suppress_warnings = ["toc.not_included"]  # notes; tests/docs holds that index.md names every other page
html_theme = "furo"
html_title = f"Coldloop {release}"
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False
html_show_search_summary = False  # they are fetched, which pages from files may not do


def prepare(_app: Sphinx, page: str, source: list[str]) -> None:
    """Put the links of `index.md` into the navigation; name files of the sources instead of linking to them."""
    if page == "index":
        for name, body in SECTION.findall(source[0]):
            if links := re.findall(r"^- \[[^\]]+\]\(([\w/-]+)\.md\)", body, re.MULTILINE):
                source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {name}\n\n" + "\n".join(links) + "\n```\n"
    source[0] = OUTSIDE.sub(r"\1 (`\2`)", source[0])


def setup(app: Sphinx) -> None:
    """Connect the hook."""
    app.connect("source-read", prepare)
