"""A chaos plan from beginning to end: run, run again without faults, judged by fault, and reported."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from coldloop import config, errors, text
from coldloop.process import declaration, lti_model
from coldloop.registers import common, control_plc
from coldloop.service.journal import alarm_word
from coldloop_chaos.faults import ChaosPlan
from coldloop_chaos.sequencer import ChaosTrace, Mark, ShowProgress, conduct
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Job
from coldloop_rig.figures import plot, worker
from coldloop_rig.progress import PlantTimeBar, clock, make_console
from coldloop_rig.results.recording import Recorder, Recording, Way, excess_of
from coldloop_rig.results.run_folder import write_json
from coldloop_rig.runs.running import run_into
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import aligned, markdown_table

Numbers = tuple[float, ...]
"""A number for each input, or for each output with a band."""


class RaisedAlarm(NamedTuple):
    """An alarm, and how long after the beginning of the fault it was raised."""

    name: str
    after_s: float
    after_done_s: float
    """Delay from the tick at which the fault was certainly in effect, s; in lock-step ticks pass between the two."""


class Row(NamedTuple):
    """One fault. Its window lasts from its beginning to that of the next one, or to the end of the run."""

    fault: str
    at_s: float
    lasted_s: float | None
    """Plant time, until what was stopped answered again; None when it did not end within the run."""
    modes: tuple[str, ...]
    """The mode before, and those passed until the next fault."""
    alarms: tuple[RaisedAlarm, ...]
    """Alarms raised in the window."""
    largest_steps: Numbers
    """Largest change of each input from a tick to the next, as a share of its limit."""
    outside_s: Numbers
    """Time in the window that each output with a band was outside, beyond its dead band."""
    undisturbed_s: Numbers
    """Time outside in the same window of the run without faults, s."""
    back_s: float | None
    """Time from the end of the fault to mode MPC, s: 0 if MPC drove then, None if it did not return in the window."""

    @property
    def largest_step(self) -> float:
        """The largest share among the inputs."""
        return max(self.largest_steps)


class Evaluation(NamedTuple):
    """A run."""

    rows: list[Row]
    largest_steps: Numbers
    outside_s: Numbers
    undisturbed_s: Numbers
    missing_ticks: int


def evaluate(trace: ChaosTrace, undisturbed: Recording, rate: Numbers, design: ControlDesign) -> Evaluation:
    """Compute the rows of all faults, and the same for the whole run; `rate` is the largest change of each input."""
    recording, tick_s = trace.recording(), trace.process.tick_s
    u = recording.u.astype(float)
    steps = np.nan_to_num(np.abs(np.diff(u, axis=0, prepend=u[:1])) / np.array(rate))  # 0 where it is not known
    outside, was = (excess_of(one.y, design) > design.process.dead_bands for one in (recording, undisturbed))

    def measured(ticks: slice) -> tuple[Numbers, Numbers, Numbers]:
        """Return the largest steps, and the times outside with and without faults."""
        outside_s, was_s = (tuple((one[ticks].sum(axis=0) * tick_s).tolist()) for one in (outside, was))
        return tuple(np.max(steps[ticks], axis=0, initial=0.0).tolist()), outside_s, was_s

    ends = [*((later.begin, later.first_event) for later in trace.marks[1:]), (trace.ticks, len(trace.events))]
    windows = zip(trace.marks, ends, strict=False)
    rows = [_row(trace, mark, last, measured(slice(mark.begin, end))) for mark, (end, last) in windows]
    return Evaluation(rows, *measured(slice(None)), trace.missing)


def _row(trace: ChaosTrace, mark: Mark, last_event: int, measured: tuple[Numbers, Numbers, Numbers]) -> Row:
    tick_s = trace.process.tick_s
    before = [control_plc.Mode(event.subject) for event in trace.modes(0, mark.first_event)[-1:]]
    changes = trace.modes(mark.first_event, last_event)
    modes = [*before, *(control_plc.Mode(event.subject) for event in changes)]
    lasted_s = back_s = None
    if mark.end is not None:
        lasted_s = (mark.end - mark.begin) * tick_s
        at_end = [*before, *(control_plc.Mode(event.subject) for event in changes if event.tick <= mark.end)]
        back = [event.tick for event in changes if event.tick > mark.end and event.subject == control_plc.Mode.MPC]
        if at_end and at_end[-1] is control_plc.Mode.MPC:
            back_s = 0.0
        elif back:
            back_s = (back[0] - mark.end) * tick_s
    passed = tuple(mode.name for mode, previous in zip(modes, [None, *modes], strict=False) if mode is not previous)
    instants = (mark.begin, mark.begin if mark.done is None else mark.done)
    alarms = tuple(
        RaisedAlarm(
            common.alarm_key(event.subject, trace.process).upper(),
            *(max(0, event.tick - at) * tick_s for at in instants),
        )
        for event in trace.events[mark.first_event : last_event]
        if event.kind == common.EventKind.ALARM_RAISED
    )
    return Row(mark.fault.label, mark.begin * tick_s, lasted_s, passed, alarms, *measured, back_s)


class Experiment(NamedTuple):
    """A plan, and what it has led to."""

    plan: ChaosPlan
    trace: ChaosTrace
    undisturbed: Recording
    evaluation: Evaluation
    design: ControlDesign
    """Has the bands that it was judged by."""
    failure: str | None
    """Reason why the run ended early; None if it did not."""


def perform(
    plan: ChaosPlan, effective: config.Configuration[Settings], folder: Path, progress: ShowProgress, *,
    arguments: Mapping[str, Any], formats: Sequence[str],
) -> Experiment:  # fmt: skip
    """Run a plan into a folder that is claimed, and the same without faults; a run that fails is evaluated as it is.

    The values of the plan are recorded in the place of those of the configuration. Raises LoadFileError: the load of
    the plan cannot be had; ColdloopError: the run was interrupted, or failed before its first tick.
    """
    settings = plan.with_plant(effective.settings)
    scenario = plan.scenario(lti_model.load(settings.model.file).w0)
    trace = ChaosTrace(scenario.ticks, settings.process)
    failure, conducted = None, partial(conduct, plan, scenario, settings, trace, progress)
    try:
        job = Job(plan.configured(effective), scenario, Way.CHAOS, conduct=conducted)
        with worker.FigureProcess(formats) as figure:
            run_into(folder, job, arguments, figure, [trace])
    except errors.LinkError as error:
        if trace.missing == trace.ticks:
            raise
        failure = str(error)
    alone = Recorder(scenario.ticks)
    OneProcessRig(settings).run(scenario, alone)
    undisturbed, design = alone.recording(), settings.optimizer_plc.program.design
    evaluation = evaluate(trace, undisturbed, settings.limits.rate, design)
    return Experiment(plan, trace, undisturbed, evaluation, design, failure)


REFRESH_S: Final = 0.2


class ChaosProgress(PlantTimeBar):
    """A progress bar on standard error: plant time, mode, and the faults that are on."""

    def __init__(self, plan: ChaosPlan) -> None:
        self._bar = Progress(
            TextColumn("{task.fields[clock]}"), BarColumn(bar_width=24), TaskProgressColumn(),
            TextColumn("{task.fields[line]}"), console=make_console(), auto_refresh=False,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=plan.ticks, clock="0:00:00", line="")
        self._plan = plan
        self._shown = time.monotonic()

    def __call__(self, tick: int, ladder: control_plc.LadderStatus | None, faults: list[str]) -> None:
        """Show where the run is, a few times a second, and its end."""
        now = time.monotonic()
        if now - self._shown < REFRESH_S and tick < self._plan.ticks:
            return
        self._shown = now
        self._bar.start()
        line = "  ".join([control_plc.Mode(ladder.mode).name if ladder is not None else "control PLC away", *faults])
        self._bar.update(self._task, completed=tick, clock=clock(tick * self._plan.process.tick_s), line=line)
        self._bar.refresh()


MANY_MODES: Final = 8  # more modes than this are not all named in a table


def table(rows: Sequence[Row], process: declaration.Process) -> str:
    """Return all rows for a terminal."""
    return aligned(_cells(rows, process))


def write_report(out: Path, experiment: Experiment) -> None:
    """Write chaos.json and chaos.md."""
    plan, trace, undisturbed, evaluation, _, failure = experiment
    write_json(out / "chaos.json", {
        "plan": text.parsed_json(plan.model_dump_json()),
        "failure": failure,
        "faults": [
            {**row._asdict(), "alarms": [alarm._asdict() for alarm in row.alarms], "back_s": row.back_s}
            for row in evaluation.rows
        ],
        "largest_steps": dict(zip(trace.process.input_names, evaluation.largest_steps, strict=True)),
        "outside_s": evaluation.outside_s,
        "undisturbed_outside_s": evaluation.undisturbed_s,
        "missing_ticks": evaluation.missing_ticks,
        "lost_contacts": trace.lost_contacts,
        "ladder": trace.ladder._asdict() if trace.ladder else None,
        "alarms": {common.alarm_key(i, trace.process).upper(): alarm._asdict() for i, alarm in enumerate(trace.alarms)},
        "events": [event._asdict() for event in trace.events],
        "resources": [sample._asdict() for sample in trace.resources],
        "log_lines": trace.log_lines,
        "wall_seconds": round(trace.seconds, 3),
        "trace_sha256": trace.recording().trace_sha256,
        "undisturbed_trace_sha256": undisturbed.trace_sha256,
    })  # fmt: skip
    headings, *cells = _cells(evaluation.rows, trace.process)
    lines = [
        f"# Chaos plan {plan.name}\n",
        f"{plan.description}\n",
        f"Load {plan.load}, {plan.duration_s:g} s, seed {plan.seed}, {plan.mode}.\n",
        *([f"**The run failed:** {failure}\n"] if failure else []),
        markdown_table(headings, cells) + "\n",
        *(f"- {line}" for line in summary_lines(trace, evaluation)),
        "\n![Outputs, inputs, modes, faults](chaos.png)\n",
    ]
    text.whole_text(out / "chaos.md", "\n".join(lines))


def summary_lines(trace: ChaosTrace, evaluation: Evaluation) -> list[str]:
    """Return the lines below the table."""
    process, largest = trace.process, evaluation.largest_steps
    steps = ", ".join(f"{name} {step:.3f}" for name, step in zip(process.input_names, largest, strict=True))
    times = [
        f"{one.name} {seconds:g} s ({'undisturbed ' if one is process.banded[0] else ''}{before:g} s)"
        for one, seconds, before in zip(process.banded, evaluation.outside_s, evaluation.undisturbed_s, strict=True)
    ]
    lines = [
        f"largest step/limit: {steps}",
        f"outside the bands: {', '.join(times)}",
        f"ticks not seen: {evaluation.missing_ticks} of {trace.ticks}",
    ]
    if trace.ladder is not None:
        lines.append(f"mode at the end: {control_plc.Mode(trace.ladder.mode).name}, {trace.ladder.events} events")
    active = [alarm_word(i, process) for i, alarm in enumerate(trace.alarms) if alarm.state != common.AlarmState.NORMAL]
    if active:
        lines.append(f"alarms active or unacknowledged: {', '.join(active)}")
    for service, count in trace.log_lines.items():
        sizes = [sample.rss_mb[service] for sample in trace.resources if service in sample.rss_mb]
        if sizes:
            memory = f"{sizes[0]:.0f} MB at first, {max(sizes):.0f} MB at most, {sizes[-1]:.0f} MB at last"
            lines.append(f"{service}: {memory}; {count} log lines")
    return lines


def _cells(rows: Sequence[Row], process: declaration.Process) -> list[list[str]]:
    """Return the headings, and the cells of each row; each alarm once, when it was first raised and how often."""
    bands = [f"{one.name} out s (was)" for one in process.banded]
    words = {
        common.alarm_key(alarm, process).upper(): alarm_word(alarm, process) for alarm in common.alarms_of(process)
    }
    cells = [["fault", "at s", "lasted s", "modes", "alarms (s after)", "step/limit", *bands, "back to MPC s"]]
    for row in rows:
        modes: Sequence[str] = row.modes
        if len(modes) > MANY_MODES:
            modes = [*modes[: MANY_MODES - 2], f"({len(modes) - MANY_MODES} more)", *modes[-2:]]
        first = {words[alarm.name]: alarm.after_s for alarm in reversed(row.alarms)}
        times = Counter(words[alarm.name] for alarm in row.alarms)
        alarms = [f"{name} {first[name]:g}" + (f" (x{count})" if count > 1 else "") for name, count in times.items()]
        lasted = "-" if row.lasted_s is None else f"{row.lasted_s:g}"
        back = "not" if row.back_s is None else f"{row.back_s:g}"
        outside = [f"{outside:g} ({was:g})" for outside, was in zip(row.outside_s, row.undisturbed_s, strict=True)]
        named = [" > ".join(modes) or "-", ", ".join(alarms) or "none"]
        cells.append([row.fault, f"{row.at_s:g}", lasted, *named, f"{row.largest_step:.3f}", *outside, back])
    return cells


MANY: Final = 24  # more faults than this are marked, but not named


def plot_chaos(path: Path, experiment: Experiment) -> None:
    """Draw outputs with their bands and without faults, inputs, and modes, with the faults marked (PNG)."""
    plan, trace, undisturbed, _, design, _ = experiment
    process = trace.process
    minutes = np.arange(trace.ticks) * process.tick_s / 60
    recording = trace.recording()
    bands = list(zip(design.output_low, design.output_high, strict=True))
    with plot.styled():
        figure = Figure(figsize=(10, 10), layout="constrained")
        units: dict[str, list[int]] = {}  # inputs that have the same unit share a panel
        for number, unit in enumerate(process.input_units):
            units.setdefault(unit, []).append(number)
        heights = [*[3] * (len(bands) + len(units)), 1]
        *panels, ribbon = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        axes: list[Axes] = panels
        controlled = zip(process.controlled, process.banded, bands, strict=True)
        for place, (output, one, band) in zip(axes, controlled, strict=False):
            place.axhspan(*band, color=plot.BAND, alpha=0.35, label=f"band {text.ends_text(*band)}")
            place.plot(minutes, undisturbed.y[:, output], color=plot.THIRD, linewidth=0.8, label="undisturbed")
            place.plot(minutes, recording.y[:, output], color=plot.INK, linewidth=1, label="with faults")
            place.set_ylabel(plot.with_unit(one.name, one.unit))
            plot.legend_above(place)
        for place, inputs in zip(axes[len(bands) :], units.values(), strict=True):
            for i, colour in zip(inputs, cycle(plot.COLOURS), strict=False):
                place.plot(minutes, recording.u[:, i], color=colour, linewidth=1, label=process.inputs[i].name)
            place.set_ylim(*plot.view(recording.u[:, inputs]))
            first = process.inputs[inputs[0]]
            place.set_ylabel(plot.with_unit(first.name if len(inputs) == 1 else "inputs", first.unit))
            if len(inputs) > 1:
                plot.legend_above(place)
        _draw_modes(ribbon, trace)
        for mark in trace.marks:
            begin, end = (tick * process.tick_s / 60 for tick in (mark.begin, mark.end or mark.begin))
            for place in axes:
                place.axvline(begin, color=plot.ACCENT, linewidth=0.8, linestyle=":")
                if end > begin:
                    place.axvspan(begin, end, color=plot.ACCENT, alpha=0.08, linewidth=0)
            if len(trace.marks) <= MANY:
                axes[0].annotate(
                    mark.fault.label, (begin, 1.14), xycoords=("data", "axes fraction"), rotation=35, ha="left",
                    va="bottom", fontsize=7,
                )  # fmt: skip
        ribbon.set_xlabel("time (min)")
        ribbon.set_xlim(0, trace.ticks * process.tick_s / 60)
        plot.label_marks(figure)
        figure.suptitle(f"{plan.name}: {plan.description}")
        text.whole_file(path, lambda draft: figure.savefig(draft, dpi=130, format="png"))


def _draw_modes(axes: Axes, trace: ChaosTrace) -> None:
    tick_s = trace.process.tick_s
    changes = [(event.tick, control_plc.Mode(event.subject)) for event in trace.modes()]
    ends = [tick for tick, _ in changes[1:]] + [trace.ticks]
    for (tick, mode), end in zip(changes, ends, strict=False):
        axes.axvspan(tick * tick_s / 60, end * tick_s / 60, color=plot.MODE_COLOURS[mode.name.lower()], linewidth=0)
    present = {mode.name.lower() for _, mode in changes}
    axes.legend(
        handles=[Patch(color=colour, label=mode) for mode, colour in plot.MODE_COLOURS.items() if mode in present],
        loc="upper center", bbox_to_anchor=(0.5, -0.6), ncols=len(plot.MODE_COLOURS),
    )  # fmt: skip
    axes.set_yticks([])
    axes.set_ylabel("mode")
