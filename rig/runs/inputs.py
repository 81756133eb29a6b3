"""The inputs of a run, load and model: copied into its folder and hashed, so that it can be repeated."""

import hashlib
import json
from pathlib import Path
from typing import Any, Final

from coldloop.process.load_profile import LOAD_COLUMN, LoadProfile
from coldloop.process.model_settings import DEFAULT_MODEL_FILE
from coldloop.process.signals import TICK_S
from coldloop.table import TIME
from coldloop.text_file import held_file, read_bytes
from coldloop.whole_file import whole_text
from plant.load import named_families
from rig.settings import Settings

FOLDER: Final = "inputs"
LOAD_COPY: Final = f"{FOLDER}/load.csv"
MODEL_COPY: Final = f"{FOLDER}/model.json"
REFRIGERATOR_COPY: Final = f"{FOLDER}/refrigerator.json"
RESTORE: Final = "the run cannot be repeated without it"


def copy_inputs(settings: Settings, profile: LoadProfile, folder: Path) -> dict[str, Any]:
    """Copy the files that a run reads into its folder; return their description for the manifest.

    Args:
        settings: Name the files.
        profile: The load.
        folder: Of the run.

    A load that has a name is described by the digest of its steps, the model that is shipped by its own digest.
    """
    (folder / FOLDER).mkdir(exist_ok=True)
    name, model_file = settings.plant.load, settings.model.file
    load: dict[str, Any] = {"source": name, "file": None, "profile_sha256": profile_digest(profile)}
    if with_copied_load(settings, profile, folder) is not settings:
        load |= {"file": LOAD_COPY, "sha256": file_digest(folder / LOAD_COPY)}
    model = _copied(model_file, folder, MODEL_COPY)
    if model_file == DEFAULT_MODEL_FILE:
        model["source"] = "shipped"
    rest = settings.plant.refrigerator.file
    more = {} if rest is None else {"refrigerator": _copied(rest, folder, REFRIGERATOR_COPY)}
    return {"load": load, "model": model, **more}


def _copied(source: Path, folder: Path, name: str) -> dict[str, str]:
    content = read_bytes(source, RESTORE)
    (folder / name).write_bytes(content)
    return {"source": str(source), "file": name, "sha256": hashlib.sha256(content).hexdigest()}


def with_copied_load(settings: Settings, profile: LoadProfile, folder: Path) -> Settings:
    """Return settings that name a copy of the load in the folder of a run; those of a named load as they are.

    The copy is written from what was read: a pipe is read once, and a file may change meanwhile.
    """
    if named_families(settings.plant.load) is not None:
        return settings
    (folder / FOLDER).mkdir(exist_ok=True)
    steps = zip(profile.times, profile.watts, strict=True)
    rows = "".join(f"{tick * TICK_S!r},{watts!r}\n" for tick, watts in steps)
    whole_text(folder / LOAD_COPY, f"{TIME},{LOAD_COLUMN}\n{rows}")
    plant = settings.plant.model_copy(update={"load": str(folder / LOAD_COPY)})
    return settings.model_copy(update={"plant": plant})


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes.

    Raises:
        UsageError: It cannot be read.
    """
    return hashlib.sha256(read_bytes(path, RESTORE)).hexdigest()


def profile_digest(profile: LoadProfile) -> str:
    """Return the SHA-256 of the steps of a load."""
    return hashlib.sha256(json.dumps([profile.times, profile.watts]).encode()).hexdigest()


def configuration_digest(configuration: dict[str, Any]) -> str:
    """Return the SHA-256 of a configuration as the manifest has it."""
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()


def changed_inputs(manifest: dict[str, Any], folder: Path) -> list[str]:
    """Return what is not as it was when the run of a manifest began, a line each."""
    changed = [
        f"{folder / entry['file']}: is not the {name} that the run read"
        for name, entry in manifest["inputs"].items()
        if entry
        and entry["file"] is not None
        and file_digest(held_file(folder, entry["file"], RESTORE)) != entry.get("sha256")
    ]
    if configuration_digest(manifest["configuration"]) != manifest["hashes"]["configuration_sha256"]:
        changed.append(f"{folder / 'manifest.json'}: the configuration is not the one that the run had")
    return changed
