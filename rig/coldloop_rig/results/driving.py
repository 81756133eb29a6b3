"""Who drove at each tick, why, and which sensors were bad or faulty: from the events of control PLC and plant."""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from coldloop.process.declaration import Process
from coldloop.registers.audit import Event, EventKind
from coldloop.registers.control_plc import Cause, Mode
from coldloop.registers.plant import SensorFaultKind
from coldloop_rig.results.arrow_arrays import number_array, text_array

CONTROL: Final = "control_plc"
PLANT: Final = "plant"

DRIVERS: Final[Mapping[int, str]] = {
    Mode.MPC: "optimizer",
    Mode.REST: "optimizer",
    Mode.HOLD: "nobody",
    Mode.CLASSICAL: "loops",
    Mode.MANUAL: "operator",
}
"""Source of the applied inputs in each mode; "nobody" while the last ones are held."""


class Driving(NamedTuple):
    """State of the control PLC from one tick on."""

    tick: int = 0
    mode: int | None = None
    cause: int = Cause.NONE
    bad: frozenset[int] = frozenset()
    """Outputs whose measurement was substituted."""


class SensorFaultRecord(NamedTuple):
    """What is wrong with a sensor from one tick on."""

    tick: int
    kind: int
    value: float


class DrivingHistory:
    """Takes events of a process in the order of each journal; returns the columns of ticks that do not come back.

    A restarted control PLC may resume some ticks back: its later events hold from there on.
    """

    def __init__(self, process: Process) -> None:
        self.process = process
        self._states = [Driving()]
        self._faults: dict[int, list[SensorFaultRecord]] = {output: [] for output in process.controlled}
        self._held = dict.fromkeys(process.controlled, math.nan)
        """What a frozen sensor shows."""

    def event(self, service: str, event: Event) -> None:
        """Take an event."""
        if service == PLANT:
            if event.kind == EventKind.SESSION:  # it begins with healthy sensors
                self._faults = {output: [] for output in self._faults}
            elif event.kind == EventKind.SENSOR_FAULT and event.subject in self._faults:
                self._faults[event.subject].append(SensorFaultRecord(event.tick, event.cause, event.value))
            return
        last = self._states[-1]
        if event.kind == EventKind.MODE:
            self._change(last._replace(tick=event.tick, mode=event.subject, cause=event.cause))
        elif event.kind == EventKind.SENSOR and event.subject < len(self.process.outputs):
            bad = last.bad | {event.subject} if event.cause else last.bad - {event.subject}
            self._change(last._replace(tick=event.tick, bad=bad))

    def _change(self, state: Driving) -> None:
        while self._states[-1].tick >= state.tick and len(self._states) > 1:
            self._states.pop()
        self._states.append(state)

    def columns(self, ticks: NDArray[np.int64]) -> list[pa.Array]:
        """Return mode, cause, driver and bad sensors at these ticks, which are in a row."""
        starts = [state.tick for state in self._states[1:]]
        places = np.searchsorted(starts, ticks, side="right")
        texts = [_texts(state, self.process.output_names) for state in self._states]
        return [text_array([text[name] for text in texts], places) for name in _TEXTS]

    def measured(self, ticks: NDArray[np.int64], y: NDArray[np.float32]) -> list[pa.Array]:
        """Return what the sensors of outputs with a band showed; null where it was not a number.

        Args:
            ticks: N ticks in a row.
            y: Outputs without faults, shape (N, outputs).
        """
        shown = [self._shown(output, ticks, y[:, output].copy()) for output in self._faults]
        return [number_array(column, pa.float32(), np.isnan(column)) for column in shown]

    def _shown(self, output: int, ticks: NDArray[np.int64], values: NDArray[np.float32]) -> NDArray[np.float32]:
        first, end = int(ticks[0]), int(ticks[-1]) + 1
        faults = self._faults[output]
        for place, fault in enumerate(faults):
            until = faults[place + 1].tick if place + 1 < len(faults) else end
            begin = min(max(fault.tick - first, 0), len(values))
            stop = min(max(until - first, 0), len(values))
            if fault.kind == SensorFaultKind.FROZEN and first <= fault.tick < end:
                # what it showed then: the output itself, or what the fault before let it show
                before = faults[place - 1] if place else None
                self._held[output] = _shown_by(before, values[fault.tick - first], self._held[output])
            if fault.kind and begin < stop:
                values[begin:stop] = _shown_by(fault, 0.0, self._held[output])
        return values

    def forget(self, tick: int) -> None:
        """Forget what concerns ticks before `tick` only."""
        keep = bisect_right([state.tick for state in self._states[1:]], tick)
        del self._states[:keep]
        for faults in self._faults.values():
            del faults[: max(0, bisect_right([fault.tick for fault in faults], tick) - 1)]


_TEXTS: Final = ("mode", "cause", "driver", "bad_sensors")


def _texts(state: Driving, output_names: Sequence[str]) -> dict[str, str | None]:
    bad = " ".join(output_names[output] for output in sorted(state.bad))
    if state.mode is None:
        return dict(zip(_TEXTS, (None, None, None, bad), strict=True))
    words = (Mode.word_of(state.mode), Cause.word_of(state.cause), DRIVERS.get(state.mode), bad)
    return dict(zip(_TEXTS, words, strict=True))


def _shown_by(fault: SensorFaultRecord | None, true: float, held: float) -> float:
    if fault is None or fault.kind == SensorFaultKind.NONE:
        return float(true)
    if fault.kind == SensorFaultKind.NOT_A_NUMBER:
        return math.nan
    return held if fault.kind == SensorFaultKind.FROZEN else fault.value
