"""Measurements that cannot be right: found, replaced by the last good value, and reported.

A measurement is bad when it is no number, outside its sensor's range, or frozen: it does not change by a bit for a
while in which most of the others move. When nothing at all changes, load and states included, the image is an old one:
a plant that rests is known by its inputs, which rest too. A turbine without a pressure difference may stand still.
"""

from collections.abc import Collection, MutableSequence, Sequence
from typing import Annotated, NamedTuple, Self

from pydantic import Field, FiniteFloat, model_validator

from coldloop.process.declaration import Process
from coldloop.process.settings import ProcessSettings, declared, stretched, within
from coldloop_control_plc.numbers import Numbers

Range = tuple[FiniteFloat, FiniteFloat]
STANDSTILL_RATIO = 1.1
"""Of the pressures before and behind the turbine's nozzle, below which it may stand; it is some ten in operation."""
MOVES = 240
"""Ticks in which an output that is not controlled must have moved before it can be frozen."""
UNKNOWN, NOT_MOVED = -2, -1
"""In the place of the tick since which the inputs have moved."""
RECOVERY_TICKS = 8
"""A sensor is good again when its measurements have been good for so long."""


class Kinds(NamedTuple):
    """Where outputs of a kind begin: other outputs are one kind, and both are 0."""

    temperatures: int
    """The first temperature; they end where the pressures begin."""
    pressures: int
    """The first pressure; they are the last outputs."""


