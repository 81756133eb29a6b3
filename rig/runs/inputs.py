"""The inputs of a run, load and model: copied into its folder and hashed, so that it can be repeated."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any, Final

from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_settings import DEFAULT_MODEL_FILE
from coldloop.text_file import held_file, read_bytes
from plant.load import named_families
from rig.settings import Settings

FOLDER: Final = "inputs"
LOAD_COPY: Final = f"{FOLDER}/load.csv"
MODEL_COPY: Final = f"{FOLDER}/model.json"
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
    if Path(name).is_file() and named_families(name) is None:
        load |= _copied(Path(name), folder, LOAD_COPY)
    shipped = model_file == DEFAULT_MODEL_FILE
    model = {"source": "shipped" if shipped else str(model_file), **_copied(model_file, folder, MODEL_COPY)}
    return {"load": load, "model": model}


def _copied(source: Path, folder: Path, name: str) -> dict[str, str]:
    shutil.copyfile(source, folder / name)
    return {"file": name, "sha256": file_digest(folder / name)}


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
        if entry["file"] is not None and file_digest(held_file(folder, entry["file"], RESTORE)) != entry.get("sha256")
    ]
    if configuration_digest(manifest["configuration"]) != manifest["hashes"]["configuration_sha256"]:
        changed.append(f"{folder / 'manifest.json'}: the configuration is not the one that the run had")
    return changed
