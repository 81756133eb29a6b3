"""Folder of an export for a PLC: sources, golden vectors, self-tests, READMEs for who loads it, manifests."""

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from coldloop import __version__
from coldloop.errors import UsageError
from coldloop.parsing import parsed_json
from coldloop.process.settings import RateReference
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS, control_map
from coldloop_export import counting, golden, st_files
from coldloop_export.bit_flips import require_compiler, scored
from coldloop_export.c_files import GuardExport, OdeExport, OptimizerExport
from coldloop_export.exported_optimizer import FOLDER as OPTIMIZER
from coldloop_export.exported_optimizer import MANIFEST, manifest_of
from coldloop_export.kernels import GuardKernels
from coldloop_export.plcopen import plcopen_xml
from coldloop_export.st_pausing import PIECE
from coldloop_export.st_printer import verdict_table
from coldloop_export.tree import filled, template
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem
from coldloop_rig.plc_sizing.budget import problem_of
from coldloop_rig.plc_sizing.plc import ITERATION, ExportCost, PlcProfile, cost_text
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import markdown_table

README: Final = "README.md"
GUARD: Final = "output_guard"
OWN: Final = "with a README and a self-test of its own.\n\n"
BESIDE: Final = f"`{OPTIMIZER}/` has the whole optimiser, `{GUARD}/` the output guard of the control PLC, each {OWN}"
ALONE: Final = ("The whole optimiser is not here: what a process expects of a load (`forecast`) is not exported. "
                f"`{GUARD}/` has the output guard of the control PLC, {OWN}")  # fmt: skip
REFERENCES: Final = {
    RateReference.PER_UPDATE: "Each update may use this rate, however soon it follows the one before.",
    RateReference.ELAPSED: "An update may use the share of this rate for which the outputs have stood still before it.",
}
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
        golden.refuse(settings.optimizer_plc.program)
    texts = solver(target, golden.paper_settings(settings.model.file), ticks, profile)
    if not settings.process.forecasts:
        written = whole_optimizer(target, settings, ticks, profile)
        texts |= {f"{OPTIMIZER}/{name}": text for name, text in written.items()}
    texts |= {f"{GUARD}/{name}": text for name, text in output_guard(target, settings).items()}
    if score:
        texts[MANIFEST] = json.dumps({**parsed_json(texts[MANIFEST]), "bit_flips": scored(texts)}, indent=1)
    write_whole(folder, texts)
    return [folder / name for name in texts]


def solver(target: str, settings: Settings, ticks: int | None, profile: PlcProfile | None) -> dict[str, str]:
    """Return the files of the solver by their names, with its golden vectors.

    Raises:
        UsageError: No input moves in so many ticks.
    """
    recorded = golden.record(settings, ticks or golden.TICKS)
    vectors = telling(recorded, ticks)
    problem, each = vectors[0].problem, len(vectors[0].answer.costs)
    if target == "c":
        export = OdeExport(recorded.method, problem, np.arange(1, each + 1))
        texts, needed, parts = export.files(vectors), export.sizes(vectors), dict[str, str]()
    else:
        text = st_files.StructuredTextExport(recorded.method, problem, vectors)
        texts = in_format(target, "solver.xml", text.files(), "the ODE-based solver, golden vectors and a self-test")
        needed, parts = text.sizes(), {**text_parts(target, text.outputs), "AT_ONCE": str(st_files.AT_ONCE)}
    count = counting.counted_iterations(recorded.method, vectors)
    iterations = len(vectors) * each
    cost = ExportCost(variables=len(problem.phi), operations={ITERATION: count.recorded}, bytes=needed,
                      self_test={"iterations": iterations, "operations": count.total}, **cut(target),
                      longest_period_s=settings.process.sampling_period_s)  # fmt: skip
    readme = filled(template(f"{language(target)}/readme_solver.md"), {
        **parts, "COST": cost_text(cost, profile), "RECORDED": str(iterations),
        "PROBLEM": problem_layout(*problem_of(settings)),
        "OPTIMIZER": ALONE if settings.process.forecasts else BESIDE,
        "N": str(len(problem.phi)), "M": str(len(problem.gamma)), "K": str(each),
        "VECTORS": str(len(vectors)), "FILES": ", ".join(f"`{name}`" for name in texts),
    })  # fmt: skip
    manifest = {"coldloop": __version__, **cost.model_dump(exclude_none=True)}
    return {**texts, README: readme, MANIFEST: json.dumps(manifest, indent=1)}


