"""An exported optimiser in C in the place of ours on the bus: checked against the run, compiled, loaded as a library.

`python -m coldloop_export.exported_optimizer LIBRARY` is our service with the answers of the library.
"""

import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from ctypes import CDLL, c_bool
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from pydantic import BaseModel

from coldloop import __version__, config, errors
from coldloop.kernels.cache import find_cache_folder
from coldloop.process import lti_model
from coldloop.process.settings import InputLimits
from coldloop.registers import codec, control_plc, maps_of, optimizer_plc
from coldloop.safety.writers import InputSequence, with_checksum
from coldloop.service.start import in_one_line, main
from coldloop.text import held_file, parsed_json, read_bytes
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.rules import UpdatingRule
from coldloop_optimizer_plc.runtime import serve
from coldloop_optimizer_plc.settings import SHOWN, OptimizerSettings, ProgramSettings
from coldloop_rig import PYTHON
from coldloop_rig.settings import Settings

PREFIX: Final = "export:"
FOLDER: Final = "optimizer"
"""Folder of the whole optimiser within that of an export."""
MANIFEST: Final = "manifest.json"
FORMAT: Final = 1
MOST_BYTES: Final = 2**26
"""Size of a file of an export."""
FLAGS: Final = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC")
LIBRARY: Final = "library.so"


# -- the program -------------------------------------------------------------------------------------------------------


class ExportedProgram(OptimizerProgram):
    """The optimiser's program with the plans and sequences of a compiled export.

    `optimizer.h` has the records and functions. What these do not tell, the prediction and the model's deviation, is
    shown as at the start.

    Args:
        library: The compiled export.
        model: The model that it was made for; so are settings and limits.
        settings: See `model`.
        limits: See `model`.

    Raises:
        UsageError: The library cannot be loaded.
    """

    def __init__(
        self, library: Path, model: lti_model.LtiModel, settings: ProgramSettings, limits: InputLimits
    ) -> None:
        try:
            self._c = CDLL(str(library))
        except OSError as error:
            raise errors.UsageError(f"the exported optimiser cannot be loaded: {error}") from None
        for name in ("optimizer_restart", "optimizer_plan", "optimizer_solve"):
            getattr(self._c, name).restype = c_bool
        self._c.optimizer_answered.argtypes = [c_bool]
        inputs, values = len(model.u0), 2 * len(model.u0) + len(model.y0) + len(model.x0)
        self._update = np.zeros(1, [("numbers", "i4", 3), ("reals", "f4", 1 + values)])
        self._planned = np.zeros(1, [("ticks", "i4", 2), ("reals", "f4", 2), ("more", "i4", 2)])
        self._sequenced = np.zeros(1, [("numbers", "i4", 5), ("rows", "f4", (control_plc.SEQUENCE_ROWS, inputs))])
        self._reported = np.zeros(1, [("numbers", "i4", 5), ("reals", "f4", 11)])
        super().__init__(model, settings, limits)

    def restart(self, updating_period_s: float, rule: UpdatingRule | None = None) -> None:
        """Begin a session at the operating point."""
        super().restart(updating_period_s, rule)
        self._c.optimizer_restart(round(updating_period_s / self.process.tick_s))

    def plan(self, update: control_plc.Update) -> control_plc.Plan:
        """Take an update and decide the updating period that begins there.

        Raises UsageError if a tick or a number is beyond what the export holds.
        """
        self._update["numbers"] = np.array((update.update, update.tick, update.playing)).astype(np.int32)
        self._update["reals"] = (update.load, *update.u_before, *update.u, *update.y, *update.x)
        if not self._c.optimizer_plan(self._update.ctypes, self._planned.ctypes):
            raise errors.UsageError("a tick or a number is beyond what its 32 bits hold: begin another session")
        (_, next_update_tick), (load_step, shortage), (suspects, _) = (part.tolist() for part in self._planned[0])
        return control_plc.Plan(update.update, next_update_tick, load_step, shortage, suspects)

    def answer_after_s(self) -> float:
        """Return the plant time from the instant of the last `plan` until the PLC has computed its answer."""
        return self.budget.answer_after_s(int(self._planned[0]["more"][1]))

    def solve(self) -> InputSequence:
        """Compute the sequence that follows the last plan; without rows there is no answer."""
        self._c.optimizer_solve(self._sequenced.ctypes)
        number, update, first_tick, length, tau_u = self._sequenced[0]["numbers"].tolist()
        header = control_plc.SequenceHeader(number, update, first_tick, length, tau_u, self.model_digest, crc=0)
        return with_checksum(header, list(map(tuple, self._sequenced[0]["rows"][:length].tolist())))

    def answered(self, *, late: bool) -> None:
        """Note how an answer came."""
        self._c.optimizer_answered(late)

    def report(self, verdict: control_plc.Verdict) -> optimizer_plc.Optimization:
        """Return what was done with the last update."""
        self._c.optimizer_report(self._reported.ctypes)
        numbers, reals = (part.tolist() for part in self._reported[0])
        return optimizer_plc.Optimization._make((*numbers, verdict, *reals))

    def predictor(self) -> Callable[[], optimizer_plc.Prediction]:
        """Return what gives no prediction."""
        return partial(codec.blank, optimizer_plc.Prediction, maps_of(self.process).optimizer_plc)

    def model_deviation(self) -> optimizer_plc.ModelDeviation:
        """Return no deviation."""
        return codec.blank(optimizer_plc.ModelDeviation, maps_of(self.process).optimizer_plc)


