"""An exported optimiser that takes the place of ours on the bus: checked against the run, compiled, started."""

import hashlib
import json
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from coldloop import __version__
from coldloop.config import selected
from coldloop.errors import UsageError
from coldloop.parsing import parsed_json
from coldloop.process.lti_model import load as load_model
from coldloop.registers.control_plc import CONTROL_MAP
from coldloop.registers.optimizer_plc import OPTIMIZER_MAP
from optimizer_plc.settings import SHOWN
from rig.settings import Settings

PREFIX: Final = "export:"
FOLDER: Final = "optimizer"
"""In the folder of an export: the whole optimiser."""
MANIFEST: Final = "manifest.json"
FORMAT: Final = 1
OF_SESSION: Final = ("optimizer_plc.program.updating_period_s",)
"""What a session decides."""
FLAGS: Final = ("-std=c99", "-O2", "-ffp-contract=off")
POSIX: Final = ("-D_POSIX_C_SOURCE=200809L", "-pthread")
LIBRARY: Final = "#include <modbus/modbus.h>\n"


def manifest_of(settings: Settings, texts: Mapping[str, str], cost: Mapping[str, Any]) -> str:
    """Return the manifest of an export of these files: model, settings, register maps, what it costs, digests."""
    return json.dumps({
        "format": FORMAT, "coldloop": __version__, **_identity(settings), **cost,
        "files": {name: hashlib.sha256(text.encode("ascii")).hexdigest() for name, text in texts.items()},
    }, indent=1)  # fmt: skip


def _identity(settings: Settings) -> dict[str, Any]:
    shown = selected(settings, SHOWN)
    return {
        "model_digest": load_model(settings.model.file).digest,
        "register_maps": [CONTROL_MAP.digest, OPTIMIZER_MAP.digest],
        "settings": parsed_json(json.dumps({key: value for key, value in shown.items() if key not in OF_SESSION})),
    }


def exported_optimizer(given: str, settings: Settings) -> tuple[str, ...]:
    """Return the program of an exported optimiser, which is compiled where needed.

    Args:
        given: `export:` and the folder of an export.
        settings: Of the run.

    Raises:
        UsageError: It is none, or of another model or other settings, or cannot be compiled, or fails its self-test.
    """
    folder = Path(given.removeprefix(PREFIX))
    if not given.startswith(PREFIX):
        raise UsageError(f"--optimizer {given}: give export: and the folder that coldloop export plc --target c wrote")
    if settings.optimizer_plc.control_plc.tls or settings.optimizer_plc.server.tls:
        raise UsageError("--optimizer: an exported optimiser has no TLS; leave it out")
    _check(given, folder, settings)
    return (str(_compiled(given, folder / FOLDER)),)


def _check(given: str, folder: Path, settings: Settings) -> None:
    try:
        found = parsed_json((folder / FOLDER / MANIFEST).read_text(encoding="ascii"))
    except (OSError, ValueError):
        solver = (folder / "kernels.c").exists() or (folder / "kernels.st").exists()
        what = "has the solver alone, without the optimiser: export it again" if solver else "is no export"
        raise UsageError(f"--optimizer {given}: {what} (coldloop export plc --target c --out FOLDER)") from None
    ours = _identity(settings)
    if found.get("format") != FORMAT or found["register_maps"] != ours["register_maps"]:
        raise UsageError(
            f"--optimizer {given}: it was exported by Coldloop {found.get('coldloop')}, whose registers are others than"
            f" those of {__version__}: export it again"
        )
    if found["model_digest"] != ours["model_digest"]:
        raise UsageError(
            f"--optimizer {given}: it has the model {found['model_digest'][:8]}, the run {ours['model_digest'][:8]} of"
            f" {settings.model.file}: export it again"
        )
    for key in sorted({*found["settings"], *ours["settings"]}):
        theirs, own = found["settings"].get(key), ours["settings"].get(key)
        if theirs != own:
            raise UsageError(
                f"--optimizer {given}: it has {key} = {theirs}, the run {own}: set it, or export the optimiser again"
            )
    if "optimizer.c" not in found["files"]:
        raise UsageError(f"--optimizer {given}: it is not in C: export it with --target c")
    for name, digest in found["files"].items():
        path = folder / FOLDER / name
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise UsageError(f"--optimizer {given}: {FOLDER}/{name} is not as it was exported: export it again")


def _compiled(given: str, folder: Path) -> Path:
    """Return the program, compiled and tested if it is older than its sources."""
    program, test = folder / "bus" / "optimizer", folder / "self_test"
    sources = [folder / name for name in ("kernels.c", "constants.c", "optimizer.c")]
    bus = sorted((folder / "bus").glob("*.c"))
    newest = max(path.stat().st_mtime for path in (*sources, *bus, folder / MANIFEST))
    if program.exists() and program.stat().st_mtime > newest:
        return program
    compiler = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
    if compiler is None:
        raise UsageError(f"--optimizer {given}: there is no C compiler (cc) to compile it: on Debian, install gcc")
    compile_to = (compiler, *FLAGS, "-o")
    _compile(given, *compile_to, test, *sources, folder / "golden.c", folder / "self_test.c", "-lm")
    tested = _run(test)
    if tested.returncode:
        first = tested.stdout.partition("\n")[0]
        raise UsageError(f"--optimizer {given}: as {compiler} compiles it, its self-test fails: {first}")
    if _run(compiler, "-E", "-x", "c", "-", source=LIBRARY).returncode:
        raise UsageError(f"--optimizer {given}: libmodbus is not installed: on Debian, install libmodbus-dev")
    _compile(given, *compile_to, program, *POSIX, *sources, *bus, "-lmodbus", "-lm")
    return program


def _compile(given: str, *command: str | Path) -> None:
    """Run the compiler.

    Raises:
        UsageError: It fails.
    """
    result = _run(*command)
    if result.returncode:
        why = next((line for line in result.stderr.splitlines() if "error" in line), "no reason given")
        raise UsageError(f"--optimizer {given}: it cannot be compiled: {why}")


def _run(*command: str | Path, source: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, input=source, capture_output=True, text=True, check=False)  # noqa: S603 ours
