"""Compile numerical kernels before they are needed: `python precompile.py PART...`.

An image takes the part of its service. Several parts are done in parallel, with what is left on standard error, their
own output on standard output.
"""  # noqa: INP001 a program

import compileall
import os
import re
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from coldloop_optimizer_plc.program import OptimizerProgram
    from coldloop_optimizer_plc.settings import ProgramSettings
    from coldloop_plant.settings import PlantKind
    from coldloop_refrigerator.program import RefrigeratorKind

LOOK_S: Final = 0.2
WAITING: Final = 2
"""Processes beside those that the cores have work for: some wait for kernels that others compile."""
ROOT: Final = Path(__file__).parents[1]
SELDOM: Final = re.compile(r"/site-packages/(.*/tests?/|(pip|setuptools|mypy|mypyc)/)")
"""Of the packages: tests of theirs, and what is no module of a program; a third of all."""


def plant() -> None:
    """Make each plant that is ours, which compiles its kernels."""
    from coldloop_plant.settings import PlantKind  # noqa: PLC0415 not in every image
    from coldloop_refrigerator.program import RefrigeratorKind  # noqa: PLC0415

    _make_plant(PlantKind.COLD_BOX)
    _make_plant(PlantKind.REFRIGERATOR, RefrigeratorKind)  # a set-up has no entry points yet


def default_plant() -> None:
    """Make the plant of the default settings."""
    from coldloop_plant.settings import PlantSection  # noqa: PLC0415

    import_module("coldloop_plant.runtime")
    _make_plant(PlantSection().kind)


def _make_plant(kind: "PlantKind", brought: "type[RefrigeratorKind] | None" = None) -> None:
    from coldloop.process.load_profile import LoadProfile  # noqa: PLC0415
    from coldloop.process.model_file import read_header  # noqa: PLC0415
    from coldloop.process.settings import DEFAULT_MODEL_FILE  # noqa: PLC0415
    from coldloop_plant.kinds import plant_maker  # noqa: PLC0415
    from coldloop_plant.settings import PlantSection  # noqa: PLC0415

    header, section = read_header(DEFAULT_MODEL_FILE), PlantSection(kind=kind)
    make = brought().maker_of(header, section, lambda _: None) if brought else plant_maker(header, section)
    make(LoadProfile((0,), (header.w0,)), 1)


def nothing() -> None:
    """Compile nothing: the control PLC and the page have no kernels."""


def optimizer_plc() -> None:
    """Make the program with each solver that has kernels of its own, in each precision, which compiles them."""
    for arithmetic in ("float32", "float64"):
        solvers_in(arithmetic)()


def solvers_in(arithmetic: str) -> Callable[[], None]:
    """Return what makes the program with each solver that has kernels of its own, in one precision."""

    def make() -> None:
        from coldloop_optimizer_plc.settings import SINGLE_PRECISION_SOLVERS, ProgramSettings  # noqa: PLC0415

        for solver in SINGLE_PRECISION_SOLVERS:
            _make_optimizer(ProgramSettings.model_validate({"solver": solver, "arithmetic": arithmetic}))

    return make


def default_optimizer() -> None:
    """Make the program of the default settings."""
    from coldloop_optimizer_plc.settings import ProgramSettings  # noqa: PLC0415

    import_module("coldloop_optimizer_plc.runtime")
    _make_optimizer(ProgramSettings())


def default_solver() -> None:
    """Compile what solves before what plans, which the program compiles first and another part meanwhile.

    Kernels are the same whatever the estimator; this one takes no gains.
    """
    from coldloop_optimizer_plc import scheme  # noqa: PLC0415
    from coldloop_optimizer_plc.program import OptimizerProgram  # noqa: PLC0415
    from coldloop_optimizer_plc.settings import ProgramSettings  # noqa: PLC0415

    class SolvesFirst(OptimizerProgram):
        def _compile_kernels(self, *_: object) -> None:
            self.restart(0.0)
            self.state.numbers["ticks"], self.state.numbers["iterations"] = 4, 2
            scheme.solve(self.constants, self.method, self.state)

    _make_optimizer(ProgramSettings.model_validate({"estimator": {"kind": "state-feedback"}}), SolvesFirst)


def _make_optimizer(settings: "ProgramSettings", kind: "type[OptimizerProgram] | None" = None) -> None:
    from coldloop.process.lti_model import load  # noqa: PLC0415
    from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits  # noqa: PLC0415
    from coldloop_optimizer_plc.program import OptimizerProgram  # noqa: PLC0415

    (kind or OptimizerProgram)(load(DEFAULT_MODEL_FILE), settings, InputLimits())


def in_one_process(**changes: Any) -> Callable[[], None]:  # noqa: ANN401 sections of the configuration
    """Return what lets a minute pass in one process: the compiled loop, and the programs for what is unusual."""

    def minute() -> None:
        from coldloop_rig.cosim.one_process import OneProcessRig  # noqa: PLC0415 not in the images
        from coldloop_rig.results.recording import Recorder  # noqa: PLC0415
        from coldloop_rig.runs.running import make_scenario  # noqa: PLC0415
        from coldloop_rig.settings import Settings  # noqa: PLC0415

        settings = Settings.model_validate(changes)
        scenario = make_scenario(settings, 240)
        OneProcessRig(settings, compiled=True).run(scenario, Recorder(scenario.ticks))

    return minute