# -- an export for a run -----------------------------------------------------------------------------------------------


class _Manifest(BaseModel, extra="ignore", strict=True):
    """Keys of an export's manifest that are read here."""

    format: int
    coldloop: str
    model_digest: str
    register_maps: list[int]
    settings: dict[str, Any]
    files: dict[str, str]


def manifest_of(settings: Settings, texts: Mapping[str, str], cost: Mapping[str, Any]) -> str:
    """Return the manifest of an export of these files: model, settings, register maps, what it costs, digests."""
    return json.dumps({
        "format": FORMAT, "coldloop": __version__, **_identity(settings), **cost,
        "files": {name: hashlib.sha256(text.encode("ascii")).hexdigest() for name, text in texts.items()},
    }, indent=1)  # fmt: skip


def _identity(settings: Settings) -> dict[str, Any]:
    shown = config.selected(settings, SHOWN)
    del shown["optimizer_plc.program.updating_period_s"]  # the session's
    return {
        "model_digest": lti_model.load(settings.model.file).digest,
        "register_maps": [each.digest for each in maps_of(settings.process)[1:]],
        "settings": parsed_json(json.dumps(shown)),
    }


def exported_optimizer(given: str, settings: Settings) -> tuple[str, ...]:
    """Return the command of our service with an exported optimiser, which is compiled where needed.

    Args:
        given: `export:` and the folder of an export.
        settings: Of the run.

    Raises:
        UsageError: It is none, or of another model or other settings, or cannot be compiled, or fails its self-test.
    """

    def refusal(why: str) -> errors.UsageError:
        return errors.UsageError(f"--optimizer {given}: {why}")

    if not given.startswith(PREFIX):
        raise refusal("give export: and the folder that coldloop export plc --target c wrote")
    sources = _checked(refusal, Path(given.removeprefix(PREFIX)), settings)
    return (*PYTHON, "-m", "coldloop_export.exported_optimizer", str(_compiled(refusal, sources)))


Refusal: TypeAlias = Callable[[str], errors.UsageError]


