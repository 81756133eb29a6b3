"""One run into a folder: driven, recorded, evaluated, drawn; and again from its manifest.

What is recorded survives an interruption. The folder has copies of the inputs, load and model, and a manifest with
versions, configuration and hashes: what it takes to repeat the run. The trace depends on the configuration alone, so a
run over Modbus is repeated in one process. A run in real time has the trace of lock-step if no deadline was missed.
"""

import argparse
import contextlib
import hashlib
import json
import math
import platform
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from coldloop import __version__, config, text
from coldloop.errors import ColdloopError, ResultsError, UsageError, printable
from coldloop.process import load_profile, lti_model, model_file
from coldloop.process.settings import SHIPPED_MODELS
from coldloop.registers.plant import PlantSample
from coldloop.session import TimeMode
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.qp.linear_algebra import real_of
from coldloop_optimizer_plc.settings import AdaptiveSettings, ProgramSettings, RuleName
from coldloop_plant.load import find_load, named_families
from coldloop_plant.settings import PlantKind
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import INPUTS, LOAD_COPY, Job, Scenario, StopRequest, natural_ticks, with_copied_load
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.interruption import INTERRUPTION
from coldloop_rig.plc_sizing.holding import digits_last_s, shortest_period_s, waiting
from coldloop_rig.results import columns, file_sinks, recording, run_folder
from coldloop_rig.settings import Settings

MODEL_COPY: Final = f"{INPUTS}/model.json"
REFRIGERATOR_COPY: Final = f"{INPUTS}/refrigerator.json"
RESTORE: Final = "the run cannot be repeated without it"


def _copy_inputs(settings: Settings, profile: load_profile.LoadProfile, folder: Path) -> dict[str, Any]:
    """Copy the files that a run reads into its folder; return their description for the manifest.

    A load that has a name is described by the digest of its steps, the model that is shipped by its own digest.
    """
    (folder / INPUTS).mkdir(exist_ok=True)
    name, model_file = settings.plant.load, settings.model.file

    def copied(source: Path, copy: str) -> dict[str, str]:
        content = text.read_bytes(source, RESTORE)
        (folder / copy).write_bytes(content)
        return {"source": str(source), "file": copy, "sha256": hashlib.sha256(content).hexdigest()}

    load: dict[str, Any] = {"source": name, "file": None, "profile_sha256": json_digest([profile.times, profile.watts])}
    if with_copied_load(settings, profile, folder) is not settings:
        load |= {"file": LOAD_COPY, "sha256": text.file_digest(folder / LOAD_COPY, RESTORE)}
    model = copied(model_file, MODEL_COPY)
    if model_file == SHIPPED_MODELS["cold-box"]:
        model["source"] = "shipped"
    rest = settings.plant.refrigerator.file
    more = {} if rest is None else {"refrigerator": copied(rest, REFRIGERATOR_COPY)}
    return {"load": load, "model": model, **more}


