"""Calls of the control PLC's output guard with its answers: what is and what is not allowed, with a fixed seed."""

import math
import random
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.single_precision import single
from coldloop.process.limits import InputLimits
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_control_plc.output_limits import (
    Limits,
    admit,
    begin,
    beginning,
    copy_state,
    in_range,
    judge,
    plain,
    resume,
)
from coldloop_rig.plc_export.kernels.ode_program import Array

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


CALLS: Final = 800
MOST_NUMBERS: Final = 8_000
"""Of the rows of all golden calls, and of what is given and applied: each table is in one list of constants."""
FARTHEST: Final = 30
"""Ticks until a sequence that is judged begins."""
LATEST: Final = 2_000_000_000
SEED: Final = 0
NOT_FINITE: Final = (math.nan, math.inf, -math.inf)


def golden_calls(limits: InputLimits) -> list[GoldenCall]:
    """Return calls that want what is and what is not allowed, with the answers of the control PLC's own guard."""
    drawing, calls, rows = _Drawing(plain(limits), random.Random(SEED)), list[GoldenCall](), 0  # noqa: S311 no secret
    inputs = len(limits.low)
    for call in drawing.calls():
        rows += len(call.meanwhile) + len(call.rows)
        if len(calls) == CALLS or inputs * max(rows, 2 * len(calls)) > MOST_NUMBERS:
            break
        calls.append(call)
    return calls


