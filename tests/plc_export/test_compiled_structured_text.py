"""The exported Structured Text compiled by MATIEC, where that is installed: its self-test passes in native code."""

import shutil
import subprocess
from pathlib import Path

import pytest

from rig.plc_export.kernels.recorded_problems import GoldenVectors
from rig.plc_export.structured_text.solver_files import StructuredTextExport

COMPILER = shutil.which("iec2c")
MAIN = """
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
    for (unsigned long tick = 0; tick < 10000 && !TEST(DONE); tick += 1) { config_run__(tick); }
    printf("%d %d %d\\n", TEST(DONE), TEST(PASSED), TEST(WHAT));
}
"""

pytestmark = pytest.mark.skipif(
    not (COMPILER and shutil.which("gcc")), reason="no iec2c (MATIEC) on PATH, with its lib beside it"
)


@pytest.mark.parametrize("level", ["-O0", "-O2"])
def test_the_self_test_passes_in_native_code(recorded: GoldenVectors, tmp_path: Path, level: str) -> None:
    assert COMPILER
    library = Path(COMPILER).resolve().parent / "lib"
    texts = StructuredTextExport(recorded.method, recorded.vectors[0].problem, recorded.vectors).files()
    (tmp_path / "all.st").write_text("\n".join(texts.values()))
    (tmp_path / "main.c").write_text(MAIN)
    subprocess.run([COMPILER, "-I", library, "-T", tmp_path, "all.st"], cwd=tmp_path, check=True, capture_output=True)
    sources = ("main.c", "cl_configuration.c", "cl_resource.c")
    flags = ("-w", level, "-ffp-contract=off", f"-I{library / 'C'}", "-I.", "-lm")
    subprocess.run(["gcc", *sources, *flags, "-o", "self_test"], cwd=tmp_path, check=True)
    result = subprocess.run(["./self_test"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert result.stdout == "1 1 0\n", "done, passed, what failed first"
