"""`coldloop run`: one run of the loop, recorded, evaluated and drawn."""

import argparse
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from coldloop.config import Configuration
from coldloop.errors import ResultsError, UsageError
from coldloop.lti_model import load as load_model
from coldloop.process import TICK_S
from coldloop.service import add_configuration_options, run_event_loop
from coldloop.session import TimeMode
from control_plc.settings import ControlStrategy
from plant.load import NAMED, find_load
from rig.commands.options import configuration, duration, endpoint, updating_period
from rig.indicators import evaluate, instantaneous_cost
from rig.local_services import run_on_localhost
from rig.network import NetworkRig, RigEndpoints
from rig.one_process import OneProcessRig
from rig.plot import plot_run
from rig.progress import RunProgress
from rig.recording import Recorder, Recording
from rig.results import manifest, prepare_folder, write_json, write_trace, write_updates
from rig.scenario import Scenario, natural_ticks
from rig.settings import Settings

ATTACH_PATIENCE_S = 5.0


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--mode", choices=[mode.value for mode in TimeMode], help="default: lockstep")
    parser.add_argument("--factor", type=float, help="in real time: seconds of plant time in a second (default: 1)")
    parser.add_argument("--in-process", action="store_true", help="one process and direct calls instead of Modbus/TCP")
    parser.add_argument("--attach", nargs=3, type=endpoint, metavar="HOST:PORT",
                        help="use a rig that is up: plant, control PLC, optimiser PLC")  # fmt: skip
    parser.add_argument("--duration", type=duration, help="plant time, such as 2h or 90s (default: that of the load)")
    parser.add_argument(
        "--load", help=f"{', '.join(NAMED)}, another draw such as a@2, or a CSV file time_s,load_w (default: 2h)"
    )
    parser.add_argument("--solver", help="default: ode")
    parser.add_argument("--updating-period", type=updating_period, metavar="adaptive|SECONDS",
                        help="default: adaptive")  # fmt: skip
    parser.add_argument("--seed", type=int, help="seed of the sensors' noise (default: 1)")
    parser.add_argument("--out", type=Path, help="folder for the results (default: runs/<load>-<time>)")
    parser.set_defaults(execute=execute)


def execute(options: argparse.Namespace) -> int:
    """Run, and write the results."""
    effective = configuration(options)
    settings = effective.settings
    if options.in_process and (options.attach or settings.session.mode is TimeMode.REALTIME):
        raise UsageError("--in-process runs in lock-step and by itself: drop --attach, or --mode realtime")
    scenario = make_scenario(options, settings)
    out = options.out or Path("runs") / f"{Path(settings.plant.load).stem}-{datetime.now():%Y%m%d-%H%M%S}"  # noqa: DTZ005
    prepare_folder(out)
    with RunProgress(scenario.ticks) as progress:
        recorder = Recorder(scenario.ticks, progress)
        _perform(options, settings, scenario, recorder, out)
    try:
        summary = _write(out, effective, options, recorder.recording(), recorder.wall_seconds)
    except OSError as error:
        raise ResultsError(f"{out}: {error.strerror}; no summary was written, choose another --out") from None
    _tell(out, summary)
    return 0


def make_scenario(options: argparse.Namespace, settings: Settings) -> Scenario:
    """Return what the options and the configuration ask for."""
    name = settings.plant.load
    load = find_load(name, load_model(settings.model.file).w0)
    return Scenario(
        ticks=options.duration or natural_ticks(name, load),
        load=load,
        updating_period_s=settings.optimizer_plc.program.updating_period_s,
        seed=settings.plant.seed,
        realtime=settings.session.mode is TimeMode.REALTIME,
        factor=settings.session.factor,
    )


