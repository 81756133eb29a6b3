"""The exported C99 by other compilers, on other processors, for each process: the bits of the kernels."""

import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import pytest

from coldloop.process.cold_box import TICK_S
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits
from coldloop_export.c_files import GuardExport
from coldloop_export.golden import GuardKernels, golden_calls
from coldloop_rig.process_file.making import made_from
from tests.plc_export import problems_file
from tests.plc_export.c_programs import STRICT, write

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "processes"
DRIVER = Path(__file__).with_name("solve_file.c")


class Target(NamedTuple):
    """A compiler, and what runs its programs here."""

    compiler: str
    options: tuple[str, ...] = ()
    runner: tuple[str, ...] = ()

    @property
    def missing(self) -> list[str]:
        return [name for name in (self.compiler, *self.runner) if not shutil.which(name)]


TARGETS = {
    **{f"{name}{level}": Target(name, (level,)) for name in ("gcc", "clang") for level in ("-O0", "-O2", "-O3")},
    "armhf": Target("arm-linux-gnueabihf-gcc", ("-O2", "-static"), ("qemu-arm",)),
    "powerpc, big-endian": Target("powerpc-linux-gnu-gcc", ("-O2", "-static"), ("qemu-ppc",)),
}
PROCESSES = {"cold box": None, "tank": EXAMPLES / "quadruple_tank.toml", "column": EXAMPLES / "wood_berry.toml"}


@pytest.fixture(scope="module", params=PROCESSES)
def problems(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an export, problems of six loads and their answers."""
    folder: Path = tmp_path_factory.mktemp("problems")
    file, model = PROCESSES[request.param], DEFAULT_MODEL_FILE
    if file:
        model = folder / "model.json"
        made_from(file).model.save(model)
    assert problems_file.write(model, folder, 3600, "abcdef") >= 2000
    return folder


def built(target: Target, folder: Path, *sources: str) -> list[str]:
    """Return the command that runs a program, which is compiled without a warning."""
    if target.missing:
        pytest.skip(f"not installed: {', '.join(target.missing)}")
    program = str(folder / "program")
    command = [target.compiler, *STRICT, *target.options, *sources, "-lm", "-o", program]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [*target.runner, program]


@pytest.mark.night
@pytest.mark.parametrize("name", TARGETS)
def test_the_output_guard_passes_its_self_test(tmp_path: Path, name: str) -> None:
    limits = InputLimits(rate=(0.1, 7.7, 1 / 3))
    write(tmp_path, GuardExport(GuardKernels(limits), golden_calls(limits), TICK_S).files())
    program = built(TARGETS[name], tmp_path, *map(str, tmp_path.glob("*.c")))
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout[-13:]) == (0, ", 0 failures\n")


@pytest.mark.night
@pytest.mark.parametrize("name", TARGETS)
def test_problems_of_six_loads_have_the_bits_of_the_kernels(problems: Path, tmp_path: Path, name: str) -> None:
    sources = [problems / "kernels.c", problems / "problem.c", problems / "tables.c", DRIVER]
    program = built(TARGETS[name], tmp_path, f"-I{problems}", *map(str, sources))
    with (problems / "problems").open("rb") as given:
        done = subprocess.run(program, stdin=given, capture_output=True, check=True)
    assert done.stdout == (problems / "answers").read_bytes()
