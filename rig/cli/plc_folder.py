"""The solver's source text for a PLC as a folder: sources, golden vectors, self-test, and a README for who loads it."""

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from coldloop.config import selected
from coldloop.errors import UsageError
from coldloop.process.loaded import IS_COLD_BOX
from optimizer_plc.qp.problem import QuadraticProblem
from optimizer_plc.settings import SHOWN
from rig.plc_export.c.bus_registers import bus_files
from rig.plc_export.c.exported_optimizer import FOLDER as OPTIMIZER
from rig.plc_export.c.exported_optimizer import MANIFEST, manifest_of
from rig.plc_export.c.optimizer_files import OptimizerExport
from rig.plc_export.c.solver_files import OdeExport
from rig.plc_export.kernels.recorded_problems import LOAD, TICKS, GoldenVector, GoldenVectors, record
from rig.plc_export.kernels.recorded_updates import UpdateRecorder
from rig.plc_export.structured_text.plcopen import plcopen_xml
from rig.plc_export.structured_text.solver_files import AT_ONCE, StructuredTextExport
from rig.plc_export.templates import filled, template
from rig.plc_sizing.operations import Operations, gradient, ode
from rig.plc_sizing.sizes import dense_sizes
from rig.settings import Settings

README: Final = "README.md"
PROJECT: Final = "solver.xml"
BESIDE: Final = f"`{OPTIMIZER}/` has the whole optimiser, with a README and a self-test of its own.\n\n"
FIXED_S: Final = 2.5
"""Updating period of the second half of the golden updates; that of the first is adaptive."""


def export_plc(target: str, ticks: int | None, folder: Path, settings: Settings) -> list[Path]:
    """Record problems and write the sources for a target; return the paths.

    Args:
        target: c, st or plcopen.
        ticks: Length of the run that is recorded.
        folder: Where they are written to.
        settings: Of the optimiser.

    Raises:
        UsageError: The folder is not empty or cannot be written to, or no input moves in so many ticks.
    """
    refuse_taken(folder)
    recorded = record(ticks or TICKS)
    vectors = recorded.telling()
    if not vectors:
        raise UsageError(f"--ticks: no input moves within {ticks} ticks, so nothing would be tested; record more")
    texts = c99(recorded, vectors) if target == "c" else structured_text(recorded, vectors, xml=target == "plcopen")
    if target == "c" and IS_COLD_BOX:
        texts |= whole_optimizer(settings, ticks or TICKS)
    write_whole(folder, texts)
    return [folder / name for name in texts]


def structured_text(recorded: GoldenVectors, vectors: list[GoldenVector], *, xml: bool) -> dict[str, str]:
    """Return the files of Structured Text by their names: sources, or one of PLCopen XML."""
    export = StructuredTextExport(recorded.method, vectors[0].problem, vectors)
    texts, sizes = export.files(), export.sizes()
    if xml:
        texts = {PROJECT: plcopen_xml(texts.values(), "the ODE-based solver, golden vectors and a self-test")}
    return {**texts, README: readme("structured_text/readme_solver.md", vectors, texts, {
        "LOAD": template("structured_text/load_plcopen.md" if xml else "structured_text/load_st.md").rstrip(),
        "HEAD": "in the documentation of `cl_self_test`" if xml else "at the head of `self_test.st`",
        "AT_ONCE": str(AT_ONCE), "CALLS": str(export.calls()), "CONSTANTS": f"{sizes.constants:,}",
        "SOLVER": f"{sizes.solver:,}", "SELF_TEST": f"{sizes.self_test:,}",
    })}  # fmt: skip


def c99(recorded: GoldenVectors, vectors: list[GoldenVector]) -> dict[str, str]:
    """Return the files of C99 by their names."""
    export = OdeExport(recorded.method, vectors[0].problem, np.arange(1, len(vectors[0].answer.costs) + 1))
    texts, sizes = export.files(vectors), export.sizes(vectors)
    return {**texts, README: readme("c/readme_solver.md", vectors, texts, {
        "OPTIMIZER": BESIDE if IS_COLD_BOX else "",
        "CONSTANTS": f"{sizes.constants:,}", "STACK": f"{sizes.stack:,}", "SELF_TEST": f"{sizes.self_test:,}",
    })}  # fmt: skip


def whole_optimizer(settings: Settings, ticks: int) -> dict[str, str]:
    """Return the files of the whole optimiser by their names, with its golden updates."""
    recorder = UpdateRecorder(settings)
    golden = [each for period_s in (0.0, FIXED_S) for each in recorder.record(ticks, LOAD, period_s)]
    export = OptimizerExport(recorder.optimizer, golden)
    shown = selected(settings, SHOWN)
    order = settings.optimizer_plc.word_order
    texts = {**export.files(), **bus_files(recorder.optimizer, export.kernels, order, shown)}
    sizes = export.sizes()
    texts[README] = filled(template("c/readme_optimizer.md"), {
        "GOLDEN": str(len(golden)), "CONSTANTS": f"{sizes.constants:,}", "STATE": f"{sizes.state:,}",
        "STACK": f"{sizes.stack:,}",
    })  # fmt: skip
    texts[MANIFEST] = manifest_of(settings, texts)
    return {f"{OPTIMIZER}/{name}": text for name, text in texts.items()}


def readme(name: str, vectors: list[GoldenVector], texts: Mapping[str, str], parts: Mapping[str, str]) -> str:
    """Return the README: the template of this name with its figures."""
    problem = vectors[0].problem
    return filled(template(name), {
        **parts,
        "N": str(len(problem.phi)), "M": str(len(problem.gamma)), "K": str(len(vectors[0].answer.costs)),
        "VECTORS": str(len(vectors)), "FILES": ", ".join(f"`{name}`" for name in texts),
        "FEWEST": f"{operations(problem, 0):,}", "MOST": f"{operations(problem, len(problem.gamma)):,}",
    })  # fmt: skip


def operations(problem: QuadraticProblem, active: int) -> int:
    """Return the operations of an iteration with so many active rows, no zero left out, where a bound cuts the step.

    That takes the velocity four times: before, in between, behind, and behind once more at the bound.
    """
    n, m = len(problem.phi), len(problem.gamma)
    sizes = dense_sizes(n, m, n)
    return round(ode(sizes, active).plus(gradient(sizes, active), Operations(n)).flops)


def refuse_taken(folder: Path) -> None:
    """Refuse a folder that has something in it, and what is no folder.

    Raises:
        UsageError: It is so.
    """
    if not str(folder).isprintable():
        raise UsageError(f"{str(folder)!a}: a name that cannot be printed; choose another --out")
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder}: is not an empty folder; name a new one with --out")
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; choose another --out") from None


def write_whole(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files into a folder that appears with all of them, or not at all.

    Raises:
        UsageError: It cannot be written, or something has been put there meanwhile.
    """
    draft = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        for name, text in texts.items():
            (draft / name).parent.mkdir(parents=True, exist_ok=True)
            (draft / name).write_text(text, encoding="ascii")
        draft.chmod(0o755)
        draft.replace(folder)
    except OSError as error:
        if draft:
            shutil.rmtree(draft, ignore_errors=True)
        raise UsageError(f"{folder}: {error.strerror}; choose another --out") from None
