"""One run into a folder: driven, recorded, evaluated, drawn. What is recorded survives an interruption."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coldloop.errors import UsageError
from coldloop.process.lti_model import load as load_model
from coldloop.registers.plant import PlantSample
from coldloop.session.settings import TimeMode
from coldloop_plant.load import find_load
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Job, Scenario, StopRequest, natural_ticks
from coldloop_rig.figures.worker import FigureProcess
from coldloop_rig.interruption import INTERRUPTION
from coldloop_rig.results.recording import Recorder, Sink
from coldloop_rig.results.way import Way
from coldloop_rig.runs.run_files import RunFiles
from coldloop_rig.settings import Settings


class _FirstTick(Sink):
    """Lets a signal end a run in good order from its first tick on."""

    def sample(self, _: PlantSample) -> None:
        """Take a tick."""
        INTERRUPTION.begun()


def make_scenario(settings: Settings, ticks: int | None = None) -> Scenario:
    """Return the scenario of a configuration; without a length it is that of the load."""
    name = settings.plant.load
    load = find_load(name, load_model(settings.model.file).w0, settings.process)
    return Scenario(
        ticks=ticks or natural_ticks(name, load),
        load=load,
        updating_period_s=settings.optimizer_plc.program.updating_period_s,
        seed=settings.plant.seed,
        realtime=settings.session.mode is TimeMode.REALTIME,
        factor=settings.session.factor,
    )


def check_certificates(settings: Settings) -> None:
    """Refuse a rig in which a client could not show its server a certificate.

    Raises:
        UsageError: One has none.
    """
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
    folder: Path, job: Job, arguments: Mapping[str, Any], figure: FigureProcess, sinks: Sequence[Sink]
) -> dict[str, Any]:
    """Do a run in a folder that is claimed; return its summary.

    Raises:
        ColdloopError: The run is not complete; what was recorded is in the folder.
    """
    stop = StopRequest()
    with INTERRUPTION.passed_to(stop):
        files = RunFiles(folder, job.effective, job.scenario, job.way, arguments, [*sinks, _FirstTick()])
        stop.recorder = files.recorder
        error: BaseException | None = stop.error
        try:
            if error is None:
                _drive(job, files.recorder, folder, stop)
        except BaseException as of_run:  # noqa: BLE001 raised again by `finish`, after the files are closed
            error = of_run
        summary = files.finish(error, figure)
    if stop.error is not None:
        raise stop.error
    return summary


def _drive(job: Job, recorder: Recorder, folder: Path, stop: StopRequest) -> None:
    if job.way is Way.IN_PROCESS:
        with INTERRUPTION.in_one_process():
            OneProcessRig(job.effective.settings).run(job.scenario, recorder)
        return
    from coldloop_rig.cosim import networked_run  # noqa: PLC0415 a run in one process starts without the bus

    networked_run.drive(job, recorder, folder, stop)
