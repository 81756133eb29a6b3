"""The loop from Python: a run in memory, in one process.

from coldloop_rig import simulate

result = simulate(load="a", solver="ode", updating_period="adaptive", duration_s=600)
result.summary["J_BF"]
result.trace.to_dict()["T5"]
result.plot("run.png")
"""

import warnings
from argparse import ArgumentTypeError
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
from matplotlib.figure import Figure

from coldloop import __version__, errors
from coldloop.config import Configuration
from coldloop.process import declaration, lti_model, updating_periods
from coldloop.registers.common import Event
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.figures import plot
from coldloop_rig.results import file_sinks, run_folder
from coldloop_rig.results.recording import MemorySink, Recorder, Recording, RunEvaluation, StageCost
from coldloop_rig.runs.running import certificate, enforced, make_scenario, summary_of, too_slow
from coldloop_rig.settings import Period, Settings, configured


@dataclass(frozen=True)
class Table:
    """A table of a result; its columns are those of `rig/coldloop_rig/results/columns.py`."""

    arrow: pa.Table

    def __repr__(self) -> str:
        return f"Table({self.arrow.num_rows} rows of {', '.join(self.arrow.column_names)})"

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column."""
        return run_folder.units_of(self.arrow.schema)

    def to_pandas(self) -> Any:  # noqa: ANN401 pandas is not a dependency
        """Return the table as a DataFrame, with the units in `attrs["units"]`; needs pandas."""
        frame = self.arrow.to_pandas()
        frame.attrs["units"] = self.units
        return frame

    def to_dict(self) -> dict[str, list[Any]]:
        """Return the columns as lists by name."""
        return dict(self.arrow.to_pydict())


@dataclass(frozen=True)
class Simulation:
    """The result of `simulate`."""

    recording: Recording
    """The trace as arrays."""
    summary: dict[str, Any]
    """Content of `summary.json`."""
    configuration: dict[str, Any]
    """The effective configuration by dotted key."""
    process: declaration.Process
    """Process that was simulated."""
    _cost: StageCost
    _events: tuple[tuple[str, Event], ...]

    def __repr__(self) -> str:
        program = "optimizer_plc.program."
        tau_u = self.configuration[f"{program}updating_period_s"]
        return (
            f"Simulation(load={self.configuration['plant.load']!r}, solver={self.configuration[f'{program}solver']!r}, "
            f"updating_period={tau_u or 'adaptive'!r}, {self.summary['ticks']} ticks, "
            f"trace {self.summary['trace_sha256'][:12]})"
        )

    @cached_property
    def trace(self) -> Table:
        """One row a tick."""
        history = file_sinks.DrivingHistory(self.process)
        for service, event in self._events:
            history.event(service, event)
        return Table(file_sinks.trace_table(self.recording.block, self.recording.updates, self._cost, history))

    @cached_property
    def updates(self) -> Table:
        """One row an update whose sequence was played."""
        return Table(file_sinks.updates_table(self.recording.updates, self.process))

    @cached_property
    def events(self) -> Table:
        """One row a change of mode or of an alarm."""
        return Table(file_sinks.events_table(self._events, self.process))

    def plot(self, path: str | Path | None = None) -> Figure:
        """Return the figure of the run; with a path it is written there too, as .png, .pdf or .svg."""
        (batch,) = self.trace.arrow.select(["time_s", *plot.labels_of(self.process)]).to_batches()
        series, block = run_folder.batch_series(batch), self.recording.block
        pressures = plot.pressure_limits(self.configuration) if block.station.size else {}
        if pressures:
            (station,) = file_sinks.station_table(block, self.process).select(["time_s", *pressures]).to_batches()
            series |= plot.at_times(run_folder.batch_series(station), series["time_s"])
        identity = f"trace {self.summary['trace_sha256'][:12]}  ·  coldloop {__version__}  ·  in-process"
        process, events = self.process, self.events.arrow.to_pylist()
        edges, title = plot.edges_of(self.configuration, process), plot.title_of(self.configuration, process)
        figure = plot.draw_run(plot.RunCurves(process, series, events, edges, title, identity, pressures))
        if path is not None:
            plot.save_figure(figure, Path(path))
        return figure


def simulate(
    load: str | Path | None = None,
    solver: str | None = None,
    updating_period: Period | None = None,
    *,
    process: str | Path | None = None,
    duration_s: float | str | None = None,
    seed: int | None = None,
    config: str | Path | None = None,
    enforce: bool = False,
    **settings: Mapping[str, Any] | object,
) -> Simulation:
    """Run the three programs in this process, in lock-step; return what they did.

    Example:
        result = simulate(load="a", updating_period=2.5, duration_s=15)
        print(result.summary["tau_u_mean"])
        print(result.trace.to_dict()["T5"][-1], result.trace.units["T5"])

    Args:
        load: Named load such as `a`, or a CSV file with the columns time_s and load_w; by default `2h`.
        solver: `ode`, `qpoases`, `osqp`, `fast-gradient`, `interior-point`, `hybrid` or `daqp`; by default `ode`.
        updating_period: Seconds, from 2 ticks to a sampling period (0.5 to 5 s); `adaptive`, the default.
        process: Process file, or a model file that was made from one; by default the cold box.
        duration_s: Plant time in seconds, multiples of a tick, or a text such as `10min`; by default that of the load.
        seed: Seed of the sensors' noise; by default 1.
        config: TOML file with further settings, such as one that `coldloop config` has written. An argument that is
            given comes before it.
        enforce: Lengthen the updating period to what the PLC takes. Otherwise a warning says where it is too short,
            or too long for a plant with a mode that grows.
        settings: Sections of the configuration, such as `plant={"sensors": {"level": 0.01}}`; they come before the
            file. The environment has no influence.

    Raises:
        UsageError: An argument cannot be used; one line that says why.
    """
    effective = configured(
        load=load, solver=solver, updating_period=updating_period, seed=seed, config=config, sections=settings,
        process=process,
    )  # fmt: skip
    if enforce:
        effective = enforced(effective)
    slow, lost = too_slow(effective.settings.optimizer_plc.program), certificate(effective.settings, only_lost=True)
    for line in filter(None, (slow, lost)):
        warnings.warn(line, stacklevel=2)
    return _run(effective, duration_s)


def _run(effective: Configuration[Settings], duration_s: float | str | None) -> Simulation:
    settings, tick_s, ticks = effective.settings, effective.settings.process.tick_s, None
    if isinstance(duration_s, str):
        try:
            ticks = updating_periods.duration(duration_s).ticks(tick_s, "duration_s")
        except ArgumentTypeError as error:
            raise errors.UsageError(f"duration_s: {error}") from None
    elif duration_s is not None:
        ticks = updating_periods.whole_ticks(duration_s, tick_s)
        if ticks is None or ticks <= 0:
            raise errors.UsageError(f"duration_s={duration_s}: not a positive multiple of {tick_s} s")
    scenario = make_scenario(settings, ticks)
    model, design = lti_model.load(settings.model.file), settings.optimizer_plc.program.design
    evaluation, memory = RunEvaluation(model, design), MemorySink()
    recorder = Recorder(scenario.ticks, [evaluation, memory])
    OneProcessRig(settings).run(scenario, recorder)
    recorder.close()
    return Simulation(
        recording=memory.recording(recorder.link),
        summary=summary_of(evaluation, recorder, realtime=False, reason=None),
        configuration={key: value for key, value, _ in effective.effective() if value is not None},
        process=settings.process,
        _cost=StageCost(model, design),
        _events=tuple(memory.events),
    )
