"""First words and phrases of docstrings, judged by the table in `CONTRIBUTING.md#words`."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OPENINGS = ("Of", "That of", "Those", "What", "Which", "By which", "At which")
PHRASES = ("of what is not", "what is so", "in its name", "taken back")
BANNED = re.compile(rf"(?:{'|'.join(OPENINGS)})\b|.*\b(?:{'|'.join(PHRASES)})\b", re.DOTALL)
CANDIDATE = re.compile(rf'"""\s*(?:{"|".join(OPENINGS)})\b|\b(?:{"|".join(PHRASES)})\b'.replace(" ", r"\s+"))
BETTER = re.compile(r'^\| "([^|]+)" \| ([^|]+) \|$', re.MULTILINE)


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring, also under fields; a command's own is its help text, a message."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("execute_"):
            continue
        body = getattr(node, "body", ())
        for statement in body if isinstance(body, list) else ():
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                yield statement.lineno, " ".join(str(statement.value.value).split())


def findings(source: str) -> list[str]:
    """Return the docstrings that begin with a banned opening or contain a banned phrase, as `line: text`."""
    if not CANDIDATE.search(source):  # parsing all files takes seconds
        return []
    return [f"{line}: {text}" for line, text in docstrings(source) if BANNED.match(text)]


@pytest.mark.parametrize("text", [*(f"{opening} it." for opening in OPENINGS), *(f"A, {one}." for one in PHRASES)])
@pytest.mark.parametrize("place", ['"""{}"""', 'class A:\n    """{}"""', 'def f():\n    """{}"""', 'x = 1\n"""{}"""'])
def test_a_banned_docstring_is_found(place: str, text: str) -> None:
    assert [one.partition(": ")[2] for one in findings(place.format(text))] == [text]
    assert [one.partition(": ")[2] for one in findings(place.format(text.replace(" ", "\n    ")))] == [text]


@pytest.mark.parametrize("text", ["Whether it is so.", "Offset of what is measured.", "Share of the rest."])
def test_an_admitted_docstring_is_not_found(text: str) -> None:
    assert not findings(f'x = 1\n"""{text}"""\ny = f("""What of it?""")\n# of what is not')


@pytest.mark.parametrize("room", ["services", "shared", "rig", "beside"])
def test_docstrings_have_no_banned_words(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    found = [f"{file.relative_to(ROOT)}:{one}" for file in files for one in findings(file.read_text(encoding="utf-8"))]
    assert not found, "first words say what a thing is (CONTRIBUTING.md, Words):\n" + "\n".join(found)


def test_the_table_of_words_has_each_banned_one_and_a_better_form() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("\n## Words\n")[2].partition("\n## ")[0]
    pairs = BETTER.findall(page)
    assert len(pairs) >= 20
    for word in OPENINGS:
        assert any(bad.startswith(f"{word} ") for bad, _ in pairs), word
    for phrase in PHRASES:
        assert any(re.search(rf"\b{phrase}\b", bad) for bad, _ in pairs), phrase
    assert not [better for _, better in pairs if BANNED.match(better)]
