"""What is exported for a PLC as a folder: sources, golden vectors, self-tests, READMEs for who loads it, manifests."""

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from coldloop import __version__
from coldloop.config import selected
from coldloop.errors import UsageError
from coldloop.parsing import parsed_json
from coldloop.process.limits import RateReference
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS, control_map
from coldloop_optimizer_plc.settings import SHOWN
from coldloop_rig.plc_export.c.bit_flips import require_compiler, scored
from coldloop_rig.plc_export.c.bus_registers import bus_files
from coldloop_rig.plc_export.c.exported_optimizer import FOLDER as OPTIMIZER
from coldloop_rig.plc_export.c.exported_optimizer import MANIFEST, manifest_of
from coldloop_rig.plc_export.c.guard_files import GuardExport
from coldloop_rig.plc_export.c.optimizer_files import OptimizerExport
from coldloop_rig.plc_export.c.solver_files import OdeExport
from coldloop_rig.plc_export.kernels.counted import (
    IterationCounts,
    counted_guard,
    counted_iterations,
    counted_longest,
    counted_updates,
)
from coldloop_rig.plc_export.kernels.golden_calls import golden_calls
from coldloop_rig.plc_export.kernels.guard_program import GuardKernels
from coldloop_rig.plc_export.kernels.recorded_problems import (
    LOAD,
    TICKS,
    GoldenVector,
    GoldenVectors,
    paper_settings,
    record,
)
from coldloop_rig.plc_export.kernels.recorded_updates import GoldenUpdate, UpdateRecorder, refuse
from coldloop_rig.plc_export.problem_layout import problem_layout
from coldloop_rig.plc_export.structured_text.guard_files import GuardText, of_guard
from coldloop_rig.plc_export.structured_text.optimizer_files import OptimizerText
from coldloop_rig.plc_export.structured_text.pausing import PIECE
from coldloop_rig.plc_export.structured_text.plcopen import plcopen_xml
from coldloop_rig.plc_export.structured_text.register_table import register_table
from coldloop_rig.plc_export.structured_text.solver_files import AT_ONCE, WORK, StructuredTextExport
from coldloop_rig.plc_export.structured_text.verdict import verdict_table
from coldloop_rig.plc_export.templates import filled, template
from coldloop_rig.plc_sizing.budget_tables import problem_of
from coldloop_rig.plc_sizing.exported import ITERATION, WHOLE, CallCost, Cut, ExportCost, cost_text
from coldloop_rig.plc_sizing.profile import PlcProfile
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import markdown_table

README: Final = "README.md"
PROJECT: Final = "solver.xml"
GUARD: Final = "output_guard"
OWN: Final = "with a README and a self-test of its own.\n\n"
BESIDE: Final = f"`{OPTIMIZER}/` has the whole optimiser, `{GUARD}/` the output guard of the control PLC, each {OWN}"
ALONE: Final = ("The whole optimiser is not here: what a process expects of a load (`forecast`) is not exported. "
                f"`{GUARD}/` has the output guard of the control PLC, {OWN}")  # fmt: skip
REFERENCES: Final = {
    RateReference.PER_UPDATE: "Each update may use this rate, however soon it follows the one before.",
    RateReference.ELAPSED: "An update may use the share of this rate for which the outputs have stood still before it.",
}
CUT: Final = Cut(WORK, PIECE)
"""How calls are cut in Structured Text; in C each does all of an iteration."""
CUTTING: Final = {"WORK": f"{WORK:,}", "PIECE": f"{PIECE:,}"}
COUNTED: Final = 80
"""Golden updates whose operations are counted."""


