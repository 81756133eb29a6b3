"""A dashboard for Grafana of the Prometheus metrics of a rig: its services, its process, its updating period."""

import json
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple

from coldloop.process.declaration import Process

WIDTH: Final = 24
"""Of a board, in Grafana's units."""
UNITS: Final = {"%": "percent", "K": "kelvin", "W": "watt"}
"""Grafana's names of units; others are in the title of the panel."""
DATASOURCE: Final = {"type": "prometheus", "uid": "${datasource}"}
Curve = tuple[str, str]
"""Expression and legend."""


class Panel(NamedTuple):
    """A panel of a board."""

    title: str
    unit: str
    curves: tuple[Curve, ...]


STATE: Final = (
    Panel("Services", "short", (("coldloop_up", "{{service}}"),)),
    Panel("Mode (0 hold, 1 MPC, 2 classical, 3 rest, 4 manual)", "short",
          (("coldloop_control_plc_ladder_mode", "mode"),)),
    Panel("Alarms that wait", "short",
          (("count(coldloop_alarm_state == 1) + count(coldloop_alarm_state == 3) or vector(0)", "waiting"),)),
    Panel("Deadlines missed", "short", (("coldloop_control_plc_status_deadline_misses", "missed"),)),
)  # fmt: skip
OPTIMISER: Final = (
    Panel("Cost", "short",
          (("coldloop_update_j_effective", "J reached"), ("coldloop_update_j_delivered", "J predicted"))),
    Panel("Lateness of scans", "ms",
          (("coldloop_control_plc_status_lateness_p99", "99th percentile"),
           ("coldloop_control_plc_status_lateness_max", "largest"))),
    Panel("Age of what is known", "s", (("coldloop_age_seconds", "{{service}}"),)),
)  # fmt: skip


def board(process: Process) -> str:
    """Return the dashboard of a process, as JSON to import."""
    period = Panel(f"Updating period, ticks of {process.tick_unit}", "short",
                   (("coldloop_update_tau_u", "tau_u"), ("coldloop_update_iterations", "iterations")))  # fmt: skip
    panels = [
        *_laid_out(STATE, "stat", 0, 4, 4),
        *_laid_out((*_process(process), period, *OPTIMISER), "timeseries", 4, 2, 7),
    ]
    document = {
        "title": "Coldloop", "uid": "coldloop", "schemaVersion": 39, "version": 1, "editable": True, "refresh": "5s",
        "time": {"from": "now-30m", "to": "now"}, "tags": ["coldloop"],
        "templating": {"list": [{"name": "datasource", "type": "datasource", "query": "prometheus",
                                 "label": "Prometheus"}]},
        "panels": [{"id": number, **panel} for number, panel in enumerate(panels, 1)],
    }  # fmt: skip
    return json.dumps(document, indent=1) + "\n"


def _process(process: Process) -> Iterable[Panel]:
    """Yield outputs with their bands, then the inputs by unit, those in the unit of the load with it."""
    limits = "coldloop_optimizer_plc_operating_limits_output"
    for one in process.banded:
        bounds = ((f"{limits}_{end}{_of(one.name)}", end) for end in ("low", "high"))
        yield _panel(one.name, one.unit, ((f"coldloop_control_plc_process_y{_of(one.name)}", one.name), *bounds))
    unit_of_load = process.load.unit
    curves = {unit_of_load: [("coldloop_control_plc_process_load", "load")]}
    for unit, group in groupby(sorted(process.inputs, key=lambda one: one.unit), key=lambda one: one.unit):
        curves.setdefault(unit, []).extend(
            (f"coldloop_control_plc_process_u{_of(one.name)}", one.name) for one in group
        )
    with_load = curves.pop(unit_of_load)
    for unit, each in curves.items():
        yield _panel("Inputs", unit, tuple(each))
    yield _panel("Load", unit_of_load, tuple(with_load))


def _panel(title: str, unit: str, curves: tuple[Curve, ...]) -> Panel:
    known = UNITS.get(unit)
    return Panel(title if known or not unit else f"{title} ({unit})", known or "short", curves)


def _of(name: str) -> str:
    return f'{{element="{name}"}}'


def _laid_out(panels: Sequence[Panel], kind: str, top: int, across: int, height: int) -> Iterable[dict[str, Any]]:
    """Yield panels in rows of so many."""
    width = WIDTH // across
    for place, panel in enumerate(panels):
        yield {
            "type": kind, "title": panel.title,
            "gridPos": {"x": place % across * width, "y": top + place // across * height, "w": width, "h": height},
            "datasource": DATASOURCE,
            "fieldConfig": {
                "defaults": {"unit": panel.unit, "custom": {"lineInterpolation": "stepAfter", "fillOpacity": 0}},
                "overrides": [],
            },
            "targets": [
                {"refId": chr(ord("A") + number), "expr": expression, "legendFormat": legend}
                for number, (expression, legend) in enumerate(panel.curves)
            ],
        }  # fmt: skip