def _perform(
    options: argparse.Namespace, settings: Settings, scenario: Scenario, recorder: Recorder, out: Path
) -> None:
    if options.in_process:
        OneProcessRig(settings).run(scenario, recorder)
    elif options.attach:
        tls = {"tls": settings.rig.tls}
        endpoints = RigEndpoints(*[endpoint.model_copy(update=tls) for endpoint in options.attach])
        run_event_loop(lambda: _attached(endpoints, settings, scenario, recorder))
    else:
        run_event_loop(lambda: _spawned(settings, scenario, recorder, out))


async def _attached(endpoints: RigEndpoints, settings: Settings, scenario: Scenario, recorder: Recorder) -> int:
    rig = NetworkRig(endpoints, settings)
    try:
        await rig.connect(ATTACH_PATIENCE_S)
        await rig.run(scenario, recorder)
    finally:
        rig.close()
    return 0


async def _spawned(settings: Settings, scenario: Scenario, recorder: Recorder, out: Path) -> int:
    _check_certificates(settings)
    await run_on_localhost(settings, scenario, recorder, out / "logs")
    return 0


def _check_certificates(settings: Settings) -> None:
    """Refuse a rig in which a client could not show its server a certificate."""
    clients = [
        ("rig", settings.rig.tls, ("plant", "control_plc", "optimizer_plc")),
        ("control_plc.plant", settings.control_plc.plant.tls, ("plant",)),
        ("optimizer_plc.control_plc", settings.optimizer_plc.control_plc.tls, ("control_plc",)),
    ]
    for client, tls, servers in clients:
        for server in servers:
            if tls is None and getattr(settings, server).server.tls is not None:
                raise UsageError(f"{client}.tls is not set, and {server}.server.tls is: name a client certificate")


def _write(
    out: Path, effective: Configuration[Settings], options: argparse.Namespace, recording: Recording, wall: float
) -> dict[str, Any]:
    settings = effective.settings
    design = settings.optimizer_plc.program.design
    model = load_model(settings.model.file)
    simulated = len(recording.load) * TICK_S
    summary = {
        "ticks": len(recording.load),
        "updates": len(recording.updates),
        "trace_sha256": recording.trace_sha256,
        **evaluate(recording, model, design)._asdict(),
        **recording.link._asdict(),
        "wall_seconds": round(wall, 3),
        "realtime_factor": round(simulated / wall, 2),
    }
    cost = instantaneous_cost(recording, model, design)
    hashes = {"model_sha256": model.digest, "plant_parameters_sha256": model.parameters_digest,
              "trace_sha256": recording.trace_sha256}  # fmt: skip
    arguments = {name: str(value) for name, value in vars(options).items() if name != "execute" and value is not None}
    configured = {key: value for key, value, _ in effective.effective() if value is not None}  # None is "not set"
    write_trace(out / "trace.parquet", recording)
    write_updates(out / "updates.parquet", recording)
    write_json(out / "manifest.json", manifest(configured, arguments, hashes))
    plot_run(out / "run.png", recording, design, f"load {settings.plant.load}, {_driven_by(settings)}", cost)
    write_json(out / "summary.json", summary)
    return summary


def _driven_by(settings: Settings) -> str:
    if settings.control_plc.driver is ControlStrategy.CLASSICAL:
        return "classical loops"
    period = settings.optimizer_plc.program.updating_period_s
    return f"tau_u {period:g} s" if period else "tau_u adaptive"


def _tell(out: Path, summary: dict[str, Any]) -> None:
    updates = "no updates"
    if summary["updates"]:
        updates = f"{summary['updates']} updates, tau_u {summary['tau_u_mean']:.2f} s on average"
    sys.stdout.write(
        f"{summary['ticks']} ticks, {updates}, "
        f"{summary['realtime_factor']:,.0f} x real time\n"
        f"outside the bands: L1 {summary['L1_outside_band_pct']:.2f} %, T5 {summary['T5_outside_band_pct']:.2f} %; "
        f"J_BF {summary['J_BF']:.4g}; deadline misses {summary['deadline_misses']}\n"
        f"trace {summary['trace_sha256']}\n"
        f"results in {out}\n"
    )
