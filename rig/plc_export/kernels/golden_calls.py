"""Calls of the control PLC's output guard with its answers: what is and what is not allowed, with a fixed seed."""

import random
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.single_precision import single
from coldloop.process.limits import InputLimits
from coldloop.process.signals import INPUT_NAMES
from coldloop.process.updating_periods import LONGEST_TICKS
from coldloop.registers.control_plc import SEQUENCE_ROWS
from control_plc.output_limits import Limits, admit, beginning, copy_state, in_range, judge, plain, resume
from rig.plc_export.kernels.ode_program import Array

N: Final = len(INPUT_NAMES)
Row = tuple[float, ...]


class Call(IntEnum):
    """What the guard is called for."""

    RESTART = 0
    SCAN = 1
    RESUME = 2
    JUDGE = 3


class Judgement(IntEnum):
    """What it says of a sequence."""

    ACCEPTED = 0
    OUT_OF_RANGE = 1
    RATE_EXCEEDED = 2


class GoldenCall(NamedTuple):
    """A call and its answer."""

    call: Call
    tick: int
    given: Row
    """What is wanted, or has been applied, shape (inputs,)."""
    applied: Row
    """What is applied after it."""
    update: bool = False
    """Of a scan: a sequence begins."""
    judgement: Judgement = Judgement.ACCEPTED
    meanwhile: tuple[Row, ...] = ()
    first_tick: int = 0
    rows: tuple[Row, ...] = ()


INTEGERS: Final = 7
CALLS: Final = 250
MOST_NUMBERS: Final = 7_000
"""Of all golden calls: each table of them is in one list of constants."""
MOST_ROWS: Final = min(8, SEQUENCE_ROWS)
"""Of a sequence that is judged."""
MOST_MEANWHILE: Final = min(4, LONGEST_TICKS)
"""Ticks until it begins."""
SEED: Final = 0


def golden_calls(limits: InputLimits) -> list[GoldenCall]:
    """Return calls that want what is and what is not allowed, with the answers of the control PLC's own guard."""
    drawing = _Drawing(plain(limits), random.Random(SEED))  # noqa: S311 no secret
    calls, numbers = list[GoldenCall](), 0
    for call in drawing.calls():
        numbers += INTEGERS + 1 + N * (2 + len(call.meanwhile) + len(call.rows))
        if len(calls) == CALLS or numbers > MOST_NUMBERS:
            break
        calls.append(call)
    return calls