def whole_optimizer(
    target: str, settings: Settings, ticks: int | None, profile: PlcProfile | None
) -> dict[str, str]:  # fmt: skip
    """Return the files of the whole optimiser by their names, with its golden updates."""
    recorder, process = golden.UpdateRecorder(settings), settings.process
    fixed_ticks = max(SHORTEST_TICKS, process.ticks_per_sample // 2)
    run = ticks or golden.TICKS, golden.LOAD
    updates, recorded = recorder.record(*run, 0.0), recorder.problems()
    updates = [*updates, *recorder.record(*run, fixed_ticks * process.tick_s)]  # the first half is adaptive
    if target == "c":
        export = OptimizerExport(recorder.optimizer, updates)
        texts, needed, parts, name = export.files(), export.sizes(), dict[str, str](), "c/readme_optimizer.md"
    else:
        text = st_files.OptimizerText(recorder.optimizer, updates)
        texts = in_format(target, f"{OPTIMIZER}.xml", text.files(), "the whole optimiser and a self-test")
        texts["registers.md"] = st_files.register_table(control_map(process)) + "\n"
        needed, name = text.sizes(), "structured_text/optimizer/readme.md"
        parts = {**text_parts(target, text.outputs), "DIGEST": str(recorder.optimizer.model_digest)}
    count = counting.counted_iterations(recorded.method, telling(recorded, ticks))
    others = counting.counted_updates(recorder.optimizer, updates[:COUNTED])
    cost = ExportCost(variables=len(recorded.vectors[0].guess), operations={**others, ITERATION: count.recorded},
                      bytes=needed, **cut(target), longest_period_s=process.sampling_period_s)  # fmt: skip
    texts[README] = filled(template(name), {
        **parts, "COST": cost_text(cost, profile),
        "GOLDEN": str(len(updates)), "COUNTED": str(min(COUNTED, len(updates))),
        "FILES": ", ".join(f"`{name}`" for name in texts if not name.endswith(".md")),
    })  # fmt: skip
    texts[MANIFEST] = manifest_of(settings, texts, cost.model_dump(exclude_none=True))
    return texts


def output_guard(target: str, settings: Settings) -> dict[str, str]:
    """Return the files of the control PLC's output guard by their names, with its golden calls."""
    process, kernels, calls = settings.process, GuardKernels(settings.limits), golden.golden_calls(settings.limits)
    export = GuardExport(kernels, calls, process.tick_s) if target == "c" else st_files.GuardText(kernels, calls)
    texts = in_format(target, f"{GUARD}.xml", export.files(), "the output guard and a self-test")
    counts = counting.counted_guard(kernels, calls)
    counts["judgement"] = counts["judgement"].model_copy(update={"worst": counting.counted_longest(kernels)})
    cost = ExportCost(variables=len(process.inputs), operations=counts, bytes=export.sizes())
    said = {} if target == "c" else text_parts(target, st_files.GuardText.outputs)
    texts[README] = filled(template(f"{language(target)}/{GUARD}/readme.md"), {
        **{each: st_files.of_guard(text) for each, text in said.items()},
        "COST": cost_text(cost), "GOLDEN": str(len(calls)), "ROWS": str(SEQUENCE_ROWS),
        "FILES": ", ".join(f"`{each}`" for each in texts),
        "LIMITS": markdown_table(("input", "low", "high", f"most in {process.sampling_period_s:g} s"), [
            (signal, *(f"{each:g}" for each in limits))
            for signal, *limits in zip(process.input_names, *kernels.limits[:3], strict=True)
        ]),
        "REFERENCE": REFERENCES[settings.limits.rate_reference],
        "SLEW_S": f"{kernels.limits.slew_ticks * process.tick_s:g}",
    })  # fmt: skip
    return texts


def telling(recorded: golden.GoldenVectors, ticks: int | None) -> list[golden.GoldenVector]:
    """Return the problems that are golden vectors.

    Raises:
        UsageError: There are none.
    """
    vectors = recorded.telling()
    if not vectors:
        raise UsageError(f"--ticks: no input moves within {ticks} ticks, so nothing would be tested; record more")
    return vectors


def cut(target: str) -> dict[str, Any]:
    """Return how calls are cut: in Structured Text into pieces, in C not."""
    return {} if target == "c" else {"work": st_files.WORK, "piece": PIECE}


def language(target: str) -> str:
    """Return the folder of a target's templates."""
    return "c" if target == "c" else "structured_text"


def in_format(target: str, name: str, texts: dict[str, str], content: str) -> dict[str, str]:
    """Return the files of a target: sources, or one of PLCopen XML."""
    return {name: plcopen_xml(texts.values(), content)} if target == "plcopen" else texts


def text_parts(target: str, outputs: Sequence[str]) -> dict[str, str]:
    """Return what a README of Structured Text says of loading, of calls, and of a self-test's outputs."""
    xml = target == "plcopen"
    return {"LOAD": template(f"structured_text/load_{target}.md").rstrip(),
            "HEAD": "in the documentation of `cl_self_test`" if xml else "at the head of `self_test.st`",
            "WORK": f"{st_files.WORK:,}", "PIECE": f"{PIECE:,}", "VERDICT": verdict_table(outputs)}  # fmt: skip


def problem_layout(problem: PredictiveProblem, prediction: PredictionModel) -> str:
    """Return tables of the elements of z and of the rows of Gamma, with names, units and instants."""
    design, process, behind = problem.design, prediction.process, problem.n_inputs

    def element(step: int, first: int) -> str:  # every `step`-th one of z
        return f"`z[{f'{step} k' if step > 1 else 'k'}{f' + {first}' if first else ''}]`"

    def instants(samples: tuple[int, ...]) -> str:
        return ", ".join(f"{sample * process.sampling_period_s:g}" for sample in samples) + " s"

    inputs = zip(process.input_names, process.input_units, prediction.model.u0, design.input_scale, strict=True)
    variables = [
        (
            element(design.n_inputs, i),
            f"{name} at the decision instant k: ({name} - {at:.6g} {unit}) / {scale:g} {unit}",
        )
        for i, (name, unit, at, scale) in enumerate(inputs)
    ]
    for band, output in enumerate(prediction.constrained):
        for end, where in enumerate(("below", "above")):
            one = process.outputs[output]
            what = f"slack: how far {one.name} is {where} its band there, {one.unit}"
            variables.append((element(design.n_slacks, behind + 2 * band + end), what))
    bands = " and ".join(process.output_names[output] for output in prediction.constrained)
    count = 2 * len(prediction.constrained) * len(design.constraint_instants)
    constrained = instants(design.constraint_instants)
    rows = [(f"0 to {count - 1}", f"{bands}, each below and above its band, at {constrained}")]
    if count < len(problem.Gamma):
        moved = "changes of inputs from one decision instant to the next, up and down"
        rows.append((f"{count} to {len(problem.Gamma) - 1}", moved))
    decided = f"\nDecision instants, k from 0: {instants(design.decision_instants)}.\n"
    return "\n".join([markdown_table(("variable", "what"), variables), decided, markdown_table(("rows", "what"), rows)])


def refuse_taken(folder: Path) -> None:
    """Reject a folder that is not empty, a path that is no folder, and one where no folder can be made.

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
