"""Sensors that fail on purpose."""

import math
from collections.abc import Iterator, Sequence

from coldloop.registers.plant import SensorFault, SensorFaultKind

HEALTHY = SensorFault(SensorFaultKind.NONE, 0.0)


class SensorFaults:
    """The faults of so many outputs, and what each faulty sensor shows."""

    def __init__(self, outputs: int) -> None:
        self._faults = [HEALTHY] * outputs
        self._shown: dict[int, float] = {}

    def take(self, faults: Sequence[SensorFault], y: Sequence[float]) -> Iterator[tuple[int, SensorFault]]:
        """Take the faults of all outputs; yield those that are new, with their output.

        Args:
            faults: One for each output.
            y: What the sensors show now; a frozen sensor keeps showing it.
        """
        for output, (before, fault) in enumerate(zip(self._faults, faults, strict=True)):
            if fault != before:
                self._faults[output] = fault
                self._set(output, fault, y[output])
                yield output, fault

    def _set(self, output: int, fault: SensorFault, present: float) -> None:
        shown = {
            SensorFaultKind.NOT_A_NUMBER: math.nan,
            SensorFaultKind.FROZEN: present,
            SensorFaultKind.VALUE: fault.value,
        }
        self._shown.pop(output, None)
        if fault.kind:
            self._shown[output] = shown[SensorFaultKind(fault.kind)]

    def on(self, y: tuple[float, ...]) -> tuple[float, ...]:
        """Return what the sensors show where the outputs are `y`."""
        if not self._shown:
            return y
        return tuple(self._shown.get(output, value) for output, value in enumerate(y))