class _Drawing:
    """Calls one after the other of one guard."""

    def __init__(self, limits: Limits, source: random.Random) -> None:
        self.limits, self.random = limits, source
        self.state = beginning(limits, self._row(0.2, 0.8))
        self.twin = beginning(limits, self.state.applied)
        self.tick = source.randrange(1000)

    def _row(self, low: float, high: float) -> Row:
        """Return outputs between shares of their ranges, as they cross the link."""
        drawn = (self.random.uniform(low, high) for _ in range(N))
        bounds = zip(drawn, self.limits.low, self.limits.high, strict=True)
        return tuple(single(bottom + share * (top - bottom)) for share, bottom, top in bounds)

    def _applied(self) -> Row:
        return tuple(self.state.applied)

    def calls(self) -> Iterator[GoldenCall]:
        yield GoldenCall(Call.RESTART, 0, self._applied(), self._applied())
        while True:
            kinds = (self._scans, self._updates, self._resumed, self._judged)
            yield from self.random.choices(kinds, (4, 3, 1, 4))[0]()

    def _scanned(self, wanted: Row, *, update: bool) -> GoldenCall:
        admit(self.state, self.limits, self.tick, wanted, update)
        self.tick += 1
        return GoldenCall(Call.SCAN, self.tick - 1, wanted, self._applied(), update)

    def _scans(self) -> Iterator[GoldenCall]:
        """Yield scans that want something, often too much, now and then what is no number."""
        wanted = self._row(-0.3, 1.3)
        if self.random.random() < 0.2:
            wanted = (float("inf"), *wanted[1:])
        for _ in range(self.random.randrange(1, 6)):
            yield self._scanned(wanted, update=False)

    def _updates(self) -> Iterator[GoldenCall]:
        for _ in range(self.random.randrange(1, 4)):
            yield self._scanned(self._row(0.0, 1.0), update=True)
        self.tick += self.random.randrange(30)

    def _resumed(self) -> Iterator[GoldenCall]:
        """Yield a break, after which the outputs are elsewhere, now and then outside their bounds."""
        self.tick += self.random.randrange(5)
        found = self._row(0.0, 1.0) if self.random.random() < 0.8 else self._row(-0.05, 1.05)
        resume(self.state, self.limits, self.tick, found)
        yield GoldenCall(Call.RESUME, self.tick, found, self._applied())

    def _judged(self) -> Iterator[GoldenCall]:
        """Yield the judgement of a sequence that may be played, or that is changed somewhere."""
        copy_state(self.state, self.twin, self.limits)
        coming = self.random.randrange(MOST_MEANWHILE + 1)
        first_tick = self.tick + self.random.randrange(coming, MOST_MEANWHILE + 1)
        meanwhile = tuple(self._played(self.tick + k, update=False) for k in range(coming))
        for k in range(self.tick + coming, first_tick):
            admit(self.twin, self.limits, k, self.twin.applied, update=False)
        length = self.random.randrange(1, MOST_ROWS + 1)
        rows = [self._played(first_tick + k, update=k == 0) for k in range(length)]
        change = self.random.random()
        if change < 0.5:
            changed = self.random.randrange(length)
            rows[changed] = self._row(0.0, 1.0) if change < 0.35 else self._row(0.9, 1.1)
        yield GoldenCall(
            Call.JUDGE, self.tick, self._applied(), self._applied(), meanwhile=meanwhile, first_tick=first_tick,
            rows=tuple(rows), judgement=self._judgement(meanwhile, first_tick, rows),
        )  # fmt: skip

    def _judgement(self, meanwhile: Sequence[Row], first_tick: int, rows: Sequence[Row]) -> Judgement:
        """Return what the guard says of a sequence, as the control PLC does."""
        limits, state, twin, tick = self.limits, self.state, self.twin, self.tick
        if not all(in_range(limits, row) for row in rows):
            return Judgement.OUT_OF_RANGE
        passes = judge(state, twin, limits, tick, meanwhile, len(meanwhile), first_tick, rows, len(rows))
        return Judgement.ACCEPTED if passes else Judgement.RATE_EXCEEDED

    def _played(self, tick: int, *, update: bool) -> Row:
        """Return what the twin applies of something that is wanted."""
        wanted = self._row(-0.1, 1.1) if self.random.random() < 0.5 else tuple(self.twin.applied)
        admit(self.twin, self.limits, tick, wanted, update)
        return tuple(self.twin.applied)


def tables_of(golden: Sequence[GoldenCall]) -> dict[str, Array]:
    """Return golden calls as tables, a row each: integers, reals (what is given and applied), and all their rows.

    Integers: call, tick, update or judgement, rows played meanwhile, first tick, rows of the sequence, and where these
    begin in the table of rows, those that are played meanwhile behind them.
    """
    integers, rows = list[tuple[int, ...]](), list[Row]()
    for each in golden:
        told = int(each.judgement if each.call is Call.JUDGE else each.update)
        lengths = (len(each.meanwhile), each.first_tick, len(each.rows))
        integers.append((each.call, each.tick, told, *lengths, len(rows)))
        rows += [*each.rows, *each.meanwhile]
    return {
        "integers": np.array(integers, np.int32),
        "reals": np.array([(*each.given, *each.applied) for each in golden], np.float32),
        "rows": np.array(rows, np.float32),
    }
