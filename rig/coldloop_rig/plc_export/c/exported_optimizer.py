"""An exported optimiser that takes the place of ours on the bus: checked against the run, compiled, started."""

import hashlib
import json
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict

from coldloop import __version__
from coldloop.config import selected
from coldloop.errors import UsageError
from coldloop.kernels.cache_folder import find_cache_folder
from coldloop.parsing import parsed_json
from coldloop.process.lti_model import load as load_model
from coldloop.registers.maps import maps_of
from coldloop.text_file import held_file, read_bytes
from coldloop_optimizer_plc.settings import SHOWN
from coldloop_rig.settings import Settings

PREFIX: Final = "export:"
FOLDER: Final = "optimizer"
"""In the folder of an export: the whole optimiser."""
MANIFEST: Final = "manifest.json"
FORMAT: Final = 1
CACHE: Final = "exports"
PROGRAM: Final = "program"
MOST_BYTES: Final = 2**26
"""Of a file of an export."""
OF_SESSION: Final = ("optimizer_plc.program.updating_period_s",)
"""What a session decides."""
FLAGS: Final = ("-std=c99", "-O2", "-ffp-contract=off")
POSIX: Final = ("-D_POSIX_C_SOURCE=200809L", "-pthread")
LIBRARY: Final = "#include <modbus/modbus.h>\n"


class _Manifest(BaseModel):
    """What is read of the manifest of an export."""

    model_config = ConfigDict(extra="ignore", strict=True)

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
    shown = selected(settings, SHOWN)
    return {
        "model_digest": load_model(settings.model.file).digest,
        "register_maps": [each.digest for each in maps_of(settings.process)[1:]],
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
    sources = _checked(given, folder, settings)
    return (str(_compiled(given, sources)),)


def _checked(given: str, folder: Path, settings: Settings) -> dict[str, bytes]:
    """Return the sources of an export, by name, whose digests its manifest has."""
    try:
        manifest = held_file(folder, f"{FOLDER}/{MANIFEST}", "export it again")
        found = _Manifest.model_validate(parsed_json(read_bytes(manifest, "export it again", most=MOST_BYTES)))
    except (UsageError, ValueError):
        solver = (folder / "kernels.c").exists() or (folder / "kernels.st").exists()
        what = "has the solver alone, without the optimiser: export it again" if solver else "is no export"
        raise UsageError(f"--optimizer {given}: {what} (coldloop export plc --target c --out FOLDER)") from None
    ours = _identity(settings)
    if found.format != FORMAT or found.register_maps != ours["register_maps"]:
        raise UsageError(
            f"--optimizer {given}: it was exported by Coldloop {found.coldloop}, whose registers are others than"
            f" those of {__version__}: export it again"
        )
    if found.model_digest != ours["model_digest"]:
        raise UsageError(
            f"--optimizer {given}: it has the model {found.model_digest[:8]}, the run {ours['model_digest'][:8]} of"
            f" {settings.model.file}: export it again"
        )
    for key in sorted({*found.settings, *ours["settings"]}):
        theirs, own = found.settings.get(key), ours["settings"].get(key)
        if theirs != own:
            raise UsageError(
                f"--optimizer {given}: it has {key} = {theirs}, the run {own}: set it, or export the optimiser again"
            )
    if "optimizer.c" not in found.files:
        raise UsageError(f"--optimizer {given}: it is not in C: export it with --target c")
    sources = {}
    for name, digest in found.files.items():
        place = held_file(folder / FOLDER, name, "export it again")
        sources[name] = read_bytes(place, "export it again", most=MOST_BYTES)
        if hashlib.sha256(sources[name]).hexdigest() != digest:
            raise UsageError(f"--optimizer {given}: {FOLDER}/{name} is not as it was exported: export it again")
    return sources


def _compiled(given: str, sources: Mapping[str, bytes]) -> Path:
    """Return the program in our own cache, compiled there from these sources and tested where it is not there yet."""
    compiler = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
    if compiler is None:
        raise UsageError(f"--optimizer {given}: there is no C compiler (cc) to compile it: on Debian, install gcc")
    cache = find_cache_folder(CACHE)
    cache.chmod(0o700)
    content = {name: hashlib.sha256(source).hexdigest() for name, source in sources.items()}
    program = cache / hashlib.sha256(json.dumps([compiler, FLAGS, POSIX, sorted(content.items())]).encode()).hexdigest()
    if program.is_file():
        return program
    with tempfile.TemporaryDirectory(dir=cache) as made:
        folder = Path(made)
        for name, source in sources.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(source)
        _make(given, compiler, folder)
        (folder / PROGRAM).replace(program)
    return program


def _make(given: str, compiler: str, folder: Path) -> None:
    """Compile and test the sources in a folder of our own; `PROGRAM` is there then."""
    test, sources = folder / "self_test", [folder / name for name in ("kernels.c", "constants.c", "optimizer.c")]
    compile_to = (compiler, *FLAGS, "-o")
    _compile(given, *compile_to, test, *sources, folder / "golden.c", folder / "self_test.c", "-lm")
    tested = _run(test)
    if tested.returncode:
        first = tested.stdout.partition("\n")[0]
        raise UsageError(f"--optimizer {given}: as {compiler} compiles it, its self-test fails: {first}")
    if _run(compiler, "-E", "-x", "c", "-", source=LIBRARY).returncode:
        raise UsageError(f"--optimizer {given}: libmodbus is not installed: on Debian, install libmodbus-dev")
    bus = sorted((folder / "bus").glob("*.c"))
    _compile(given, *compile_to, folder / PROGRAM, *POSIX, *sources, *bus, "-lmodbus", "-lm")


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