def linear_models() -> None:
    """Linearise both plants, which takes kernels of complex numbers."""
    from coldloop.process.settings import DEFAULT_MODEL_FILE  # noqa: PLC0415
    from coldloop_optimizer_plc.settings import ControlDesign  # noqa: PLC0415
    from coldloop_plant.cold_box.plant_file import PlantFile  # noqa: PLC0415
    from coldloop_refrigerator.model import make_refrigerator_file  # noqa: PLC0415
    from coldloop_rig.cli.listings import describe_model  # noqa: PLC0415 not in the images

    describe_model(DEFAULT_MODEL_FILE, PlantFile(), ControlDesign())
    make_refrigerator_file()


def transfer_functions() -> None:
    """Let a minute of a plant of transfer functions pass."""
    from coldloop_rig import simulate  # noqa: PLC0415 not in the images

    import_module("coldloop_rig.cosim.compiled.own_plants")  # what it registers counts in the names of kernels
    simulate("a", process=ROOT / "examples" / "processes" / "wood_berry.toml", duration_s=60)


def run_modules() -> None:
    """Import what a run needs besides kernels, so that its bytecode is written."""
    for module in (
        "control_plc.runtime", "rig.cli", "rig.cli.commands.runs", "rig.runs.running", "rig.cosim.networked_run",
        "rig.cosim.one_process", "rig.progress", "rig.figures.worker", "rig.figures.plot",
    ):  # fmt: skip
        import_module(f"coldloop_{module}")


def all_modules() -> None:
    """Write the bytecode of the project and of what is installed, but for tests and what is seldom imported."""
    projects = [
        find_spec(name)
        for name in (
            "coldloop",
            "coldloop_plant",
            "coldloop_refrigerator",
            "coldloop_control_plc",
            "coldloop_optimizer_plc",
            "coldloop_hmi",
            "coldloop_rig",
        )
    ]
    folders = [place for spec in projects if spec for place in spec.submodule_search_locations or ()]
    for folder in (*folders, sysconfig.get_path("purelib")):
        compileall.compile_dir(folder, quiet=2, rx=SELDOM)  # some packages have templates that are no Python


def tests() -> None:
    """Write the bytecode of the tests, whose assertions pytest rewrites; each of its workers would."""
    import pytest  # noqa: PLC0415 only for who develops

    pytest.main(["--collect-only", "--quiet", f"--rootdir={ROOT}", str(ROOT / "tests")])


PARTS: Final[dict[str, tuple[Callable[[], None], int]]] = {
    "plant": (plant, 20),
    "control_plc": (nothing, 1),
    "optimizer_plc": (optimizer_plc, 25),
    "hmi": (nothing, 1),
    "solvers": (solvers_in("float64"), 15),
    "single-precision-solvers": (solvers_in("float32"), 20),
    "default-plant": (default_plant, 9),
    "default-solver": (default_solver, 13),
    "default-optimizer": (default_optimizer, 10),
    "cold-box-in-one-process": (in_one_process(), 55),
    "refrigerator-in-one-process": (in_one_process(plant={"kind": "refrigerator", "load": "a"}), 27),
    "single-precision-in-one-process": (in_one_process(optimizer_plc={"program": {"arithmetic": "float32"}}), 25),
    "interior-point-in-one-process": (in_one_process(optimizer_plc={"program": {"solver": "interior-point"}}), 25),
    "hybrid-in-one-process": (in_one_process(optimizer_plc={"program": {"solver": "hybrid"}}), 25),
    "fast-gradient-in-one-process": (in_one_process(optimizer_plc={"program": {"solver": "fast-gradient"}}), 25),
    "linear-models": (linear_models, 20),
    "transfer-functions": (transfer_functions, 5),
    "run-modules": (run_modules, 4),
    "all-modules": (all_modules, 13),
    "tests": (tests, 9),
}
"""What compiles each part, and about how many seconds of a core that takes."""


def compile_parts(parts: Sequence[str]) -> bool:
    """Compile parts in parallel, those first that are named first; return whether all went well."""
    waiting, processes, done = list(parts), dict[str, subprocess.Popen[bytes]](), set[str]()
    cores, began = os.cpu_count() or 1, time.monotonic()
    total_s = max(sum(PARTS[part][1] for part in parts) / cores, *(PARTS[part][1] for part in parts))
    try:
        while len(done) < len(parts):
            while waiting and len(processes) - len(done) < cores + WAITING:
                part = waiting.pop(0)
                processes[part] = subprocess.Popen((sys.executable, __file__, part), stderr=subprocess.STDOUT)  # noqa: S603 ourselves
            _show(f"compiling: {len(done)} of {len(parts)} parts, {_left(total_s - time.monotonic() + began)}")
            time.sleep(LOOK_S)
            done = {part for part, process in processes.items() if process.poll() is not None}
    finally:
        for process in processes.values():
            process.kill()
        _show("")
    return not any(process.returncode for process in processes.values())


def _left(seconds: float) -> str:
    return f"about {seconds:.0f} s left" if seconds > 1 else "almost done"


def _show(line: str) -> None:
    """Show the present state on a terminal, in a line that changes."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{line and 'coldloop: '}{line}")
        sys.stderr.flush()


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # a script's shell has SIGINT ignored in the background
        signal.signal(number, signal.default_int_handler)
    if len(sys.argv) == 2:
        PARTS[sys.argv[1]][0]()
        sys.exit()
    try:
        sys.exit(not compile_parts(sys.argv[1:]))
    except KeyboardInterrupt:  # who called us ends too when we end by the signal
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)
