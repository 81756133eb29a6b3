"""The fail-safe ladder: who decides the outputs of a scan.

    MPC        a sequence, within the updating period it was sent for
    REST       the rest of a sequence: the next one is late
    HOLD       the sequence is exhausted: its last value, for a set time
    CLASSICAL  the PI loops, until a sequence is accepted again

An operator may take the ladder away (CLASSICAL, MANUAL). A bad sensor that MPC needs, and a plant that begins warm
(`cool_down.py`), lead to CLASSICAL at once.
"""

from typing import NamedTuple

from coldloop.registers.control_plc import Cause, Mode, OperatorMode


class LadderInputs(NamedTuple):
    """Inputs of the choice of mode."""

    operator: int
    """Its `OperatorMode`."""
    cooling: bool
    """The plant is being cooled down from a warm start."""
    sensors_unusable: bool
    row: bool
    """A sequence has a row for this tick."""
    late: bool
    """The next sequence is late, or the optimiser is lost: this is the rest of the last one."""


class Ladder:
    """Step of the ladder; `since` is the tick at which the mode began."""

    def __init__(self, hold_ticks: int, mode: Mode, cause: Cause, tick: int = 0) -> None:
        self._hold_ticks = hold_ticks
        self.mode, self.cause, self.since = mode, cause, tick

    def step(self, tick: int, inputs: LadderInputs) -> bool:
        """Choose the mode of this scan; return whether it, or its cause, has changed."""
        mode, cause = self._chosen(tick, inputs)
        if (mode, cause) == (self.mode, self.cause) or (mode is self.mode and mode is Mode.MPC):
            return False
        self.mode, self.cause, self.since = mode, cause, tick
        return True

    def set_back(self, tick: int) -> None:
        """Set the time back to a tick before the present one."""
        self.since = min(self.since, tick)

    def _chosen(self, tick: int, inputs: LadderInputs) -> tuple[Mode, Cause]:
        if inputs.operator == OperatorMode.MANUAL:
            return Mode.MANUAL, Cause.OPERATOR
        if inputs.operator == OperatorMode.CLASSICAL:
            return Mode.CLASSICAL, Cause.OPERATOR
        if inputs.cooling:
            return Mode.CLASSICAL, Cause.COOL_DOWN
        if inputs.sensors_unusable:
            return Mode.CLASSICAL, Cause.SENSOR_BAD
        if inputs.row:
            return (Mode.REST, Cause.SEQUENCE_LATE) if inputs.late else (Mode.MPC, Cause.SEQUENCE_BEGAN)
        return self._without_sequence(tick)

    def _without_sequence(self, tick: int) -> tuple[Mode, Cause]:
        if self.mode is Mode.CLASSICAL:
            return self.mode, Cause.HOLD_EXPIRED if self.cause is Cause.OPERATOR else self.cause
        if self.mode is Mode.HOLD:
            expired = tick - self.since >= self._hold_ticks
            return (Mode.CLASSICAL, Cause.HOLD_EXPIRED) if expired else (self.mode, self.cause)
        return Mode.HOLD, Cause.OPERATOR if self.mode is Mode.MANUAL else Cause.SEQUENCE_EXHAUSTED
