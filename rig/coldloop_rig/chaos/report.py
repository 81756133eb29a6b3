"""The files of a run under chaos, and its table."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from coldloop.parsing import parsed_json
from coldloop.process.declaration import Process
from coldloop.registers.control_plc import Mode
from coldloop.registers.safety import AlarmState, alarm_key, alarms_of
from coldloop.service.event_text import alarm_word
from coldloop.whole_file import whole_text
from coldloop_rig.chaos.evaluation import Evaluation, RaisedAlarm, Row
from coldloop_rig.chaos.plan import ChaosPlan
from coldloop_rig.chaos.trace import ChaosTrace
from coldloop_rig.results.folders import write_json
from coldloop_rig.text_tables import aligned, markdown_table

MANY_MODES: Final = 8
"""More modes than this are not all named in a table."""


def table(rows: Sequence[Row], process: Process) -> str:
    """Return all rows for a terminal."""
    return aligned([_headings(process), *(_cells(row, process) for row in rows)])


def _headings(process: Process) -> list[str]:
    bands = [f"{one.name} out s (was)" for one in process.banded]
    return ["fault", "at s", "lasted s", "modes", "alarms (s after)", "step/limit", *bands, "back to MPC s"]


def write_report(
    out: Path, plan: ChaosPlan, trace: ChaosTrace, evaluation: Evaluation, hashes: dict[str, str], failure: str | None
) -> None:
    """Write chaos.json and chaos.md."""
    write_json(out / "chaos.json", document(plan, trace, evaluation, hashes, failure))
    whole_text(out / "chaos.md", _page(plan, trace, evaluation, failure))


def document(
    plan: ChaosPlan, trace: ChaosTrace, evaluation: Evaluation, hashes: dict[str, str], failure: str | None
) -> dict[str, Any]:
    """Return what chaos.json holds."""
    return {
        "plan": parsed_json(plan.model_dump_json()),
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
        "alarms": {alarm_key(i, trace.process).upper(): alarm._asdict() for i, alarm in enumerate(trace.alarms)},
        "events": [event._asdict() for event in trace.events],
        "resources": [sample._asdict() for sample in trace.resources],
        "log_lines": trace.log_lines,
        "wall_seconds": round(trace.seconds, 3),
        **hashes,
    }


def summary_lines(trace: ChaosTrace, evaluation: Evaluation) -> list[str]:
    """Return the lines below the table."""
    process, largest = trace.process, evaluation.largest_steps
    steps = ", ".join(f"{name} {step:.3f}" for name, step in zip(process.input_names, largest, strict=True))
    outside, was = evaluation.outside_s, evaluation.undisturbed_s
    lines = [
        f"largest step/limit: {steps}",
        "outside the bands: "
        + ", ".join(
            f"{one.name} {seconds:g} s ({'undisturbed ' if one is process.banded[0] else ''}{before:g} s)"
            for one, seconds, before in zip(process.banded, outside, was, strict=True)
        ),
        f"ticks not seen: {evaluation.missing_ticks} of {trace.ticks}",
    ]
    if trace.ladder is not None:
        lines.append(f"mode at the end: {Mode(trace.ladder.mode).name}, {trace.ladder.events} events")
    active = [alarm_word(i, process) for i, alarm in enumerate(trace.alarms) if alarm.state != AlarmState.NORMAL]
    if active:
        lines.append(f"alarms active or unacknowledged: {', '.join(active)}")
    return [*lines, *_resource_lines(trace)]


def _resource_lines(trace: ChaosTrace) -> list[str]:
    if not trace.resources:
        return []
    lines = []
    for service, count in trace.log_lines.items():
        sizes = [sample.rss_mb[service] for sample in trace.resources if service in sample.rss_mb]
        if sizes:
            lines.append(
                f"{service}: {sizes[0]:.0f} MB at first, {max(sizes):.0f} MB at most, {sizes[-1]:.0f} MB at last; "
                f"{count} log lines"
            )
    return lines


def _page(plan: ChaosPlan, trace: ChaosTrace, evaluation: Evaluation, failure: str | None) -> str:
    lines = [
        f"# Chaos plan {plan.name}\n",
        f"{plan.description}\n",
        f"Load {plan.load}, {plan.duration_s:g} s, seed {plan.seed}, {plan.mode}.\n",
        *([f"**The run failed:** {failure}\n"] if failure else []),
        markdown_table(_headings(trace.process), (_cells(row, trace.process) for row in evaluation.rows)) + "\n",
        *(f"- {line}" for line in summary_lines(trace, evaluation)),
        "\n![Outputs, inputs, modes, faults](chaos.png)\n",
    ]
    return "\n".join(lines)


def _cells(row: Row, process: Process) -> list[str]:
    return [
        row.fault,
        f"{row.at_s:g}",
        "-" if row.lasted_s is None else f"{row.lasted_s:g}",
        _modes(row.modes),
        _alarms(row.alarms, process),
        f"{row.largest_step:.3f}",
        *(f"{outside:g} ({was:g})" for outside, was in zip(row.outside_s, row.undisturbed_s, strict=True)),
        "not" if row.back_s is None else f"{row.back_s:g}",
    ]


def _modes(modes: Sequence[str]) -> str:
    if len(modes) > MANY_MODES:
        modes = [*modes[: MANY_MODES - 2], f"({len(modes) - MANY_MODES} more)", *modes[-2:]]
    return " > ".join(modes) or "-"


def _alarms(alarms: Sequence[RaisedAlarm], process: Process) -> str:
    """Return each alarm once: when it was first raised, and how often if more than once."""
    words = {alarm_key(alarm, process).upper(): alarm_word(alarm, process) for alarm in alarms_of(process)}
    named = [(words[alarm.name], alarm.after_s) for alarm in alarms]
    times, first = Counter(name for name, _ in named), dict(reversed(named))
    cells = [f"{name} {first[name]:g}" + (f" (x{count})" if count > 1 else "") for name, count in times.items()]
    return ", ".join(cells) or "none"
