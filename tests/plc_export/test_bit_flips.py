"""Changes of one bit in the tables of linked self-tests: found, but for padding; one that is not summed is named."""

from pathlib import Path
from typing import Final

import pytest

from coldloop.errors import UsageError
from coldloop.process.settings import InputLimits
from coldloop_export.c_files import GuardExport, OdeExport, OptimizerExport
from coldloop_export.folder import flipped
from coldloop_export.golden import GoldenVectors, GuardKernels, golden_calls
from tests.plc_export.c_programs import COMPILERS, NO_COMPILER, write
from tests.plc_export.recorded_optimizers import OPTIMISERS, recorded_updates, recorder

HEADER: Final = """
#include <stdbool.h>
#include <stdint.h>
typedef struct {
    bool on;
    int32_t count;
    const int32_t *values;
} Settings;
extern const Settings settings;
extern const int32_t summed[4];
extern const float forgotten[4];
"""
TABLES: Final = """
#include "tables.h"
const int32_t summed[4] = {1, 2, 3, 4};
const float forgotten[4] = {1.0f, 2.0f, 3.0f, 4.0f};
const Settings settings = {.on = true, .count = 3, .values = summed};
"""
SELF_TEST: Final = """
#include "tables.h"
int main(void) {
    int32_t sum = 0;
    for (int i = 0; i < 4; i += 1) { sum ^= ((const volatile int32_t *)summed)[i]; }
    const unsigned char on = *(const volatile unsigned char *)&settings.on;
    const bool good = sum == @SUM@ && on == 1 && *(const volatile int32_t *)&settings.count == 3;
    return good && *(const int32_t *const volatile *)&settings.values == summed ? 0 : (forgotten[0] == 0.5f) + 1;
}
"""
pytestmark = [
    pytest.mark.usefixtures("compiles", "programs"),
    pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER),
]
each_image = pytest.mark.parametrize("compiler", [(name, level) for name in COMPILERS for level in ("-O0", "-O2")],
                                     ids="".join)  # fmt: skip


def program(folder: Path, total: str = "4") -> Path:
    write(folder, {"tables.h": HEADER, "tables.c": TABLES, "self_test.c": SELF_TEST.replace("@SUM@", total)})
    return folder


def test_a_table_that_is_not_summed_is_named_and_padding_is_apart(tmp_path: Path) -> None:
    found = flipped(program(tmp_path), (COMPILERS[0], "-O2"), count=10_000)
    assert found["changes"] == 8 * (16 + 16 + 16)
    assert {name: {*places} for name, places in found["missed"].items()} == {"forgotten": {*range(16)}}
    assert {name: {*places} for name, places in found["padding"].items()} == {"settings": {1, 2, 3}}


def test_a_self_test_that_fails_as_it_is_gets_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="fails as it is"):
        flipped(program(tmp_path, "5"), (COMPILERS[0], "-O2"))


@pytest.mark.night
@each_image
def test_no_change_of_the_solver_and_the_guard_is_missed(
    tmp_path: Path, recorded: GoldenVectors, compiler: tuple[str, str]
) -> None:
    solver = OdeExport(recorded.method, recorded.vectors)
    guard = GuardExport(GuardKernels(InputLimits()), golden_calls(InputLimits()), 0.25)
    for name, texts in (("solver", solver.files()), ("guard", guard.files())):
        (tmp_path / name).mkdir()
        write(tmp_path / name, texts)
        found = flipped(tmp_path / name, compiler, count=27)
        assert not found["missed"]
        assert found["changes"] > 200


@pytest.mark.night
@each_image
@pytest.mark.parametrize("assignments", OPTIMISERS.values(), ids=OPTIMISERS)
def test_no_change_of_the_whole_optimiser_is_missed(
    tmp_path: Path, compiler: tuple[str, str], assignments: tuple[str, ...]
) -> None:
    write(tmp_path, OptimizerExport(recorder(*assignments).optimizer, recorded_updates(100, "e", *assignments)).files())
    found = flipped(tmp_path, compiler, count=27)
    assert not found["missed"]
    assert {name.rpartition("_")[2] for name in found["padding"]} <= {"constants", "method", "rules", "starts"}
    assert found["changes"] > 1500
