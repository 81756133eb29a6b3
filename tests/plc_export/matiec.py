"""Exported Structured Text compiled by MATIEC, where that is installed, and run."""

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import pytest

COMPILER: Final = shutil.which("iec2c")
MAIN: Final = """
#include <stdio.h>
#include "iec_std_lib.h"
#include "POUS.h"
extern CL_MAIN CL_RESOURCE__CL_PROGRAM;
TIME __CURRENT_TIME;
BOOL __DEBUG;
void config_init__(void);
void config_run__(unsigned long tick);
#define TEST(name) ((int)__GET_VAR(CL_RESOURCE__CL_PROGRAM.TEST.name))
int main(void) {
    config_init__();
    for (unsigned long tick = 0; tick < 1000000 && !TEST(DONE); tick += 1) { config_run__(tick); }
    printf("%d %d %d\\n", TEST(DONE), TEST(PASSED), TEST(WHAT));
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


def self_test(folder: Path, texts: Mapping[str, str], level: str) -> str:
    """Return what the self-test of these texts comes to: done, passed, what failed first."""
    assert COMPILER
    library = Path(COMPILER).resolve().parent / "lib"
    (folder / "all.st").write_text("\n".join(texts.values()))
    (folder / "main.c").write_text(MAIN)
    (folder / "single.h").write_text(SINGLE)
    subprocess.run([COMPILER, "-I", library, "-T", folder, "all.st"], cwd=folder, check=True, capture_output=True)
    sources = ("main.c", "cl_configuration.c", "cl_resource.c")
    flags = ("-w", level, "-ffp-contract=off", "-include", "single.h", f"-I{library / 'C'}", "-I.", "-lm")
    subprocess.run(["gcc", *sources, *flags, "-o", "self_test"], cwd=folder, check=True)
    return subprocess.run(["./self_test"], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