def _checked(refusal: Refusal, folder: Path, settings: Settings) -> dict[str, bytes]:
    """Return the sources of an export, by name, whose digests its manifest has."""
    try:
        manifest = held_file(folder, f"{FOLDER}/{MANIFEST}", "export it again")
        found = _Manifest.model_validate(parsed_json(read_bytes(manifest, "export it again", most=MOST_BYTES)))
    except (errors.UsageError, ValueError):
        solver = (folder / "kernels.c").exists() or (folder / "kernels.st").exists()
        what = "has the solver alone, without the optimiser: export it again" if solver else "is no export"
        raise refusal(f"{what} (coldloop export plc --target c --out FOLDER)") from None
    ours = _identity(settings)
    if found.format != FORMAT or found.register_maps != ours["register_maps"]:
        others = f"whose registers are others than those of {__version__}: export it again"
        raise refusal(f"it was exported by Coldloop {found.coldloop}, {others}")
    if found.model_digest != ours["model_digest"]:
        run = f"the run {ours['model_digest'][:8]} of {settings.model.file}"
        raise refusal(f"it has the model {found.model_digest[:8]}, {run}: export it again")
    for key in sorted({*found.settings, *ours["settings"]}):
        theirs, own = found.settings.get(key), ours["settings"].get(key)
        if theirs != own:
            raise refusal(f"it has {key} = {theirs}, the run {own}: set it, or export the optimiser again")
    if "optimizer.c" not in found.files:
        raise refusal("it is not in C: export it with --target c")
    sources = {}
    for name, digest in found.files.items():
        place = held_file(folder / FOLDER, name, "export it again")
        sources[name] = read_bytes(place, "export it again", most=MOST_BYTES)
        if hashlib.sha256(sources[name]).hexdigest() != digest:
            raise refusal(f"{FOLDER}/{name} is not as it was exported: export it again")
    return sources


def _compiled(refusal: Refusal, sources: Mapping[str, bytes]) -> Path:
    """Return the library in our own cache, compiled there from these sources and tested where it is not there yet."""
    compiler = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
    if compiler is None:
        raise refusal("there is no C compiler (cc) to compile it: on Debian, install gcc")
    cache = find_cache_folder("exports")
    cache.chmod(0o700)
    content = sorted((name, hashlib.sha256(source).hexdigest()) for name, source in sources.items())
    library = cache / hashlib.sha256(json.dumps([compiler, FLAGS, LIBRARY, content]).encode()).hexdigest()
    if not library.is_file():
        with tempfile.TemporaryDirectory(dir=cache) as made:
            for name, source in sources.items():
                (Path(made) / name).parent.mkdir(parents=True, exist_ok=True)
                (Path(made) / name).write_bytes(source)
            _make(refusal, compiler, Path(made))
            (Path(made) / LIBRARY).replace(library)
    return library


def _make(refusal: Refusal, compiler: str, folder: Path) -> None:
    """Compile and test the sources in a folder of our own; `LIBRARY` is there then."""
    code, test = [folder / name for name in ("kernels.c", "constants.c", "optimizer.c")], folder / "self_test"
    commands: tuple[tuple[str | Path, ...], ...] = (
        (compiler, *FLAGS, "-o", test, *code, folder / "golden.c", folder / "self_test.c", "-lm"), (test,),
        (compiler, *FLAGS, "-o", folder / LIBRARY, "-shared", *code, "-lm"),
    )  # fmt: skip
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 ours
        if done.returncode and command == (test,):
            said = done.stdout.partition("\n")[0]
            raise refusal(f"as {compiler} compiles it, its self-test fails: {said}")
        if done.returncode:
            why = next((line for line in done.stderr.splitlines() if "error" in line), "no reason given")
            raise refusal(f"it cannot be compiled: {why}")


def start() -> int:
    """Run the service with the library of the command line; return its exit code."""
    library, *arguments = sys.argv[1:]
    program = partial(ExportedProgram, Path(library))
    return main("optimizer_plc", OptimizerSettings, partial(serve, program=program), arguments)


if __name__ == "__main__":
    sys.exit(in_one_line("optimizer_plc", start))