def json_digest(content: object) -> str:
    """Return the SHA-256 of a configuration as the manifest has it, or of other plain data."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _changed_inputs(manifest: dict[str, Any], folder: Path) -> list[str]:
    changed = [
        f"{folder / entry['file']}: is not the {name} that the run read"
        for name, entry in manifest["inputs"].items()
        if entry
        and entry["file"] is not None
        and text.file_digest(text.held_file(folder, entry["file"], RESTORE), RESTORE) != entry.get("sha256")
    ]
    if json_digest(manifest["configuration"]) != manifest["hashes"]["configuration_sha256"]:
        changed.append(f"{folder / 'manifest.json'}: the configuration is not the one that the run had")
    return changed


DEPENDENCIES: Final = (
    "numpy", "scipy", "numba", "pymodbus", "pydantic", "aiomqtt", "osqp", "daqp", "casadi", "pyarrow", "matplotlib",
)  # fmt: skip


def _now_utc() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _first_manifest(
    effective: config.Configuration[Settings],
    ticks: int,
    inputs: Mapping[str, Any],
    way: str,
    arguments: Mapping[str, Any],
) -> dict[str, Any]:
    configured = {key: value for key, value, _ in effective.effective() if value is not None}  # None is "not set"
    model = lti_model.load(effective.settings.model.file)
    return {
        "format": columns.FORMAT, "complete": False, "reason": "the run has not ended, or its process was killed",
        "started_utc": _now_utc(), "ended_utc": None,
        "coldloop": __version__, "python": platform.python_version(), "platform": platform.platform(),
        "dependencies": {name: run_folder.installed_version(name) for name in DEPENDENCIES},
        "command": sys.argv[1:], "arguments": dict(arguments), "way": way, "ticks": ticks, "recorded_ticks": 0,
        "configuration": configured, "inputs": dict(inputs),
        "hashes": {
            "configuration_sha256": json_digest(configured), "model_sha256": model.digest,
            "plant_parameters_sha256": model.parameters_digest, "trace_sha256": None,
        },
    }  # fmt: skip


def plain_arguments(options: argparse.Namespace) -> dict[str, str]:
    """Return the options of a command that were given, as text."""
    return {name: str(value) for name, value in vars(options).items() if name != "execute" and value is not None}


NAMES: Final = (
    "manifest.json", "summary.json", "schema.json", *columns.FILES, "run.png", "run.pdf", "run.svg",
    "chaos.json", "chaos.md", "chaos.png",
    "report.html", "run.mat", "run.h5", *(f"{Path(name).stem}.csv" for name in columns.FILES),
)  # fmt: skip
"""Files of an earlier run, and what was made of them, which a new one in the same folder replaces."""


class RunFiles:
    """Opens the files of a run in a folder, whose earlier run is replaced; `recorder` fills them, `finish` ends them.

    Raises UsageError: the disk is nearly full, or an input of the run lies in the folder; OSError: a file cannot be
    made.
    """

    def __init__(
        self, folder: Path, effective: config.Configuration[Settings], scenario: Scenario, way: str,
        arguments: Mapping[str, Any], sinks: Sequence[recording.Sink],
    ) -> None:  # fmt: skip
        settings = effective.settings
        for file in (settings.model.file, Path(settings.plant.load)):
            if file.is_file() and file.resolve().is_relative_to((folder / INPUTS).resolve()):
                raise UsageError(f"{file}: the run replaces what is in {folder}; name another --out")
        model, design = lti_model.load(settings.model.file), settings.optimizer_plc.program.design
        process, self.folder = settings.process, folder
        self._evaluation = recording.RunEvaluation(model, design)
        self._discard()
        self._reserve = file_sinks.DiskReserve(folder)
        self._realtime = scenario.realtime
        with contextlib.ExitStack() as failed:
            failed.callback(self._reserve.close)
            inputs = _copy_inputs(settings, scenario.load, folder)
            self._manifest = _first_manifest(effective, scenario.ticks, inputs, way, arguments)
            run_folder.write_json(folder / "manifest.json", self._manifest)
            is_whole = settings.plant.kind is PlantKind.REFRIGERATOR
            run_folder.write_json(folder / "schema.json", columns.schema_document(process, station=is_whole))
            made = folder, self._reserve, process
            trace = file_sinks.TraceSink(folder, self._reserve, recording.StageCost(model, design))
            files: list[recording.Sink] = [trace, file_sinks.UpdatesSink(*made), file_sinks.EventsSink(*made)]
            files += [file_sinks.StationSink(*made)] if is_whole else []
            failed.pop_all()
        self.recorder = recording.Recorder(scenario.ticks, [self._evaluation, *files, *sinks])

    def finish(self, error: BaseException | None, figure: FigureProcess) -> dict[str, Any]:
        """Close the files, and write summary, manifest and figures of what was recorded; return the summary.

        Raises ColdloopError: the run is not complete: `error` ended it early, or a file cannot be written.
        """
        try:
            self.recorder.close()
        except (OSError, ColdloopError) as of_files:
            error = error or of_files
        finally:
            self._reserve.close()
        recorded = self.recorder.next_tick
        if error is not None and not recorded:
            self._discard()
            with contextlib.suppress(OSError):
                self.folder.rmdir()  # it stays if it has logs
            raise _results_error(error, self.folder)
        reason = None if error is None else f"{type(error).__name__}: {error}"
        if isinstance(error, OSError | ColdloopError):
            reason = f"{getattr(error, 'strerror', None) or error}"
        summary = summary_of(self._evaluation, self.recorder, realtime=self._realtime, reason=reason)
        hashes = {**self._manifest["hashes"], "trace_sha256": self._evaluation.trace_sha256}
        ended = {"complete": reason is None, "reason": reason, "ended_utc": _now_utc(), "recorded_ticks": recorded}
        try:
            run_folder.write_json(self.folder / "manifest.json", {**self._manifest, **ended, "hashes": hashes})
            run_folder.write_json(self.folder / "summary.json", summary)
            figure.draw(self.folder)
        except (OSError, ColdloopError) as of_files:
            error = error or of_files
        if error is not None:
            kept = f"{recorded} of {self.recorder.ticks} ticks are recorded in {self.folder}"
            raise _results_error(error, self.folder, kept)
        return summary

    def _discard(self) -> None:
        for name in NAMES:
            (self.folder / name).unlink(missing_ok=True)
        shutil.rmtree(self.folder / INPUTS, ignore_errors=True)


def summary_of(
    evaluation: recording.RunEvaluation, recorder: recording.Recorder, *, realtime: bool, reason: str | None
) -> dict[str, Any]:
    """Return the summary of a run; without a reason it is complete. What does not exist is None.

    Nothing is late in lock-step, so that lateness exists in real time only.
    """
    wall_s, link = recorder.wall_seconds, recorder.link
    lateness = link._asdict() if realtime else dict.fromkeys(link._fields)
    figures = {
        "complete": reason is None, "reason": reason, "ticks": evaluation.ticks,
        "missing_ticks": recorder.missing_ticks, "updates": evaluation.updates,
        "failed_updates": evaluation.failed_updates, "trace_sha256": evaluation.trace_sha256,
        **evaluation.indicators.by_name, **evaluation.excesses, **lateness,
        "deadline_misses": link.deadline_misses, "wall_seconds": round(wall_s, 3),
        "realtime_factor": round(evaluation.ticks * evaluation.process.tick_s / wall_s, 2) if wall_s else None,
    }  # fmt: skip
    unknown = {name: None for name, value in figures.items() if isinstance(value, float) and not math.isfinite(value)}
    return figures | unknown


def _results_error(error: BaseException, folder: Path, kept: str = "") -> BaseException:
    """Return the error with what a user needs to know about the files."""
    if isinstance(error, OSError):
        error = ResultsError(f"{error.filename or folder}: {error.strerror or error}; choose another --out")
    if kept and isinstance(error, ColdloopError):
        error.args = (f"{error}; {kept}",)
    return error


class _FirstTick(recording.Sink):
    """Lets a signal end a run in good order from its first tick on."""

    def sample(self, _: PlantSample) -> None:
        INTERRUPTION.begun()


def make_scenario(settings: Settings, ticks: int | None = None) -> Scenario:
    """Return the scenario of a configuration; without a length it is that of the load."""
    name = settings.plant.load
    load = find_load(name, lti_model.load(settings.model.file).w0, settings.process)
    period_s, session = settings.optimizer_plc.program.updating_period_s, settings.session
    realtime = session.mode is TimeMode.REALTIME
    return Scenario(ticks or natural_ticks(name, load), load, period_s, settings.plant.seed, realtime, session.factor)


def check_certificates(settings: Settings) -> None:
    """Refuse a rig in which a client could not show its server a certificate. Raises UsageError if one has none."""
    clients = [
        ("rig", settings.rig.tls, ("plant", "control_plc", "optimizer_plc")),
        ("control_plc.plant", settings.control_plc.plant.tls, ("plant",)),
        ("optimizer_plc.control_plc", settings.optimizer_plc.control_plc.tls, ("control_plc",)),
    ]
    for client, tls, servers in clients:
        for server in servers:
            if tls is None and getattr(settings, server).server.tls is not None:
                raise UsageError(f"{client}.tls is not set, and {server}.server.tls is: name a client certificate")


def run_into(
    folder: Path, job: Job, arguments: Mapping[str, Any], figure: FigureProcess, sinks: Sequence[recording.Sink]
) -> dict[str, Any]:
    """Do a run in a claimed folder; return its summary. Raises ColdloopError: the run is not complete."""
    stop = StopRequest()
    with INTERRUPTION.passed_to(stop):
        files = RunFiles(folder, job.effective, job.scenario, job.way, arguments, [*sinks, _FirstTick()])
        stop.recorder = files.recorder
        error: BaseException | None = stop.error
        try:
            if error is None and job.way is recording.Way.IN_PROCESS:
                with INTERRUPTION.in_one_process():
                    OneProcessRig(job.effective.settings).run(job.scenario, files.recorder)
            elif error is None:
                from coldloop_rig.cosim import networked_run  # noqa: PLC0415 one process starts without the bus

                networked_run.drive(job, files.recorder, folder, stop)
        except BaseException as of_run:  # noqa: BLE001 raised again by `finish`, after the files are closed
            error = of_run
        summary = files.finish(error, figure)
    if stop.error is not None:
        raise stop.error
    return summary


def repeat(folder: Path, out: Path | None, *, force: bool, trusted: Path | None) -> tuple[bool, str]:
    """Repeat the run of a folder; return whether the traces are the same, and what to print.

    Args:
        folder: Of the run.
        out: Folder for the results of the repetition; None keeps none.
        force: Whether a run in it may be replaced.
        trusted: A model file with the model of the run, which may hold code that a plant executes; None trusts the
            folder.

    Raises:
        UsageError: There is no run to repeat, or an input or the configuration was changed since.
    """
    run = run_folder.RunFolder(folder)
    manifest = run.manifest
    refused = {
        recording.Way.CHAOS: "a run with faults, which depend on the machine; `coldloop chaos` runs the plan again",
        recording.Way.RECORDED: "a session under way was recorded, from its middle on: it cannot be repeated",
    }
    if why := refused.get(manifest["way"]):
        raise UsageError(f"{folder}: {why}")
    if not manifest["recorded_ticks"]:
        raise UsageError(f"{folder}: the run has no ticks: {manifest['reason']}")
    if changed := _changed_inputs(manifest, folder):
        raise UsageError("; ".join(changed))
    if trusted is not None:
        own, ours = run.model, model_file.read_document(trusted)
        if (own.get("process") or ours.get("process")) and own.get("digest") != ours["digest"]:
            remedy = "leave out --process"
            if own.get("process"):
                remedy = "name its file with --process; rerun --trust executes the plant that the folder holds"
            raise UsageError(f"{folder}: a run of {run.process.name}, with another model than now; {remedy}")
    effective = _recorded_configuration(run)
    scenario = make_scenario(effective.settings, manifest["recorded_ticks"])
    if json_digest([scenario.load.times, scenario.load.watts]) != manifest["inputs"]["load"]["profile_sha256"]:
        raise UsageError(f"load {manifest['inputs']['load']['source']}: this version has another load of that name")
    trace = _repeated_trace(effective, scenario, out, force=force)
    if trace == manifest["hashes"]["trace_sha256"]:
        return True, f"{scenario.ticks} ticks, the same trace {trace}\n"
    return False, _differences(manifest, run, trace)


def _recorded_configuration(run: run_folder.RunFolder) -> config.Configuration[Settings]:
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
    options = {key: (value, "manifest") for key, value in values.items()}
    return config.load_configuration(Settings, environment={}, options=options)


def _repeated_trace(
    effective: config.Configuration[Settings], scenario: Scenario, out: Path | None, *, force: bool
) -> str:
    from coldloop_rig.progress import RunProgress  # noqa: PLC0415 a run without a bar starts sooner

    process = effective.settings.process
    with RunProgress(scenario.ticks, process) as progress, FigureProcess(["png"]) as figure:
        if out is not None:
            run_folder.claim_folder(out, force=force)
            summary = run_into(out, Job(effective, scenario, recording.Way.IN_PROCESS), {}, figure, [progress])
            return str(summary["trace_sha256"])
        settings = effective.settings
        evaluation = recording.RunEvaluation(lti_model.load(settings.model.file), settings.optimizer_plc.program.design)
        recorder = recording.Recorder(scenario.ticks, [evaluation, progress])
        OneProcessRig(settings).run(scenario, recorder)
        recorder.close()
        return evaluation.trace_sha256


def _differences(manifest: Mapping[str, Any], run: run_folder.RunFolder, trace: str) -> str:
    lines = [f"another trace: {trace} instead of {manifest['hashes']['trace_sha256']}"]
    if manifest["coldloop"] != __version__:
        lines.append(f"coldloop {__version__} instead of {manifest['coldloop']}")
    versions = ((name, run_folder.installed_version(name)) for name in DEPENDENCIES)
    recorded = {name: manifest["dependencies"].get(name, "absent") for name in DEPENDENCIES}
    lines += [f"{name} {now} instead of {recorded[name]}" for name, now in versions if now != recorded[name]]
    if misses := run.summary["deadline_misses"]:
        lines.append(f"the run missed {misses} deadlines, which depend on the machine")
    if len(lines) == 1:
        lines.append("inputs, configuration and versions are the same: the programs have changed, or the machine")
    return "".join(f"{printable(line)}\n" for line in lines)


PERIOD = "optimizer_plc.program.updating_period_s"


def remarks(effective: config.Configuration[Settings]) -> list[str]:
    """Return remarks for a user before a run, a line each. Raises UsageError: in real time no answer is in time."""
    program, realtime = effective.settings.optimizer_plc.program, effective.settings.session.mode is TimeMode.REALTIME
    process, (budget, _) = effective.settings.process, _budget(program)
    ticks = round(program.updating_period_s / process.tick_s)
    if realtime and ticks and not budget.is_enough(ticks):
        raise UsageError(
            f"{PERIOD} = {program.updating_period_s:g}: this PLC (P = {program.budget.power:g}) needs"
            f" {budget.answer_after_s(1):.3g} s for an answer with {program.solver_name}, and in real time none comes"
            " sooner: give a longer period, adaptive, or --enforce"
        )
    found, left_out = [too_slow(program), certificate(effective.settings)], effective.notes()
    if not process.has_load and "plant.load" in effective.sources:
        found.append(f"load {effective.settings.plant.load}: the {process.name} has no load; only the length is taken")
    adaptive = program.adaptive
    unused = {"q_first", "q_min", "q_max", "delta"} & adaptive.model_fields_set
    usual = AdaptiveSettings.model_fields
    if adaptive.rule is RuleName.CONTRACTION and any(getattr(adaptive, one) != usual[one].default for one in unused):
        named = ", adaptive.".join(sorted(unused))
        found.append(f"adaptive.{named}: of Algorithm 1; the rule is adaptive.rule=contraction")
    if left_out:
        found.append(f"not applied of the preset: {', '.join(left_out)}; `coldloop config` says why")
    return [*filter(None, found)]


def too_slow(program: ProgramSettings) -> str:
    """Return the remark that the PLC is too slow for the simulated controller; empty where it is fast enough."""
    why = _budget(program)[0].too_slow(round(program.updating_period_s / program.process.tick_s))
    return why and (
        f"this PLC (P = {program.budget.power:g}) cannot do what is simulated: with {program.solver_name} {why}; "
        "one iteration is granted all the same (--enforce: not)"
    )


def certificate(settings: Settings, *, only_lost: bool = False) -> str:
    """Return what the fixed updating period means for a plant with a mode that grows; empty for another.

    Where it is adaptive or too short for the PLC it is the PLC's shortest. With `only_lost` it is empty where held.
    """
    limits, program, process, more = settings.limits, settings.optimizer_plc.program, settings.process, ""
    reach, (budget, shortest_s) = np.array([limits.low, limits.high, limits.rate]), _budget(program)
    needs = waiting(lti_model.load(settings.model.file), process, reach, limits.rate_share)
    fixed_s = program.updating_period_s
    rule = "adaptive.contraction" if program.adaptive.rule is RuleName.CONTRACTION else "adaptive"
    most = program.adaptive.contraction.q_max if rule == "adaptive.contraction" else program.adaptive.q_max
    period_s, longest_s = max(fixed_s, shortest_s), budget.times.period(most) * process.tick_s
    if not needs or (only_lost and period_s <= needs.limit_s):
        return ""
    if not fixed_s and longest_s > needs.longest_s >= shortest_s:
        more += f"; adaptive ones go up to {longest_s:.3g} s: lower optimizer_plc.program.{rule}.q_max"
    horizon_s = program.design.horizon * process.sampling_period_s
    if horizon_s > (most_s := digits_last_s(needs.growth, real_of(program.arithmetic))):
        more += (
            f"; the horizon of {horizon_s:.3g} s leaves the problem no digits, in {program.arithmetic} beyond "
            f"{most_s:.3g} s: shorten optimizer_plc.program.design.decision_instants"
        )
    whose = "the PLC's shortest updating period" if period_s > fixed_s else "the updating period"
    return f"a mode of the plant grows with {needs.growth:.3g} /s: {needs.text(period_s, whose)}{more}"


def enforced(effective: config.Configuration[Settings]) -> config.Configuration[Settings]:
    """Return a configuration whose fixed updating period is as long as the PLC takes; an adaptive one always is.

    Raises UsageError: the longest updating period is too short for the PLC, or the shortest too long for the plant.
    """
    program, tick_s = effective.settings.optimizer_plc.program, effective.settings.process.tick_s
    budget, shortest_s = _budget(program)
    if why := budget.too_slow():
        raise UsageError(
            f"--enforce: with {program.solver_name} {why}; take a faster PLC "
            "(optimizer_plc.program.budget.power), another solver, or a longer sampling period"
        )
    if why := certificate(effective.settings, only_lost=True):
        raise UsageError(f"--enforce: {why}; take a faster PLC, a shorter period, or inputs that reach further")
    if not 0 < round(program.updating_period_s / tick_s) < round(shortest_s / tick_s):
        return effective
    settings = effective.settings.with_program(updating_period_s=shortest_s)
    return replace(effective, settings=settings, sources={**effective.sources, PERIOD: "--enforce"})


def _budget(program: ProgramSettings) -> tuple[PlcBudget, float]:
    """Return the budget of the PLC, and the shortest updating period that it takes, s."""
    budget = PlcBudget(program.budget, program.iteration_s)
    return budget, shortest_period_s(budget.times.slots + budget.times.iteration, budget.times.tick_s)
