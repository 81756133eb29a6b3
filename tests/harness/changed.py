"""Tests that a change can reach, by the imports of their files: `scripts/test --changed BASE`.

It is for people who wait; what starts programs or calls the command line reaches everything. CI runs all tests.
"""

import ast
import subprocess
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[2]
SOURCES: Final = ("shared", "services/*", "rig", "beside/*")
"""Folders whose folders are packages."""
EVERYWHERE: Final = ("pyproject.toml", "requirements/", "tests/conftest.py", "tests/harness/", "scripts/setup")
"""Files whose change can reach every test."""
REACHING_ALL: Final = frozenset({"coldloop", "processes", "shared_processes", "programs", "compiles", "served", "site"})
"""Fixtures that call the command line or start programs."""


def changed_files(base: str, root: Path = ROOT) -> frozenset[str]:
    """Return the files that differ from a commit, with those that Git does not know yet.

    Raises:
        pytest.UsageError: Git knows no such commit.
    """
    found: set[str] = set()
    for words in (("diff", "--name-only", "--no-renames", base, "--"), ("ls-files", "--others", "--exclude-standard")):
        done = subprocess.run(("git", *words), cwd=root, capture_output=True, text=True, check=False)
        if done.returncode:
            raise pytest.UsageError(
                f"--changed {base}: {done.stderr.strip().splitlines()[0]}; name a commit or a branch"
            )
        found.update(done.stdout.splitlines())
    return frozenset(found)


@cache
def modules(root: Path = ROOT) -> Mapping[str, Path]:
    """Return the modules of the project and of its tests by their names."""
    tops = [top for pattern in SOURCES for top in sorted(root.glob(pattern)) if top.is_dir()]
    files = [(top, file) for top in tops for file in sorted(top.glob("*/**/*.py"))]
    files += [(root, file) for file in sorted((root / "tests").rglob("*.py"))]
    return {
        ".".join(file.relative_to(top).with_suffix("").parts).removesuffix(".__init__"): file for top, file in files
    }


@cache
def imported(file: Path) -> frozenset[str]:
    """Return the names that a file imports, anywhere in it; `from a import b` may name the module `a.b`."""
    found = set[str]()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update({node.module}, (f"{node.module}.{alias.name}" for alias in node.names))
    return frozenset(found)


def reached(files: Iterable[Path], root: Path = ROOT) -> frozenset[str]:
    """Return the files, relative to the root, that are executed when these are imported, these among them."""
    known, found, left = modules(root), set[Path](), [*files]
    while left:
        file = left.pop()
        if file in found:
            continue
        found.add(file)
        for name in imported(file):
            parts = name.split(".")
            left += [known[each] for k in range(len(parts)) if (each := ".".join(parts[: k + 1])) in known]
    return frozenset(file.relative_to(root).as_posix() for file in found)


def can_reach(test: Path, fixtures: Iterable[str], changed: Iterable[str], root: Path = ROOT) -> bool:
    """Return whether a change of these files can reach a test of this file with these fixtures."""
    changed = [*changed]
    if REACHING_ALL.intersection(fixtures) or any(file.startswith(EVERYWHERE) for file in changed):
        return bool(changed)
    text, near = test.read_text(encoding="utf-8"), test.with_name("conftest.py")
    own = reached([test, *([near] if near.exists() and near.parent != root / "tests" else [])], root)
    folders = {PurePosixPath(file).parent.as_posix() for file in own}
    return any(
        file in own if file.endswith(".py") and not file.startswith(("docs/", "examples/", "benchmarks/", "docker/"))
        else PurePosixPath(file).parent.as_posix() in folders or test.parent.name == "docs"
        or file.partition("/")[0] in text or PurePosixPath(file).name in text
        for file in changed
    )  # fmt: skip
