"""The output guard, the last thing between any decision and the actuators: bounds, rate window, slew limit.

Its arithmetic is plain Python, for the control PLC has no numba; the rig compiles these very functions. Outputs are in
the order of the inputs of the process.
"""

import math
from collections.abc import Iterator, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from coldloop.kernels.single_precision import neighbour, single
from coldloop.process.settings import InputLimits, RateReference
from coldloop.registers.control_plc import Verdict
from coldloop.safety.writers import Inputs


class Numbers(Protocol):
    """Numbers in a row: a tuple or a list here, an array where the arithmetic is compiled."""

    def __getitem__(self, place: int, /) -> float: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[float]: ...


class Rows(Protocol):
    """Rows of numbers."""

    def __getitem__(self, place: int, /) -> Numbers: ...


TOLERANCE: Final = 1e-5
"""Share of an input's range by which a sequence may miss a limit: single precision cannot tell it apart. The guard
itself allows nothing."""
ROUNDING_STEPS: Final = 4
"""Neighbours that are tried when rounding to single precision has crossed a limit; one or two will do."""
NEVER: Final = -(2**15)
"""Tick of a change that did not happen: longer ago than any window, and what it is subtracted from has 32 bits."""

PLAYS_ON: Final = False
"""No sequence begins."""


class Limits(NamedTuple):
    """`InputLimits` as plain numbers."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    rate: tuple[float, ...]
    """Largest change in a sampling period of 5 s."""
    slack: tuple[float, ...]
    """Tolerance for the violation of a bound or a rate by a sequence."""
    slew_ticks: int
    """Within fewer ticks than this an output moves by at most its rate."""
    ticks_per_sample: int
    """Ticks of a sampling period."""
    elapsed: bool
    """The rate of an update is scaled by the time since the outputs last moved."""


def plain(limits: InputLimits) -> Limits:
    """Return limits as plain numbers."""
    slack = tuple(TOLERANCE * (high - low) for low, high in zip(limits.low, limits.high, strict=True))
    elapsed = limits.rate_reference is RateReference.ELAPSED
    return Limits(
        limits.low, limits.high, limits.rate, slack, limits.slew_ticks, limits.process.ticks_per_sample, elapsed
    )


@dataclass(slots=True)
class GuardState:
    """State of the guard.

    The rate window: outputs may stray from `anchor` by `share` of the rate until it ends, one sampling period of 5 s
    after `start` or when the next sequence begins.
    """

    applied: MutableSequence[float]
    """Outputs applied, shape (inputs,)."""
    anchor: MutableSequence[float]
    """Outputs applied before the window began, shape (inputs,)."""
    coming: MutableSequence[float]
    """Room for what is about to be applied, shape (inputs,)."""
    moves: MutableSequence[int]
    """Tick of each of the last changes, in turn, shape (slew_ticks,)."""
    before: MutableSequence[MutableSequence[float]]
    """Outputs applied before each of them, shape (slew_ticks, inputs)."""
    moved: int
    """Tick of the last change."""
    start: int = 0
    share: float = 1.0
    """Depends on how long before the window the outputs last moved."""
    oldest: int = 0
    """Place of the oldest of the last changes, which the next one takes."""
    out_of_bounds: bool = False
    """The outputs applied when the guard began are outside the bounds."""
    newest: int = 0
    """Latest tick of the rack."""
    lag: int = 0
    """Ticks by which the guard's time is behind that of the rack."""


def beginning(limits: Limits, applied: Numbers) -> GuardState:
    """Return the state after `applied` has been constant for ever."""
    rows: list[MutableSequence[float]] = [list(applied) for _ in range(limits.slew_ticks)]
    state = GuardState(
        list(applied), list(applied), list(applied), [NEVER for _ in rows], rows, -limits.ticks_per_sample
    )
    begin(state, limits, applied)
    return state


def begin(state: GuardState, limits: Limits, applied: Numbers) -> None:
    """Make the state that after `applied` (inputs,) has been constant for ever."""
    for i in range(len(limits.low)):
        state.applied[i] = state.anchor[i] = applied[i]
    for slot in range(limits.slew_ticks):
        state.moves[slot] = NEVER
        for i in range(len(limits.low)):
            state.before[slot][i] = applied[i]
    state.start, state.share, state.moved, state.oldest = 0, 1.0, -limits.ticks_per_sample, 0
    state.out_of_bounds = not in_range(limits, applied)