class SensorCheckSettings(ProcessSettings):
    """Ranges of sensors, and how long a bad one is bridged."""

    level: Range = (-5.0, 105.0)
    """%."""
    speed: Range = (-10.0, 20_000.0)
    """Hz."""
    temperature: Range = (1.0, 400.0)
    """K."""
    pressure: Range = (-1.0, 100.0)
    """bar."""
    frozen_s: Annotated[float, Field(gt=0)] = stretched(20.0)
    """A controlled output that does not change for so long, while others move, is frozen."""
    resting_s: Annotated[float, Field(gt=0)] = stretched(60.0)
    """Another one, that has moved for a minute before, is if it rests for so long and for twice as long as ever before:
    what is constant in a plant with exact sensors is not taken for frozen."""
    may_rest: bool = True
    """While its inputs do not move a plant may stand still bit for bit, as a simulated one with exact sensors does.
    False for sensors that are always noisy: an image unchanged for `frozen_s` is then stale in any case."""
    bridged_s: Annotated[float, Field(ge=0)] = stretched(10.0)
    """How long the classical loops work with the last good value of a controlled output; then that loop is left."""
    estimated_s: Annotated[float, Field(ge=0)] = stretched(1800.0)
    """How long MPC works without one, by its estimate from the others."""
    estimated_most: Annotated[int, within(lambda process: (0, len(process.outputs)))] = declared(
        lambda process: min(5, len(process.outputs))
    )
    """Bad sensors at most for that; with more, MPC is left after `bridged_s`, too."""

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Range of each output."""
        return tuple(
            getattr(self, output.quantity) if output.quantity else output.range for output in self.process.outputs
        )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(low >= high for low, high in self.ranges):
            raise ValueError("each range must begin below its end")
        return self


def are_inside(y: Numbers, low: Numbers, high: Numbers) -> bool:
    """Return whether all measurements are numbers within their ranges; the rig compiles this function, and the next."""
    inside = True
    for output in range(len(y)):
        inside = inside and low[output] <= y[output] <= high[output]
    return inside


def count_unchanged(
    unchanged: MutableSequence[int],
    rests: MutableSequence[int],
    before: MutableSequence[float],
    y: Numbers,
    elapsed: int,
    least: Numbers,
    controlled: Numbers,
    kinds: Kinds,
) -> None:
    """Count for how many ticks each output is unchanged while most of the others moved.

    For those that are not controlled these are most temperatures and most pressures: exact sensors of one kind rest
    with the plant while noisy ones of the other kind do not.

    `before` (outputs,) becomes `y`, the measurements `elapsed` ticks later. `rests` (outputs,) are the
    longest such times of those that are not controlled, without the times for which they were frozen; below 0: the
    moves that are missing until they count. `least` is as `SensorMonitor` has it; `controlled` says which are.
    """
    first, end = kinds.temperatures, kinds.pressures
    few = int(end == 0)  # most of the others are counted without the output itself, which matters where there are few
    most = 2 * moved(before, y, 0, len(y)) > len(y) - few
    temperatures, pressures = moved(before, y, first, end), moved(before, y, end, len(y))
    most_of_each = (end == 0 or 2 * temperatures > end - first) and 2 * pressures > len(y) - end - few
    for output in range(len(y)):
        if y[output] == before[output]:
            unchanged[output] += elapsed * (most if controlled[output] else most_of_each)
            continue
        if rests[output] < 0:
            rests[output] += bool(abs(y[output] - before[output]) > 0.0)  # from or to no number is no move
        elif not controlled[output] and not is_frozen(unchanged[output], rests[output], least[output]):
            rests[output] = max(unchanged[output], rests[output])
        unchanged[output] = 0
    before[:] = y


def is_frozen(unchanged: float, rest: float, least: float) -> bool:
    """Return whether an output is unchanged for at least so many ticks, and for twice its longest rest."""
    return rest >= 0 and unchanged >= least and unchanged >= 2 * rest


def moved(before: Numbers, y: Numbers, first: int, end: int) -> int:
    """Return how many of the outputs from the first to the one before the end are others than before."""
    count = 0
    for output in range(first, end):
        count += y[output] != before[output]
    return count


def have_moved(inputs: Numbers, before: Numbers, moves: Numbers) -> bool:
    """Return whether an input has moved so far that something is to be seen of it."""
    moved_far = False
    for i in range(len(moves)):
        moved_far = moved_far or abs(inputs[i] - before[i]) > moves[i]
    return moved_far


def note_moves(
    unchanged: Numbers,
    last: Sequence[MutableSequence[float]],
    since: MutableSequence[int],
    inputs: Numbers,
    moves: Numbers,
    tick: int,
) -> None:
    """Note what the inputs were when each output moved last, and at which tick they had moved from there.

    `last` has a row an output; `since`, of each, is at first `UNKNOWN`, then `NOT_MOVED` or a tick.
    """
    for output in range(len(unchanged)):
        if unchanged[output] == 0 or since[output] == UNKNOWN:
            since[output] = NOT_MOVED
            for i in range(len(moves)):
                last[output][i] = inputs[i]
        elif since[output] == NOT_MOVED and have_moved(inputs, last[output], moves):
            since[output] = tick


def is_to_move(since: int, tick: int, least: float) -> bool:
    """Return whether the inputs have moved, and for so long that the output should have moved too."""
    return since >= 0 and tick - since >= least


class ImageWatch:
    """Watches the whole image: for how many ticks it is unchanged, and whether the inputs have moved.

    Args:
        moves: How far each input must have moved for something to be seen of it.
        may_rest: Whether an image may be unchanged while the inputs are.
    """

    def __init__(self, moves: Sequence[float], *, may_rest: bool) -> None:
        self._moves = moves
        self._may_rest = may_rest
        self.begin()

    def begin(self) -> None:
        """Reset: nothing is known of earlier ticks."""
        self.last: tuple[Sequence[float], ...] = ()
        self.inputs: Sequence[float] = ()
        """Applied when the image changed last."""
        self.count = 0
        self.has_moved = False

    def unchanged(self, inputs: Sequence[float], *image: Sequence[float], elapsed: int) -> int:
        """Return for how many ticks the image (all measurements) is unchanged although the inputs have moved."""
        if image != self.last:  # NaN is not the same as NaN: a sensor that fails is for others to find
            self.last, self.inputs = image, inputs
            self.count, self.has_moved = 0, not self._may_rest
            return 0
        self.count += elapsed
        if not self.has_moved:
            self.has_moved = have_moved(inputs, self.inputs, self._moves)
        return self.count if self.has_moved else 0


def _kinds(process: Process) -> Kinds:
    quantities = [output.quantity for output in process.outputs]
    return Kinds(*(quantities.index(kind) if kind in quantities else 0 for kind in ("temperature", "pressure")))


def _turbine(process: Process) -> tuple[int, int, int] | None:
    """Return the outputs that are the turbine's speed, and the pressures before and behind it; None without one."""
    bath = process.bath
    if bath is None or not bath.turbine_speed:
        return None
    speed, before, behind = map(process.output_names.index, (bath.turbine_speed, *bath.turbine_pressures))
    return speed, before, behind


