"""The inputs of a run, load and model: copied into its folder and hashed, so that it can be repeated."""

import hashlib
import json
from pathlib import Path
from typing import Any, Final

from coldloop.process.load_profile import LoadProfile
from coldloop.process.settings import SHIPPED_MODELS
from coldloop.text_file import held_file, read_bytes
from coldloop_rig.cosim.scenario import INPUTS, LOAD_COPY, with_copied_load
from coldloop_rig.settings import Settings

MODEL_COPY: Final = f"{INPUTS}/model.json"
REFRIGERATOR_COPY: Final = f"{INPUTS}/refrigerator.json"
RESTORE: Final = "the run cannot be repeated without it"


def copy_inputs(settings: Settings, profile: LoadProfile, folder: Path) -> dict[str, Any]:
    """Copy the files that a run reads into its folder; return their description for the manifest.

    Args:
        settings: Name the files.
        profile: The load.
        folder: Of the run.

    A load that has a name is described by the digest of its steps, the model that is shipped by its own digest.
    """
    (folder / INPUTS).mkdir(exist_ok=True)
    name, model_file = settings.plant.load, settings.model.file
    load: dict[str, Any] = {"source": name, "file": None, "profile_sha256": profile_digest(profile)}
    if with_copied_load(settings, profile, folder) is not settings:
        load |= {"file": LOAD_COPY, "sha256": file_digest(folder / LOAD_COPY)}
    model = _copied(model_file, folder, MODEL_COPY)
    if model_file == SHIPPED_MODELS["cold-box"]:
        model["source"] = "shipped"
    rest = settings.plant.refrigerator.file
    more = {} if rest is None else {"refrigerator": _copied(rest, folder, REFRIGERATOR_COPY)}
    return {"load": load, "model": model, **more}


def _copied(source: Path, folder: Path, name: str) -> dict[str, str]:
    content = read_bytes(source, RESTORE)
    (folder / name).write_bytes(content)
    return {"source": str(source), "file": name, "sha256": hashlib.sha256(content).hexdigest()}


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
