"""A recorded run again, from its manifest: the same trace, or what is different.

The trace depends on the configuration alone, so a run over Modbus is repeated in one process. A run in real time has
the trace of lock-step if no deadline was missed.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coldloop import __version__
from coldloop.config import Configuration, load_configuration
from coldloop.errors import UsageError, printable
from coldloop.process.lti_model import load as load_model
from coldloop.process.model_file import read_document
from coldloop_plant.load import named_families
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Job, Scenario
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.progress import RunProgress
from coldloop_rig.results.folders import claim_folder, installed_version
from coldloop_rig.results.indicators import RunEvaluation
from coldloop_rig.results.recording import Recorder
from coldloop_rig.results.run_folder import RunFolder
from coldloop_rig.results.way import Way
from coldloop_rig.runs.inputs import changed_inputs, profile_digest
from coldloop_rig.runs.manifest import DEPENDENCIES
from coldloop_rig.runs.running import make_scenario, run_into
from coldloop_rig.settings import Settings

SOURCE = "manifest"
REMEDY = "name its file with --process; rerun --trust executes the plant that the folder holds"


def repeat(folder: Path, out: Path | None, *, force: bool, trusted: Path | None) -> tuple[bool, str]:
    """Repeat the run of a folder; return whether the traces are the same, and what to print.

    Args:
        folder: Of the run.
        out: Folder for the results of the repetition; None keeps none.
        force: Whether a run in it may be replaced.
        trusted: A model file with the same model as that of a run of another process than the cold box, which may
            hold code that a plant executes; None trusts the folder.

    Raises:
        UsageError: There is no run to repeat, or an input or the configuration was changed since.
    """
    run = RunFolder(folder)
    manifest = run.manifest
    if manifest["way"] == Way.CHAOS:
        raise UsageError(
            f"{folder}: a run with faults, which depend on the machine; `coldloop chaos` runs the plan again"
        )
    if manifest["way"] == Way.RECORDED:
        raise UsageError(f"{folder}: a session under way was recorded, from its middle on: it cannot be repeated")
    if not manifest["recorded_ticks"]:
        raise UsageError(f"{folder}: the run has no ticks: {manifest['reason']}")
    changed = changed_inputs(manifest, folder)
    if changed:
        raise UsageError("; ".join(changed))
    if trusted is not None:
        own, ours = run.model, read_document(trusted)
        if (own.get("process") or ours.get("process")) and own.get("digest") != ours["digest"]:
            remedy = REMEDY if own.get("process") else "leave out --process"
            raise UsageError(f"{folder}: a run of {run.process.name}, with another model than now; {remedy}")
    effective = _configuration(run)
    scenario = make_scenario(effective.settings, manifest["recorded_ticks"])
    if profile_digest(scenario.load) != manifest["inputs"]["load"]["profile_sha256"]:
        raise UsageError(f"load {manifest['inputs']['load']['source']}: this version has another load of that name")
    trace = _trace(effective, scenario, out, force=force)
    if trace == manifest["hashes"]["trace_sha256"]:
        return True, f"{scenario.ticks} ticks, the same trace {trace}\n"
    return False, _differences(manifest, run, trace)


def _configuration(run: RunFolder) -> Configuration[Settings]:
    """Return the configuration of a run, with the copies of its inputs instead of the originals."""
    values = dict(run.configuration)
    copies = {"plant.load": "load", "model.file": "model", "plant.refrigerator.file": "refrigerator"}
    for key, entry in copies.items():
        copy = (run.manifest["inputs"].get(entry) or {}).get("file")
        if copy is not None:
            values[key] = str(run.held(copy))
        elif key == "model.file":  # the shipped one
            values.pop(key, None)
        elif key in values and named_families(str(values[key])) is None:
            raise UsageError(f"{run.path / 'manifest.json'}: {key}: the folder has no copy of it")
    options: Mapping[str, tuple[object, str]] = {key: (value, SOURCE) for key, value in values.items()}
    return load_configuration(Settings, environment={}, options=options)


def _trace(effective: Configuration[Settings], scenario: Scenario, out: Path | None, *, force: bool) -> str:
    process = effective.settings.process
    with RunProgress(scenario.ticks, process) as progress, FigureProcess(["png"]) as figure:
        if out is not None:
            claim_folder(out, force=force)
            summary = run_into(out, Job(effective, scenario, Way.IN_PROCESS), {}, figure, [progress])
            return str(summary["trace_sha256"])
        settings = effective.settings
        evaluation = RunEvaluation(load_model(settings.model.file), settings.optimizer_plc.program.design)
        recorder = Recorder(scenario.ticks, [evaluation, progress])
        OneProcessRig(settings).run(scenario, recorder)
        recorder.close()
        return evaluation.trace_sha256


def _differences(manifest: Mapping[str, Any], run: RunFolder, trace: str) -> str:
    """Return what may be the reason of another trace."""
    lines = [f"another trace: {trace} instead of {manifest['hashes']['trace_sha256']}"]
    if manifest["coldloop"] != __version__:
        lines.append(f"coldloop {__version__} instead of {manifest['coldloop']}")
    for name in DEPENDENCIES:
        there, then = installed_version(name), manifest["dependencies"].get(name, "absent")
        if there != then:
            lines.append(f"{name} {there} instead of {then}")
    misses = run.summary["deadline_misses"]
    if misses:
        lines.append(f"the run missed {misses} deadlines, which depend on the machine")
    if len(lines) == 1:
        lines.append("inputs, configuration and versions are the same: the programs have changed, or the machine")
    return "".join(f"{printable(line)}\n" for line in lines)
