"""Exported Structured Text compiled by MATIEC, where that is installed, and run."""

import re
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import pytest

from coldloop_export.tree import filled

COMPILER: Final = shutil.which("iec2c")
MAIN: Final = """
#include <stdio.h>
#include "iec_std_lib.h"
#include "POUS.h"
@PROGRAMS@
TIME __CURRENT_TIME;
BOOL __DEBUG;
void config_init__(void);
void config_run__(unsigned long tick);
#define TEST(program, name) ((int)__GET_VAR(program.TEST.name))
int main(void) {
    config_init__();
    for (unsigned long tick = 0; tick < 1000000 && !(@DONE@); tick += 1) { config_run__(tick); }
@SAID@
}
"""
SINGLE: Final = """
#include <math.h>
#define pow(base, exponent) powf(base, exponent)
#define log(value) logf(value)
"""
"""MATIEC computes EXPT and LN of REAL in double precision, the kernels in single."""
NEEDS_MATIEC: Final = pytest.mark.skipif(
    not (COMPILER and shutil.which("gcc")), reason="no iec2c (MATIEC) on PATH, with its lib beside it"
)


def joined(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """Return the texts of two exports as one project: lists, task and program of one configuration in the other."""
    ours, theirs = one["configuration.st"], other["configuration.st"]
    lists, tasks = theirs.partition("CONFIGURATION")[2].partition("RESOURCE")[::2]
    ours = ours.replace("RESOURCE", lists.partition("\n")[2] + "RESOURCE", 1)
    for line in re.findall("    (?:TASK|PROGRAM) .*\n", tasks):
        ours = ours.replace("    PROGRAM", f"{line}    PROGRAM", 1)
    return [*(text for texts in (one, other) for name, text in texts.items() if name != "configuration.st"), ours]


def self_test(folder: Path, texts: Iterable[str], level: str) -> str:
    """Return what each self-test of these texts comes to: done, passed, what failed first."""
    assert COMPILER
    library, text = Path(COMPILER).resolve().parent / "lib", "\n".join(texts)
    (folder / "all.st").write_text(text)
    resource = re.findall(r"^RESOURCE (\w+)", text, re.MULTILINE)[0]
    programs = [(kind, f"{resource}__{name}".upper())
                for name, kind in re.findall(r"^    PROGRAM (\w+) WITH \w+ : (\w+);", text, re.MULTILINE)]  # fmt: skip
    (folder / "main.c").write_text(filled(MAIN, {
        "PROGRAMS": "\n".join(f"extern {kind.upper()} {name};" for kind, name in programs),
        "DONE": " && ".join(f"TEST({name}, DONE)" for _, name in programs),
        "SAID": "\n".join(f'    printf("%d %d %d\\n", TEST({name}, DONE), TEST({name}, PASSED), TEST({name}, WHAT));'
                          for _, name in programs),
    }))  # fmt: skip
    (folder / "single.h").write_text(SINGLE)
    subprocess.run([COMPILER, "-I", library, "-T", folder, "all.st"], cwd=folder, check=True, capture_output=True)
    sources = ("main.c", f"{resource.partition('_')[0]}_configuration.c", f"{resource}.c")
    flags = ("-w", level, "-ffp-contract=off", "-include", "single.h", f"-I{library / 'C'}", "-I.", "-lm")
    subprocess.run(["gcc", *sources, *flags, "-o", "self_test"], cwd=folder, check=True)
    return subprocess.run(["./self_test"], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