class SensorMonitor:
    """Looks at every measurement. All its times are plant time: scans can be missed.

    `bad` holds the outputs that are substituted now, and since which tick.

    Args:
        settings: Ranges of sensors.
        initial: The outputs at rest.
        moves: How far an input must have moved for something to be seen of it.
    """

    def __init__(self, settings: SensorCheckSettings, initial: Sequence[float], moves: Sequence[float] = ()) -> None:
        process = settings.process
        self.low, self.high = zip(*settings.ranges, strict=True)
        self.frozen_ticks = round(settings.frozen_s / process.tick_s)
        self._controlled = process.controlled
        self.is_controlled = [output in process.controlled for output in range(len(initial))]
        self.kinds, self._turbine = _kinds(process), _turbine(process)
        resting_ticks = round(settings.resting_s / process.tick_s)
        self.least = [self.frozen_ticks if controlled else resting_ticks for controlled in self.is_controlled]
        """Ticks for which each output is at least unchanged before it is frozen."""
        self._bridged_ticks = round(settings.bridged_s / process.tick_s)
        self._estimated_ticks = round(settings.estimated_s / process.tick_s)
        self._estimated_most = settings.estimated_most
        self._good = list(initial)
        self.before = list(initial)
        self._tick: int | None = None
        self._now = 0
        self.unchanged = [0] * len(initial)
        self.rests = [0 if controlled else -MOVES for controlled in self.is_controlled]
        self.moves = moves
        self.may_rest = settings.may_rest
        self.each_may_rest = settings.may_rest and not process.moves_as_one
        self.inputs = [[0.0] * len(moves) for _ in initial]
        """Inputs when each output moved last, ..."""
        self.inputs_moved = [UNKNOWN] * len(initial)
        """... and since which tick they have been others: `note_moves`."""
        self.image = ImageWatch(moves, may_rest=settings.may_rest)
        self._recovering: dict[int, int] = {}
        """Output, and since which tick its measurements have been good again."""
        self.bad: dict[int, int] = {}

    def check(
        self,
        tick: int,
        y: Sequence[float],
        inputs: Sequence[float] = (),
        *others: Sequence[float],
        standing: Collection[int] = (),
    ) -> Sequence[float]:
        """Return the outputs measured at `tick`, with bad ones replaced by their last good value.

        Args:
            tick: When.
            y: As they were measured.
            inputs: Being applied.
            others: What else was measured.
            standing: Outputs that may be constant while others move.
        """
        elapsed = 1 if self._tick is None else max(0, tick - self._tick)
        count_unchanged(self.unchanged, self.rests, self.before, y, elapsed, self.least, self.is_controlled, self.kinds)
        self._tick = self._now = tick
        history = zip(self.unchanged, self.rests, self.least, strict=True)
        frozen: Collection[int] = [output for output, each in enumerate(history) if is_frozen(*each)]
        frozen = [output for output in frozen if output not in standing and not self.may_stand(output, y)]
        if self.each_may_rest:
            note_moves(self.unchanged, self.inputs, self.inputs_moved, inputs, self.moves, tick)
            frozen = [output for output in frozen if is_to_move(self.inputs_moved[output], tick, self.least[output])]
        if self.image.unchanged(inputs, y, *others, elapsed=elapsed) >= self.frozen_ticks:
            frozen = range(len(y))
        if not self.bad and not frozen and are_inside(y, self.low, self.high):
            self._good[:] = y
            return y
        for output, value in enumerate(y):
            self._judge(output, ok=self.low[output] <= value <= self.high[output] and output not in frozen)
            if output not in self.bad:
                self._good[output] = value
        return tuple(self._good)

    def may_stand(self, output: int, y: Sequence[float]) -> bool:
        """Return whether an output is the speed of a turbine that stands, for all that the pressures say."""
        if self._turbine is None or output != self._turbine[0] or y[output] != 0.0:
            return False
        _, before, behind = self._turbine
        return y[before] < STANDSTILL_RATIO * y[behind]

    def set_back(self, tick: int) -> None:
        """Set the time back to `tick`: conditions that hold now begin there."""
        self._tick = None
        self.bad = {output: min(since, tick) for output, since in self.bad.items()}
        self._recovering = {output: min(since, tick) for output, since in self._recovering.items()}
        self.inputs_moved = [min(at, tick) for at in self.inputs_moved]

    def _judge(self, output: int, *, ok: bool) -> None:
        if not ok:
            self.bad.setdefault(output, self._now)
            self._recovering.pop(output, None)
        elif output in self.bad:
            since = self._recovering.setdefault(output, self._now)
            if self._now - since + 1 >= RECOVERY_TICKS:
                del self.bad[output], self._recovering[output]

    def seen(self, tick: int, y: Sequence[float], *others: Sequence[float]) -> None:
        """Note that all outputs y (outputs,) have been good up to `tick`, and what was measured there."""
        self._tick = self._now = tick
        self.image.last = (y, *others)
        self._good[:] = self.before[:] = y

    @property
    def unusable(self) -> list[int]:
        """Controlled outputs that have been bad for longer than they are bridged: their loops are left."""
        return self._bad_for(self._bridged_ticks)

    @property
    def unestimated(self) -> list[int]:
        """Controlled outputs that have been bad for longer than an estimate of them is believed: MPC is left."""
        return self._bad_for(self._bridged_ticks if len(self.bad) > self._estimated_most else self._estimated_ticks)

    def _bad_for(self, ticks: int) -> list[int]:
        return [
            output for output in self._controlled if output in self.bad and self._now - self.bad[output] + 1 > ticks
        ]

    @property
    def mask(self) -> int:
        """Bit i is set when output i is substituted."""
        return sum(1 << output for output in self.bad)