def export_plc(
    target: str, ticks: int | None, folder: Path, settings: Settings, profile: PlcProfile | None = None, *,
    score: bool = False,
) -> list[Path]:  # fmt: skip
    """Record problems and write the sources for a target; return the paths.

    Args:
        target: c, st or plcopen.
        ticks: Length of the run that is recorded.
        folder: Where they are written to.
        settings: Of the optimiser.
        profile: The PLC that memory and times are compared with, if any.
        score: Whether the manifest says which changes of one bit the self-tests in C miss.

    Raises:
        UsageError: The folder is not empty or cannot be written to, or no input moves in so many ticks.
    """
    refuse_taken(folder)
    if score:
        require_compiler()
    if not settings.process.forecasts:
        refuse(settings.optimizer_plc.program)
    of_paper = paper_settings(settings.model.file)
    recorded = record(of_paper, ticks or TICKS)
    vectors = telling(recorded, ticks)
    texts = (
        c99(of_paper, recorded, vectors, profile)
        if target == "c"
        else structured_text(of_paper, recorded, vectors, profile, target)
    )
    if not settings.process.forecasts:
        written = whole_optimizer(target, settings, ticks, profile)
        texts |= {f"{OPTIMIZER}/{name}": text for name, text in written.items()}
    texts |= {f"{GUARD}/{name}": text for name, text in output_guard(target, settings).items()}
    if score:
        texts[MANIFEST] = json.dumps({**parsed_json(texts[MANIFEST]), "bit_flips": scored(texts)}, indent=1)
    write_whole(folder, texts)
    return [folder / name for name in texts]


def telling(recorded: GoldenVectors, ticks: int | None) -> list[GoldenVector]:
    """Return the problems that are golden vectors.

    Raises:
        UsageError: There are none.
    """
    vectors = recorded.telling()
    if not vectors:
        raise UsageError(f"--ticks: no input moves within {ticks} ticks, so nothing would be tested; record more")
    return vectors


# -- the solver --------------------------------------------------------------------------------------------------------


def structured_text(
    settings: Settings, recorded: GoldenVectors, vectors: list[GoldenVector], profile: PlcProfile | None, target: str
) -> dict[str, str]:  # fmt: skip
    """Return the files of Structured Text by their names: sources, or one of PLCopen XML."""
    export = StructuredTextExport(recorded.method, vectors[0].problem, vectors)
    texts, sizes = export.files(), export.sizes()
    if target == "plcopen":
        texts = {PROJECT: plcopen_xml(texts.values(), "the ODE-based solver, golden vectors and a self-test")}
    parts = {**loading(target), "AT_ONCE": str(AT_ONCE), **CUTTING, "VERDICT": verdict_table(export.outputs)}
    needed = {"constants": sizes.constants, "an instance of `cl_solver`, with its problem": sizes.solver,
              "self-test and golden vectors": sizes.self_test}  # fmt: skip
    return described(
        "structured_text/readme_solver.md", settings, recorded, vectors, texts, parts, needed, profile, CUT
    )


def c99(
    settings: Settings, recorded: GoldenVectors, vectors: list[GoldenVector], profile: PlcProfile | None
) -> dict[str, str]:  # fmt: skip
    """Return the files of C99 by their names."""
    export = OdeExport(recorded.method, vectors[0].problem, np.arange(1, len(vectors[0].answer.costs) + 1))
    texts, sizes = export.files(vectors), export.sizes(vectors)
    needed = {"constants": sizes.constants, "stack of `solve_problem`, arrays and numbers": sizes.stack,
              "self-test and golden vectors": sizes.self_test}  # fmt: skip
    return described("c/readme_solver.md", settings, recorded, vectors, texts, {}, needed, profile, WHOLE)