def resume(state: GuardState, limits: Limits, tick: int, applied: Numbers) -> None:
    """Begin again at `tick` from the outputs applied there (inputs,), which count as having moved just then.

    An open window stays open: consecutive breaks would otherwise give a full rate each. A value that is not finite is
    ignored: the last one stays.
    """
    for i in range(len(limits.low)):
        state.coming[i] = applied[i] if math.isfinite(applied[i]) else state.applied[i]
    is_open = 0 <= tick - state.start < limits.ticks_per_sample and are_near(
        limits, state.anchor, state.coming, state.share
    )
    for slot in range(limits.slew_ticks):
        if are_near(limits, state.before[slot], state.coming, 1.0):
            state.moves[slot] = min(state.moves[slot], tick)
        else:  # what is further away limits nothing any more
            state.moves[slot] = NEVER
    for i in range(len(limits.low)):
        state.applied[i] = state.coming[i]
        if not is_open:
            state.anchor[i] = state.coming[i]
    if not is_open:
        state.start = state.moved = tick
        state.share = rate_share(limits, 0)
    state.out_of_bounds = not in_range(limits, state.applied)


def copy_state(source: GuardState, target: GuardState, limits: Limits) -> None:
    """Make `target` the same as `source`."""
    for i in range(len(limits.low)):
        target.applied[i], target.anchor[i] = source.applied[i], source.anchor[i]
    for slot in range(limits.slew_ticks):
        target.moves[slot] = source.moves[slot]
        for i in range(len(limits.low)):
            target.before[slot][i] = source.before[slot][i]
    target.start, target.share = source.start, source.share
    target.moved, target.oldest, target.out_of_bounds = source.moved, source.oldest, source.out_of_bounds


def rate_share(limits: Limits, elapsed_ticks: int) -> float:
    """Return the share of the rate that an update may use so many ticks after the one before."""
    return min(1.0, elapsed_ticks / limits.ticks_per_sample) if limits.elapsed else 1.0


def admit(state: GuardState, limits: Limits, tick: int, wanted: Numbers, update: bool) -> None:  # noqa: FBT001 compiled
    """Apply `wanted` (inputs,) at `tick` as far as the limits allow; `update`: a sequence begins there."""
    applied = state.applied
    if update or tick - state.start >= limits.ticks_per_sample:
        state.share = rate_share(limits, tick - state.moved)
        state.start = tick
        for i in range(len(limits.low)):
            state.anchor[i] = applied[i]
    if same(wanted, applied) and not state.out_of_bounds:  # it was admitted before, and a new window begins with it
        return
    change(state, limits, tick, wanted)
    if state.out_of_bounds:
        state.out_of_bounds = not in_range(limits, applied)


def admit_now(state: GuardState, limits: Limits, tick: int, wanted: Numbers, update: bool) -> None:  # noqa: FBT001
    """Apply `wanted` (inputs,) at a tick of the rack, which the guard's time may be behind."""
    state.newest = max(state.newest, tick)
    admit(state, limits, state.newest - state.lag, wanted, update)


def change(state: GuardState, limits: Limits, tick: int, wanted: Numbers) -> None:
    """Apply what is nearest to `wanted`, and remember what was applied before if that is another."""
    applied, slot = state.applied, state.oldest
    for i in range(len(limits.low)):  # of this slot too each is still limited by what it held
        state.coming[i] = nearest(state, limits, tick, wanted[i], i)
    if same(state.coming, applied):
        return
    state.moves[slot] = state.moved = tick
    for i in range(len(limits.low)):
        state.before[slot][i] = applied[i]
    state.oldest = slot + 1 if slot + 1 < limits.slew_ticks else 0
    for i in range(len(limits.low)):
        applied[i] = state.coming[i]


def same(one: Numbers, other: Numbers) -> bool:
    """Return whether two rows of outputs are the same."""
    for i in range(len(one)):  # noqa: SIM110 compiled
        if one[i] != other[i]:
            return False
    return True


def nearest(state: GuardState, limits: Limits, tick: int, wanted: float, i: int) -> float:
    """Return the single-precision value of output `i` nearest to `wanted` inside its bounds and within reach.

    A value that is not finite asks for the window's anchor. From an anchor outside the bounds it goes towards them, as
    far as it may.
    """
    anchor, applied = state.anchor[i], state.applied[i]
    if not math.isfinite(wanted):
        wanted = anchor
    reach, rate = limits.rate[i] * state.share, limits.rate[i]
    down, up = max(anchor - reach, applied - reach), min(anchor + reach, applied + reach)
    for slot in range(limits.slew_ticks):
        if tick - state.moves[slot] < limits.slew_ticks:
            down, up = max(down, state.before[slot][i] - rate), min(up, state.before[slot][i] + rate)
    low, high = limits.low[i], limits.high[i]
    lowest, highest = min(max(low, down), up), max(min(high, up), down)
    inside = low <= anchor <= high
    value = single(min(max(wanted, lowest), highest))
    for _ in range(ROUNDING_STEPS):
        if (low <= value <= high or not inside) and is_reached(state, limits, tick, value, i):
            return value
        value = neighbour(value, anchor)  # rounding has crossed a limit
    return applied


