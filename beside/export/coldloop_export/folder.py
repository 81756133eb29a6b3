"""Folder of an export for a PLC: sources, golden vectors, self-tests, READMEs for who loads it, manifests; its score.

The score counts one-bit changes of an exported program's tables that its self-test misses, in the image that a linker
makes.
"""

import ctypes
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any, Final, TypedDict

from coldloop import __version__
from coldloop.errors import UsageError
from coldloop.process.settings import RateReference
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS, control_map
from coldloop.text import parsed_json
from coldloop_export import counting, golden, st_files
from coldloop_export.c_files import GuardExport, OdeExport, OptimizerExport
from coldloop_export.exported_optimizer import FOLDER as OPTIMIZER
from coldloop_export.exported_optimizer import MANIFEST, manifest_of
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
    if score and not (shutil.which("gcc") and shutil.which("readelf")):
        raise UsageError("--score: needs gcc and readelf: on Debian, install gcc")
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

    Raises UsageError if no input moves in so many ticks.
    """
    recorded = golden.record(settings, ticks or golden.TICKS)
    vectors = telling(recorded, ticks)
    problem, each, given = vectors[0].problem, len(vectors[0].answer.costs), (recorded.method, vectors)
    export = OdeExport(*given) if target == "c" else st_files.StructuredTextExport(*given)
    texts = in_format(target, "solver.xml", export.files(), "the ODE-based solver, golden vectors and a self-test")
    count = counting.counted_iterations(recorded.method, vectors)
    iterations = len(vectors) * each
    cost = ExportCost(variables=len(problem.phi), operations={ITERATION: count.recorded}, bytes=export.sizes(),
                      self_test={"iterations": iterations, "operations": count.total}, **cut(target),
                      longest_period_s=settings.process.sampling_period_s)  # fmt: skip
    readme = filled(template(f"{language(target)}/readme_solver.md"), {
        **text_parts(target, export.outputs), "COST": cost_text(cost, profile), "RECORDED": str(iterations),
        "PROBLEM": problem_layout(*problem_of(settings)),
        "OPTIMIZER": ALONE if settings.process.forecasts else BESIDE,
        "N": str(len(problem.phi)), "M": str(len(problem.gamma)), "K": str(each),
        "VECTORS": str(len(vectors)), "FILES": ", ".join(f"`{name}`" for name in texts),
    })  # fmt: skip
    manifest = {"coldloop": __version__, **cost.model_dump(exclude_none=True)}
    return {**texts, README: readme, MANIFEST: json.dumps(manifest, indent=1)}


def whole_optimizer(target: str, settings: Settings, ticks: int | None, profile: PlcProfile | None) -> dict[str, str]:
    """Return the files of the whole optimiser by their names, with its golden updates."""
    recorder, process = golden.UpdateRecorder(settings), settings.process
    fixed_ticks = max(SHORTEST_TICKS, process.ticks_per_sample // 2)
    run = ticks or golden.TICKS, golden.LOAD
    updates, recorded = recorder.record(*run, 0.0), recorder.problems()
    updates = [*updates, *recorder.record(*run, fixed_ticks * process.tick_s)]  # the first half is adaptive
    given = recorder.optimizer, updates
    export = OptimizerExport(*given) if target == "c" else st_files.OptimizerText(*given)
    texts = in_format(target, f"{OPTIMIZER}.xml", export.files(), "the whole optimiser and a self-test")
    if target != "c":
        texts["registers.md"] = st_files.register_table(control_map(process)) + "\n"
    count = counting.counted_iterations(recorded.method, telling(recorded, ticks))
    others = counting.counted_updates(recorder.optimizer, updates[:COUNTED])
    cost = ExportCost(variables=len(recorded.vectors[0].guess), operations={**others, ITERATION: count.recorded},
                      bytes=export.sizes(), **cut(target), longest_period_s=process.sampling_period_s)  # fmt: skip
    texts[README] = filled(template(f"{language(target)}/{OPTIMIZER}/readme.md"), {
        **text_parts(target, export.outputs), "COST": cost_text(cost, profile),
        "DIGEST": str(recorder.optimizer.model_digest),
        "GOLDEN": str(len(updates)), "COUNTED": str(min(COUNTED, len(updates))),
        "FILES": ", ".join(f"`{name}`" for name in texts if not name.endswith(".md")),
    })  # fmt: skip
    texts[MANIFEST] = manifest_of(settings, texts, cost.model_dump(exclude_none=True))
    return texts


def output_guard(target: str, settings: Settings) -> dict[str, str]:
    """Return the files of the control PLC's output guard by their names, with its golden calls."""
    process, limits = settings.process, settings.limits
    kernels, calls = golden.GuardKernels(limits), golden.golden_calls(limits)
    export = GuardExport(kernels, calls, process.tick_s) if target == "c" else st_files.GuardText(kernels, calls)
    texts = in_format(target, f"{GUARD}.xml", export.files(), "the output guard and a self-test")
    counts = counting.counted_guard(kernels, calls)
    counts["judgement"] = counts["judgement"].model_copy(update={"worst": counting.counted_longest(kernels)})
    cost = ExportCost(variables=len(process.inputs), operations=counts, bytes=export.sizes())
    texts[README] = filled(template(f"{language(target)}/{GUARD}/readme.md"), {
        **{each: st_files.of_guard(text) for each, text in text_parts(target, export.outputs).items()},
        "COST": cost_text(cost), "GOLDEN": str(len(calls)), "ROWS": str(SEQUENCE_ROWS),
        "FILES": ", ".join(f"`{each}`" for each in texts),
        "LIMITS": markdown_table(("input", "low", "high", f"most in {process.sampling_period_s:g} s"), [
            (signal, *(f"{each:g}" for each in bounds))
            for signal, *bounds in zip(process.input_names, *kernels.limits[:3], strict=True)
        ]),
        "REFERENCE": REFERENCES[limits.rate_reference],
        "SLEW_S": f"{kernels.limits.slew_ticks * process.tick_s:g}",
    })  # fmt: skip
    return texts