def described(
    name: str, settings: Settings, recorded: GoldenVectors, vectors: list[GoldenVector], texts: Mapping[str, str],
    parts: Mapping[str, str], needed: dict[str, int], profile: PlcProfile | None, cut: Cut,
) -> dict[str, str]:  # fmt: skip
    """Return the files with a README, the template of this name with its figures, and a manifest with what it costs."""
    problem, count = vectors[0].problem, counted_iterations(recorded.method, vectors)
    iterations = len(vectors) * len(vectors[0].answer.costs)
    tested = {"iterations": iterations, "operations": count.total}
    cost = ExportCost(variables=len(problem.phi), operations={ITERATION: cost_of(count)}, bytes=needed,
                      self_test=tested, work=cut.work, piece=cut.piece,
                      longest_period_s=settings.process.sampling_period_s)  # fmt: skip
    readme = filled(template(name), {
        **parts, "COST": cost_text(cost, profile), "RECORDED": str(iterations),
        "PROBLEM": problem_layout(*problem_of(settings)),
        "OPTIMIZER": ALONE if settings.process.forecasts else BESIDE,
        "N": str(len(problem.phi)), "M": str(len(problem.gamma)), "K": str(len(vectors[0].answer.costs)),
        "VECTORS": str(len(vectors)), "FILES": ", ".join(f"`{name}`" for name in texts),
    })  # fmt: skip
    manifest = {"coldloop": __version__, **cost.model_dump(exclude_none=True)}
    return {**texts, README: readme, MANIFEST: json.dumps(manifest, indent=1)}


def cost_of(count: IterationCounts) -> CallCost:
    """Return what a call of one iteration takes."""
    recorded = count.recorded
    return CallCost(least=recorded.least, mean=recorded.mean, most=recorded.most, worst=count.worst)


def loading(target: str) -> dict[str, str]:
    """Return what a README of Structured Text says of loading."""
    xml = target == "plcopen"
    return {"LOAD": template(f"structured_text/load_{target}.md").rstrip(),
            "HEAD": "in the documentation of `cl_self_test`" if xml else "at the head of `self_test.st`"}  # fmt: skip


# -- the whole optimiser -----------------------------------------------------------------------------------------------