def is_reached(state: GuardState, limits: Limits, tick: int, value: float, i: int) -> bool:
    """Return whether a value of output `i` is within reach of all that it counts from."""
    reach, rate = limits.rate[i] * state.share, limits.rate[i]
    reached = abs(value - state.anchor[i]) <= reach and abs(value - state.applied[i]) <= reach
    for slot in range(limits.slew_ticks):
        if tick - state.moves[slot] < limits.slew_ticks:
            reached = reached and abs(value - state.before[slot][i]) <= rate
    return reached


def are_near(limits: Limits, one: Numbers, other: Numbers, share: float) -> bool:
    """Return whether two rows of outputs are apart by at most a share of the rates."""
    near = True
    for i in range(len(limits.low)):
        near = near and abs(other[i] - one[i]) <= limits.rate[i] * share
    return near


def in_range(limits: Limits, row: Numbers) -> bool:
    """Return whether the outputs are finite and inside the bounds, but for the slack."""
    inside = True
    for i in range(len(limits.low)):
        inside = inside and limits.low[i] - limits.slack[i] <= row[i] <= limits.high[i] + limits.slack[i]
    return inside


def judge(
    state: GuardState, twin: GuardState, limits: Limits, tick: int, meanwhile: Rows, waiting: int, coming: int,
    first_tick: int, rows: Rows, length: int,
) -> bool:  # fmt: skip
    """Return whether a sequence would be applied unchanged from `first_tick` on; `twin` is overwritten.

    Until then, `waiting` ticks after `tick`, the first `coming` rows of `meanwhile` are played; before and behind them
    what is applied is held.
    """
    copy_state(state, twin, limits)
    for k in range(first_tick - tick):
        if 0 <= k - waiting < coming:
            admit(twin, limits, tick + k, meanwhile[k - waiting], PLAYS_ON)
        else:
            admit(twin, limits, tick + k, twin.applied, PLAYS_ON)
    return admits(twin, limits, first_tick, rows, length)


def admits(state: GuardState, limits: Limits, first_tick: int, rows: Rows, length: int) -> bool:
    """Return whether a sequence of `length` rows, one per tick, would be applied unchanged; `state` advances."""
    for k in range(length):
        admit(state, limits, first_tick + k, rows[k], k == 0)
        for i in range(len(limits.low)):
            if abs(state.applied[i] - rows[k][i]) > limits.slack[i]:
                return False
    return True


class OutputGuard:
    """Keeps every output inside its bounds, its rate window and the slew limit, whatever is requested.

    Its time is that of the ticks, but never faster than the time that has really passed, and it does not go back: a
    leap of the tick ends no window, and ticks that come again after a leap of a sampling period back do not count.
    """

    def __init__(self, limits: InputLimits, applied: Inputs) -> None:
        self.limits = plain(limits)
        self.state = beginning(self.limits, list(map(_inside, applied, limits.low, limits.high)))
        self._twin = beginning(self.limits, applied)

    @property
    def applied(self) -> Inputs:
        """Outputs applied."""
        return tuple(self.state.applied)

    def begin_at(self, tick: int, applied: Inputs, passed: int | None = None) -> None:
        """Restart at `tick` from the outputs applied there (`output_limits.resume`).

        `passed`: ticks since the last scan by another clock, None without one.
        """
        state, leap = self.state, tick - self.state.newest
        if -self.limits.ticks_per_sample <= leap < 0:
            leap = 0
        state.lag += leap - max(0, leap if passed is None else min(leap, passed))
        state.newest += leap
        resume(state, self.limits, state.newest - state.lag, applied)

    def admit(self, tick: int, wanted: Inputs, *, update: bool) -> Inputs:
        """Return what may be applied at `tick`, and remember it as applied."""
        admit_now(self.state, self.limits, tick, wanted, update)
        return self.applied

    def judge(self, rows: Sequence[Inputs], first_tick: int, meanwhile: Sequence[Inputs | None]) -> Verdict:
        """Judge a sequence, one row a tick, as it would be played: the guard would pass all of it, or it is refused.

        `meanwhile` is played in the ticks before the first, where something will be: rows of one sequence in a row.
        """
        played = [row for row in meanwhile if row is not None]
        waiting = next((k for k, row in enumerate(meanwhile) if row is not None), 0)
        first_tick -= self.state.lag
        tick = first_tick - len(meanwhile)
        passes = judge(
            self.state, self._twin, self.limits, tick, played, waiting, len(played), first_tick, rows, len(rows)
        )
        return Verdict.ACCEPTED if passes else Verdict.RATE_EXCEEDED

    def out_of_range(self, rows: Sequence[Inputs]) -> bool:
        """Return whether a row holds a value that is not finite or outside the bounds."""
        return not all(in_range(self.limits, row) for row in set(rows))


def _inside(value: float, low: float, high: float) -> float:
    """Return the single-precision value nearest to `value` that lies in low..high."""
    value = single(min(max(value, low), high))
    while not low <= value <= high:
        value = neighbour(value, (low + high) / 2)
    return value
