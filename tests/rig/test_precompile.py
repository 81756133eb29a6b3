"""What is compiled beforehand, and when: nothing is left to be compiled in a session."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.results.recording import Recorder
from coldloop_rig.runs.running import make_scenario
from coldloop_rig.settings import Settings

pytestmark = pytest.mark.usefixtures("programs")

ROOT = Path(__file__).parents[2]
OURS = (
    "coldloop", "coldloop_plant", "coldloop_control_plc", "coldloop_optimizer_plc", "coldloop_refrigerator",
    "coldloop_rig",
)  # fmt: skip


def compiled_kernels() -> int:
    """Return how many kernels this process has, for all types, and for calls from Python and from kernels."""
    found = {
        id(value): value
        for name, module in tuple(sys.modules.items())
        if name.partition(".")[0] in OURS
        for value in vars(module).values()
        if isinstance(value, Dispatcher)
    }
    return sum(len(form.overloads) for kernel in found.values() for form in (kernel, kernel.for_kernels))


class FirstTick(Recorder):
    """Counts the kernels when the programs have been made, before the first tick."""

    before = 0

    def begin(self) -> None:
        self.before = compiled_kernels()
        super().begin()


@pytest.mark.parametrize("plant", ["cold-box", "refrigerator"])
def test_making_the_programs_compiles_all_that_a_session_of_them_needs(plant: str) -> None:
    settings = Settings.model_validate({"plant": {"kind": plant, "load": "a"}})
    scenario = make_scenario(settings, 120)
    recorder = FirstTick(scenario.ticks, [])
    OneProcessRig(settings, compiled=False).run(scenario, recorder)
    assert recorder.before == compiled_kernels() > 0


@pytest.mark.parametrize("service", ["plant", "control_plc", "optimizer_plc", "hmi"])
def test_each_image_can_compile_its_part(service: str) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "docker" / "precompile.py", service], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_the_failure_of_one_part_is_that_of_all(tmp_path: Path) -> None:
    (tmp_path / "coldloop_plant").mkdir()
    (tmp_path / "coldloop_plant" / "__init__.py").touch()
    (tmp_path / "coldloop_plant" / "settings.py").write_text("raise ImportError('broken')\n")
    done = subprocess.run(
        [sys.executable, ROOT / "docker" / "precompile.py", "hmi", "plant", "control_plc"],
        check=False, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    assert (done.returncode, "broken" in done.stdout, done.stderr) == (1, True, "")


def test_setup_refuses_a_name_that_it_does_not_know() -> None:
    done = subprocess.run([ROOT / "scripts" / "setup", "build"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "usage: scripts/setup run|study|dev|all\n")