def telling(recorded: golden.GoldenVectors, ticks: int | None) -> list[golden.GoldenVector]:
    """Return the problems that are golden vectors. Raises UsageError if there are none."""
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
    return {name: st_files.plcopen_xml(texts.values(), content)} if target == "plcopen" else texts


def text_parts(target: str, outputs: Sequence[str]) -> dict[str, str]:
    """Return what a README of Structured Text says of loading, of calls, and of a self-test's outputs; of C nothing."""
    if target == "c":
        return {}
    xml = target == "plcopen"
    return {"LOAD": template(f"structured_text/load_{target}.md").rstrip(), "AT_ONCE": str(st_files.AT_ONCE),
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

    Raises UsageError if it is so.
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

    Raises UsageError if it cannot be written, or something has been put there meanwhile.
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


# -- bits of tables that a self-test misses ----------------------------------------------------------------------------

PARTS: Final = {"solver": "", "optimizer": "optimizer/", "output_guard": "output_guard/"}
"""Programs with a self-test, and where they are in an export."""
LEVELS: Final = ("-O0", "-O2")
PER_TABLE: Final = 8
"""Bits that are changed in each table, one at a time."""
FLAGS: Final = ("-std=c99", "-ffp-contract=off", "-fno-pie", "-no-pie")
PATIENCE_S: Final = 60.0
"""Time after which a self-test counts as hanging, s; a change that makes it hang is noticed."""
SCALARS: Final = {"float": ctypes.c_float, "double": ctypes.c_double, "int32_t": ctypes.c_int32, "bool": ctypes.c_bool}
_SECTION: Final = re.compile(r"\[ *(\d+)\] (\.rodata|\.data\.rel\.ro)\S* +\S+ +([0-9a-f]+) ([0-9a-f]+) ")
_OBJECT: Final = re.compile(r": ([0-9a-f]+) +(\w+) OBJECT +\w+ +\w+ +(\d+) ([A-Za-z]\w*)")


class Flips(TypedDict):
    """Result of changing each bit in turn: how many changes there were, and which were missed."""

    changes: int
    missed: dict[str, list[int]]
    """Bytes in which one was missed, by table."""
    padding: dict[str, list[int]]
    """Bytes of padding in which a change was missed, by table: they lie between the members of a structure, and no code
reads them."""


def scored(texts: Mapping[str, str]) -> dict[str, dict[str, Flips]]:
    """Return what the self-tests of an export in C find, by program and level of optimisation.

    Raises UsageError if a self-test fails without a change.
    """
    with tempfile.TemporaryDirectory() as made:
        found = {}
        for part, inside in PARTS.items():
            sources = [each for each in texts if each.startswith(inside) and "/" not in each.removeprefix(inside)]
            if not sources:
                continue  # for a process with a forecast
            folder = Path(made) / part
            folder.mkdir()
            for name in sources:
                (folder / name.removeprefix(inside)).write_text(texts[name], encoding="ascii")
            found[part] = {level: flipped(folder, ("gcc", level)) for level in LEVELS}
        return found


def flipped(folder: Path, compiler: Sequence[str], runner: Sequence[str] = (), count: int = PER_TABLE) -> Flips:
    """Return what the self-test of the sources in a folder finds.

    Args:
        folder: Sources; the program is put there.
        compiler: Command of a compiler for ELF, with options.
        runner: What runs its programs here.
        count: Bits for each table.

    Raises:
        UsageError: The self-test fails without a change.
        subprocess.CalledProcessError: It cannot be compiled.
    """
    image = folder / "image"
    subprocess.run([*compiler, *FLAGS, *sorted(folder.glob("*.c")), "-lm", "-o", image], check=True)  # noqa: S603 ours

    def passes() -> bool:
        try:
            done = subprocess.run([*runner, image], capture_output=True, check=False, timeout=PATIENCE_S)  # noqa: S603
        except subprocess.TimeoutExpired:
            return False
        return done.returncode == 0

    if not passes():
        raise UsageError(f"--score: the self-test of {folder.name}, compiled by {' '.join(compiler)}, fails as it is")
    data, random = image.read_bytes(), Random(1)  # noqa: S311 no secret
    members = _members("\n".join(each.read_text("ascii") for each in folder.glob("*.h")), 32 * data[4])
    found = Flips(changes=0, missed={}, padding={})
    for name, offset, size in _tables(image):
        for bit in random.sample(range(8 * size), min(count, 8 * size)):
            changed = bytearray(data)
            changed[offset + bit // 8] ^= 1 << bit % 8
            image.write_bytes(changed)
            found["changes"] += 1
            if passes():
                used = members.get(name.rpartition("_kernel_")[2])
                padding = used is not None and not used[bit // 8 % len(used)]
                found["padding" if padding else "missed"].setdefault(name, []).append(bit // 8)
    return found


def _tables(image: Path) -> Iterator[tuple[str, int, int]]:
    """Yield name, place in the file and bytes of each constant array or structure of an ELF program."""
    text = subprocess.run(["readelf", "-SWs", image], capture_output=True, text=True, check=True).stdout  # noqa: S603, S607
    sections = {number: int(place, 16) - int(at, 16) for number, _, at, place in _SECTION.findall(text)}
    for at, size, section, name in _OBJECT.findall(text):
        if section in sections and int(size, 0):
            yield name, sections[section] + int(at, 16), int(size, 0)


def _members(headers: str, bits: int) -> dict[str, list[bool]]:
    """Return of each constant structure that headers declare which of its bytes belong to a member."""
    known: dict[str, Any] = dict(SCALARS)
    pointer = ctypes.c_uint32 if bits == ctypes.sizeof(ctypes.c_uint32) * 8 else ctypes.c_uint64
    for body, name in re.findall(r"^typedef struct \{\n(.*?)^\} (\w+);", headers, re.MULTILINE | re.DOTALL):
        fields = re.findall(r"^    (?:const )?(\w+) (\*?)(\w+)(?:\[(\d+)\])?;", body, re.MULTILINE)
        kinds = ((field, pointer if star else known[kind], int(length or 0)) for kind, star, field, length in fields)
        listed = [(field, kind * length if length else kind) for field, kind, length in kinds]
        known[name] = type(name, (ctypes.Structure,), {"_fields_": listed})
    return {name: _used(known[kind]) for kind, name in re.findall(r"^extern const (\w+) (\w+)", headers, re.MULTILINE)
            if issubclass(known[kind], ctypes.Structure)}  # fmt: skip


def _used(kind: Any) -> list[bool]:  # noqa: ANN401 a type of ctypes
    found = [not hasattr(kind, "_fields_")] * ctypes.sizeof(kind)
    for name, part in getattr(kind, "_fields_", ()):
        at = getattr(kind, name).offset
        found[at : at + ctypes.sizeof(part)] = _used(part)
    return found