def whole_optimizer(
    target: str, settings: Settings, ticks: int | None, profile: PlcProfile | None
) -> dict[str, str]:  # fmt: skip
    """Return the files of the whole optimiser by their names, with its golden updates."""
    recorder = UpdateRecorder(settings)
    process = settings.process
    fixed_ticks = max(SHORTEST_TICKS, process.ticks_per_sample // 2)
    periods_s = (0.0, fixed_ticks * process.tick_s)  # the first half of the golden updates is adaptive
    golden = [each for period_s in periods_s for each in recorder.record(ticks or TICKS, LOAD, period_s)]
    write = optimizer_in_c if target == "c" else optimizer_in_text
    name, texts, parts, needed = write(target, settings, recorder, golden)
    recorded = record(settings, ticks or TICKS)
    count = counted_iterations(recorded.method, telling(recorded, ticks))
    others = {call: CallCost(**found._asdict()) for call, found in
              counted_updates(recorder.optimizer, golden[:COUNTED]).items()}  # fmt: skip
    cut = WHOLE if target == "c" else CUT
    cost = ExportCost(variables=len(recorded.vectors[0].guess), operations={**others, ITERATION: cost_of(count)},
                      bytes=needed, work=cut.work, piece=cut.piece,
                      longest_period_s=settings.process.sampling_period_s)  # fmt: skip
    texts[README] = filled(template(name), {
        **parts, "COST": cost_text(cost, profile),
        "GOLDEN": str(len(golden)), "COUNTED": str(min(COUNTED, len(golden))),
        "FILES": ", ".join(f"`{name}`" for name in texts if not name.endswith(".md")),
    })  # fmt: skip
    texts[MANIFEST] = manifest_of(settings, texts, cost.model_dump(exclude_none=True))
    return texts


Written = tuple[str, dict[str, str], dict[str, str], dict[str, int]]
"""Name of the template of the README, files, parts of the README, bytes."""


def optimizer_in_c(_: str, settings: Settings, recorder: UpdateRecorder, golden: list[GoldenUpdate]) -> Written:
    """Return the whole optimiser as C99, with its place on the bus."""
    export = OptimizerExport(recorder.optimizer, golden)
    order, shown = settings.optimizer_plc.word_order, selected(settings, SHOWN)
    texts = {**export.files(), **bus_files(recorder.optimizer, export.kernels, order, shown)}
    sizes = export.sizes()
    needed = {"constants": sizes.constants, "state": sizes.state, "stack, arrays and numbers": sizes.stack}
    return "c/readme_optimizer.md", texts, {}, needed


def optimizer_in_text(
    target: str, _: Settings, recorder: UpdateRecorder, golden: list[GoldenUpdate]
) -> Written:  # fmt: skip
    """Return the whole optimiser as Structured Text or PLCopen XML, with the table of registers."""
    export = OptimizerText(recorder.optimizer, golden)
    texts, sizes = export.files(), export.sizes()
    if target == "plcopen":
        texts = {f"{OPTIMIZER}.xml": plcopen_xml(texts.values(), "the whole optimiser and a self-test")}
    texts["registers.md"] = register_table(control_map(recorder.optimizer.process)) + "\n"
    needed = {"constants": sizes.constants, "state": sizes.state, "instances of the four blocks": sizes.blocks,
              "self-test and golden updates": sizes.self_test}  # fmt: skip
    parts = {**loading(target), **CUTTING, "DIGEST": str(recorder.optimizer.model_digest),
             "VERDICT": verdict_table(export.outputs)}  # fmt: skip
    return "structured_text/optimizer/readme.md", texts, parts, needed


# -- the output guard --------------------------------------------------------------------------------------------------


def output_guard(target: str, settings: Settings) -> dict[str, str]:
    """Return the files of the control PLC's output guard by their names, with its golden calls."""
    process = settings.process
    kernels, golden = GuardKernels(settings.limits), golden_calls(settings.limits)
    export = GuardExport(kernels, golden, process.tick_s) if target == "c" else GuardText(kernels, golden)
    texts, name = export.files(), "c" if target == "c" else "structured_text"
    if target == "plcopen":
        texts = {f"{GUARD}.xml": plcopen_xml(texts.values(), "the output guard and a self-test")}
    counts = {call: CallCost(**found._asdict()) for call, found in counted_guard(kernels, golden).items()}
    counts["judgement"] = counts["judgement"].model_copy(update={"worst": counted_longest(kernels)})
    cost = ExportCost(variables=len(process.inputs), operations=counts, bytes=export.sizes())
    said = {} if target == "c" else {**loading(target), "VERDICT": verdict_table(GuardText.outputs)}
    parts = {each: of_guard(text) for each, text in said.items()}
    texts[README] = filled(template(f"{name}/{GUARD}/readme.md"), {
        **parts, "COST": cost_text(cost), "GOLDEN": str(len(golden)), "ROWS": str(SEQUENCE_ROWS),
        "FILES": ", ".join(f"`{each}`" for each in texts),
        "LIMITS": markdown_table(("input", "low", "high", f"most in {process.sampling_period_s:g} s"), [
            (signal, *(f"{each:g}" for each in limits))
            for signal, *limits in zip(process.input_names, *kernels.limits[:3], strict=True)
        ]),
        "REFERENCE": REFERENCES[settings.limits.rate_reference],
        "SLEW_S": f"{kernels.limits.slew_ticks * process.tick_s:g}",
    })  # fmt: skip
    return texts


# -- files -------------------------------------------------------------------------------------------------------------


def refuse_taken(folder: Path) -> None:
    """Refuse a folder that has something in it, what is no folder, and a place where none can be made.

    Raises:
        UsageError: It is so.
    """
    if not str(folder).isprintable():
        raise UsageError(f"{str(folder)!a}: a name that cannot be printed; choose another --out")
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder}: is not an empty folder; name a new one with --out")
        nearest = next(parent for parent in folder.absolute().parents if parent.exists())
        if not (nearest.is_dir() and os.access(nearest, os.W_OK)):
            raise UsageError(f"{folder}: no folder can be made in {nearest}; choose another --out")
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