class _Drawing:
    """Calls one after the other of one guard."""

    def __init__(self, limits: Limits, source: random.Random) -> None:
        self.limits, self.random, self._n = limits, source, len(limits.low)
        self._longest = min(SEQUENCE_ROWS, MOST_NUMBERS // (10 * self._n))
        """Rows of a sequence that is judged."""
        self.state = beginning(limits, self._row(0.2, 0.8))
        self.twin = beginning(limits, self.state.applied)
        self.tick = source.randrange(LATEST)

    def _row(self, low: float, high: float) -> Row:
        """Return outputs between shares of their ranges, as they cross the link."""
        drawn = (self.random.uniform(low, high) for _ in range(self._n))
        bounds = zip(drawn, self.limits.low, self.limits.high, strict=True)
        return tuple(single(bottom + share * (top - bottom)) for share, bottom, top in bounds)

    def _chance(self, probability: float) -> bool:
        return self.random.random() < probability

    def _changed(self, row: Row, values: Sequence[float]) -> Row:
        """Return a row with one of these values in the place of one output."""
        place = self.random.randrange(self._n)
        return (*row[:place], self.random.choice(values), *row[place + 1 :])

    def _applied(self) -> Row:
        return tuple(self.state.applied)

    def calls(self) -> Iterator[GoldenCall]:
        """Yield calls without end."""
        yield from self._restarted()
        while True:
            kinds = (self._scans, self._updates, self._resumed, self._judged, self._restarted)
            yield from self.random.choices(kinds, (8, 6, 6, 14, 1))[0]()

    def _restarted(self) -> Iterator[GoldenCall]:
        found = self._row(-0.01, 1.01)
        begin(self.state, self.limits, found)
        self.tick = self.random.choice((0, self.random.randrange(LATEST)))
        yield GoldenCall(Call.RESTART, 0, found, self._applied())

    def _scanned(self, wanted: Row, *, update: bool = False) -> GoldenCall:
        admit(self.state, self.limits, self.tick, wanted, update)
        self.tick += 1
        return GoldenCall(Call.SCAN, self.tick - 1, wanted, self._applied(), update)

    def _wanted(self) -> Row:
        """Return what may be wanted: often too much, now and then what is no number."""
        wanted = self._row(-0.3, 1.3)
        return self._changed(wanted, NOT_FINITE) if self._chance(0.3) else wanted

    def _scans(self) -> Iterator[GoldenCall]:
        wanted = self._wanted()
        for _ in range(self.random.randrange(1, 6)):
            yield self._scanned(wanted)

    def _updates(self) -> Iterator[GoldenCall]:
        for _ in range(self.random.randrange(1, 4)):
            yield self._scanned(self._wanted(), update=True)
        self.tick += self.random.randrange(30)

    def _resumed(self) -> Iterator[GoldenCall]:
        """Yield a break behind a move; the outputs are elsewhere then, now and then outside their bounds."""
        yield self._scanned(self._wanted(), update=True)
        self.tick += self.random.randrange(3)
        found = self._row(-0.2, 1.2) if self._chance(0.4) else self._row(0.0, 1.0)
        if self._chance(0.4):
            found = self._changed(self._applied(), (*NOT_FINITE, *found))
        resume(self.state, self.limits, self.tick, found)
        yield GoldenCall(Call.RESUME, self.tick, found, self._applied())
        for _ in range(self.random.randrange(1, 4)):
            yield self._scanned(self._applied() if self._chance(0.5) else self._wanted())

    def _judged(self) -> Iterator[GoldenCall]:
        """Yield the judgement of a sequence that may be played, or that is changed in one place."""
        copy_state(self.state, self.twin, self.limits)
        long = self._chance(0.08)
        farthest = min(FARTHEST, self._longest)
        ahead, length = (farthest, self._longest) if long else (min(4, farthest), min(8, self._longest))
        coming = self.random.randrange(ahead + 1)
        first_tick = self.tick + self.random.randrange(coming, ahead + 1)
        meanwhile = tuple(self._played(self.tick + k, moves=0.5, as_wanted=self._chance(0.5)) for k in range(coming))
        for k in range(self.tick + coming, first_tick):
            admit(self.twin, self.limits, k, self.twin.applied, update=False)
        length = self.random.randrange(1, length + 1)
        rows = [self._played(first_tick + k, moves=4.0 / length, update=k == 0) for k in range(length)]
        if self._chance(0.6):
            changed = self.random.choice((length - 1, self.random.randrange(length)))
            others = (self._row(0.0, 1.0)[0], *self._at_a_bound(), *NOT_FINITE)
            rows[changed] = self._moved(rows[changed]) if self._chance(0.6) else self._changed(rows[changed], others)
        yield GoldenCall(
            Call.JUDGE, self.tick, self._applied(), self._applied(), meanwhile=meanwhile, first_tick=first_tick,
            rows=tuple(rows), judgement=self._judgement(meanwhile, first_tick, rows),
        )  # fmt: skip

    def _moved(self, row: Row) -> Row:
        """Return a row with one output moved by about its rate."""
        place = self.random.randrange(self._n)
        by = self.limits.rate[place] * self.random.uniform(-1.2, 1.2)
        low, high = self.limits.low[place], self.limits.high[place]
        return (*row[:place], single(min(max(row[place] + by, low), high)), *row[place + 1 :])

    def _at_a_bound(self) -> Row:
        """Return outputs a little beyond their bounds: by less than the slack, or by more."""
        beyond = self.random.uniform(0.0, 2.0)
        sides = zip(self.limits.low, self.limits.high, self.limits.slack, strict=True)
        return tuple(
            single(self.random.choice((low - beyond * slack, high + beyond * slack))) for low, high, slack in sides
        )

    def _judgement(self, meanwhile: Sequence[Row], first_tick: int, rows: Sequence[Row]) -> Judgement:
        """Return what the guard says of a sequence, as the control PLC does."""
        limits, state, twin, tick = self.limits, self.state, self.twin, self.tick
        if not all(in_range(limits, row) for row in rows):
            return Judgement.OUT_OF_RANGE
        passes = judge(state, twin, limits, tick, meanwhile, 0, len(meanwhile), first_tick, rows, len(rows))
        return Judgement.ACCEPTED if passes else Judgement.RATE_EXCEEDED

    def _played(self, tick: int, *, moves: float, update: bool = False, as_wanted: bool = False) -> Row:
        """Return what the twin applies, where now and then something new is wanted; or that."""
        wanted = self._row(-0.1, 1.1) if self._chance(moves) else tuple(self.twin.applied)
        admit(self.twin, self.limits, tick, wanted, update)
        return wanted if as_wanted else tuple(self.twin.applied)


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
