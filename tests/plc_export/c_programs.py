"""Exported C compiled by the tests."""

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Final

STRICT: Final = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-ffp-contract=off")
COMPILERS: Final = [name for name in ("gcc", "clang") if shutil.which(name)]
NO_COMPILER: Final = "no C compiler: neither gcc nor clang is installed"
SANITIZED: Final = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover")


def write(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files into a folder."""
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="ascii")


def compiled(folder: Path, compiler: str, *options: str, sources: tuple[str, ...] = ("*.c",)) -> Path:
    """Return the program of these sources in a folder, without any warning."""
    made = folder / "-".join(("built", compiler, *options)).replace(" ", "").replace("/", "")
    found = [path for pattern in sources for path in sorted(folder.glob(pattern))]
    result = subprocess.run([compiler, *STRICT, *options, *found, "-lm", "-o", made],
                            capture_output=True, text=True, check=False)  # fmt: skip
    assert result.returncode == 0, result.stderr
    return made


def output(program: Path) -> tuple[int, str]:
    """Return the exit code of a program, and what it says."""
    result = subprocess.run([program], capture_output=True, text=True, check=False)
    return result.returncode, result.stdout + result.stderr
