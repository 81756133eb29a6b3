"""Sensor check: bad measurements are detected, replaced by the last good value, and reported.

A measurement is bad when it is NaN, outside its sensor's range, or frozen: it does not change by a bit for a
while in which most of the others move. When nothing at all changes, load and states included, the image is an old one:
a plant that rests is known by its inputs, which rest too. A turbine without a pressure difference may stand still.

The check is plain Python that the rig compiles too: functions of constants and one state.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple, Self

from pydantic import Field, FiniteFloat, model_validator

from coldloop.process.settings import ProcessSettings, declared, stretched, within
from coldloop.registers.plant import MAX_STATE
from coldloop_control_plc.output_limits import Numbers

Range = tuple[FiniteFloat, FiniteFloat]
STANDSTILL_RATIO = 1.1
"""Ratio of the pressures before and behind the turbine's nozzle, below which it may stand; some ten in operation."""
MOVES = 240
"""Ticks in which an output that is not controlled must have moved before it can be frozen."""
UNKNOWN, NOT_MOVED = -2, -1
"""Sentinels for the tick since which the inputs have moved: it is not known; they have not moved."""
NONE = -1
"""Sentinel for another tick: the event has not occurred."""
RECOVERY_TICKS = 8
"""Ticks in which all measurements of a sensor must be good until it counts as good again."""


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
    """Time without a change, while others move, after which a controlled output is frozen."""
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


class SensorConstants(NamedTuple):
    """Constants of the sensor check in one session; tuples have one element per output, `moves` one per input."""

    low: Numbers
    """Range of the sensor."""
    high: Numbers
    least: Numbers
    """Ticks for which an output is at least unchanged before it is frozen."""
    controlled: Numbers
    """Whether the output has a band."""
    temperatures: int
    """Index of the first temperature; they end where the pressures begin. Other outputs are one kind: both are 0."""
    pressures: int
    """Index of the first pressure; they are the last outputs."""
    moves: Numbers
    """How far an input must have moved for something to be seen of it."""
    may_rest: bool
    """Nothing may be measured to move while the inputs do not."""
    each_may_rest: bool
    """Nor need an output move while others do, then."""
    frozen_ticks: int
    """Ticks for which the image is at least unchanged before it is an old one."""
    speed: int
    """The output that is the turbine's speed, and the pressures before and behind it; -1 without a turbine."""
    before: int
    behind: int
    least_load: float
    largest_load: float
    bridged_ticks: int
    """A controlled output that has been bad for longer is missing to its loop, ..."""
    estimated_ticks: int
    """... and one that has been for longer to MPC, ..."""
    estimated_most: int
    """... as long as no more outputs are bad."""


@dataclass(slots=True)
class SensorState:
    """State of the sensor check; lists have one element per output, `inputs` one row each. Ticks are plant time."""

    tick: int
    """Tick of the last check; `NONE` after a leap back."""
    now: int
    good: list[float]
    """Last good values."""
    before: list[float]
    """Measured last."""
    unchanged: list[int]
    rests: list[int]
    """Longest times unchanged of those that are not controlled, without the times for which they were frozen; below 0:
    the moves that are missing until they count."""
    inputs: list[list[float]]
    """Inputs when each output moved last."""
    inputs_moved: list[int]
    """`UNKNOWN`, then `NOT_MOVED` or the tick since which the inputs have been others than those."""
    bad_since: list[int]
    """`NONE` or the tick since which the output has been substituted."""
    good_since: list[int]
    """Since which tick the measurements of a substituted output have been good again."""
    bad_count: int
    standing: list[bool]
    """Mask of the outputs that may be constant while others move."""
    x: list[float]
    """States and load that were measured last: with the outputs the image."""
    load: float
    image_inputs: list[float]
    """Applied when the image changed last."""
    image_count: int
    """Ticks for which it has been unchanged."""
    image_moved: bool
    """The inputs have moved meanwhile."""
    is_unknown: bool
    """The load or the state that was measured last makes no sense."""


def check(c: SensorConstants, s: SensorState, tick: int, y: Numbers, x: Numbers, load: float, inputs: Numbers) -> bool:
    """Take what was measured at `tick`, with these inputs applied; return whether an output is bad, or was until now.

    Outputs are then `good`: the measured ones, with bad ones replaced by their last good value.
    """
    elapsed = 1 if s.tick == NONE else max(0, tick - s.tick)
    has_moved = count_unchanged(c, s, y, elapsed)
    s.tick = tick
    s.now = tick
    if c.each_may_rest:
        note_moves(c, s, inputs, tick)
    is_old = is_old_image(c, s, has_moved, x, load, inputs, elapsed)
    suspicious = is_old or s.bad_count > 0
    low, high, least, unchanged, bad_since = c.low, c.high, c.least, s.unchanged, s.bad_since
    for output in range(len(y)):
        if not low[output] <= y[output] <= high[output] or unchanged[output] >= least[output]:
            suspicious = True
    if not suspicious:
        s.good[:] = y
        return False
    told = s.bad_count > 0
    for output in range(len(y)):
        value, moves = y[output], unchanged[output] < least[output] and not is_old
        if moves and bad_since[output] == NONE and low[output] <= value <= high[output]:
            s.good[output] = value
        else:
            judge(c, s, output, y, is_old or is_stuck(c, s, output, y, tick))
    return told or s.bad_count > 0


def judge(c: SensorConstants, s: SensorState, output: int, y: Numbers, stuck: bool) -> None:  # noqa: FBT001 compiled
    """Substitute an output from now on, or no more."""
    if stuck or not c.low[output] <= y[output] <= c.high[output]:
        if s.bad_since[output] == NONE:
            s.bad_since[output] = s.now
            s.bad_count += 1
        s.good_since[output] = NONE
        return
    if s.bad_since[output] != NONE:
        if s.good_since[output] == NONE:
            s.good_since[output] = s.now
        if s.now - s.good_since[output] + 1 < RECOVERY_TICKS:
            return
        s.bad_since[output] = s.good_since[output] = NONE
        s.bad_count -= 1
    s.good[output] = y[output]


def count_unchanged(c: SensorConstants, s: SensorState, y: Numbers, elapsed: int) -> bool:
    """Count for how many ticks each output is unchanged while most of the others moved; return whether any moved.

    `y` was measured `elapsed` ticks after the last one. For those that are not controlled the others are most
    temperatures and most pressures: exact sensors of one kind rest with the plant while noisy ones of the other do not.
    """
    first, end = c.temperatures, c.pressures
    few = int(end == 0)  # most of the others are counted without the output itself, which matters where there are few
    temperatures, pressures = moved(s.before, y, first, end), moved(s.before, y, end, len(y))
    count = temperatures + pressures + (moved(s.before, y, 0, first) if end > 0 else 0)
    most = 2 * count > len(y) - few
    most_of_each = (end == 0 or 2 * temperatures > end - first) and 2 * pressures > len(y) - end - few
    unchanged, rests, before = s.unchanged, s.rests, s.before
    for output in range(len(y)):
        if y[output] == before[output]:
            unchanged[output] += elapsed * (most if c.controlled[output] else most_of_each)
            continue
        if rests[output] < 0:
            rests[output] += bool(abs(y[output] - before[output]) > 0.0)  # from or to no number is no move
        elif unchanged[output] > rests[output] and not (
            c.controlled[output] or is_frozen(unchanged[output], rests[output], c.least[output])
        ):
            rests[output] = unchanged[output]
        unchanged[output] = 0
    s.before[:] = y
    return count > 0


def moved(before: Numbers, y: Numbers, first: int, end: int) -> int:
    """Return how many of the outputs from the first to the one before the end are others than before."""
    count = 0
    for output in range(first, end):
        count += y[output] != before[output]
    return count


def is_frozen(unchanged: float, rest: float, least: float) -> bool:
    """Return whether an output is unchanged for at least so many ticks, and for twice its longest rest."""
    return rest >= 0 and unchanged >= least and unchanged >= 2 * rest


def is_stuck(c: SensorConstants, s: SensorState, output: int, y: Numbers, tick: int) -> bool:
    """Return whether an output is frozen that does not stand, and that should have moved with the inputs."""
    if (
        not is_frozen(s.unchanged[output], s.rests[output], c.least[output])
        or s.standing[output]
        or may_stand(c, output, y)
    ):
        return False
    since = s.inputs_moved[output]
    return not c.each_may_rest or (since >= 0 and tick - since >= c.least[output])


def may_stand(c: SensorConstants, output: int, y: Numbers) -> bool:
    """Return whether an output is the speed of a turbine that stands, for all that the pressures say."""
    return output == c.speed and y[output] == 0.0 and y[c.before] < STANDSTILL_RATIO * y[c.behind]


def have_moved(inputs: Numbers, before: Numbers, moves: Numbers) -> bool:
    """Return whether an input has moved so far that something is to be seen of it."""
    moved_far = False
    for i in range(len(moves)):
        moved_far = moved_far or abs(inputs[i] - before[i]) > moves[i]
    return moved_far


def note_moves(c: SensorConstants, s: SensorState, inputs: Numbers, tick: int) -> None:
    """Note what the inputs were when each output moved last, and at which tick they had moved from there."""
    for output in range(len(s.unchanged)):
        if s.unchanged[output] == 0 or s.inputs_moved[output] == UNKNOWN:
            s.inputs_moved[output] = NOT_MOVED
            for i in range(len(c.moves)):
                s.inputs[output][i] = inputs[i]
        elif s.inputs_moved[output] == NOT_MOVED and have_moved(inputs, s.inputs[output], c.moves):
            s.inputs_moved[output] = tick


def is_old_image(
    c: SensorConstants, s: SensorState, has_moved: bool, x: Numbers, load: float, inputs: Numbers, elapsed: int  # noqa: FBT001
) -> bool:  # fmt: skip
    """Return whether the whole image (all measurements) has been unchanged for long although the inputs have moved.

    `has_moved`: an output has. What is no number is other than itself: a sensor that fails is for others to find.
    Whether load and states make sense is found out, too.
    """
    same = not has_moved and load == s.load
    if same:
        for i in range(len(x)):
            same = same and x[i] == s.x[i]
    s.x[:] = x
    s.load = load
    unknown = not c.least_load <= load <= c.largest_load
    for value in x:
        if not abs(value) <= MAX_STATE:
            unknown = True
    s.is_unknown = unknown
    if not same:
        for i in range(len(c.moves)):
            s.image_inputs[i] = inputs[i]
        s.image_count = 0
        s.image_moved = not c.may_rest
        return c.frozen_ticks <= 0
    s.image_count += elapsed
    s.image_moved = s.image_moved or have_moved(inputs, s.image_inputs, c.moves)
    return (s.image_count if s.image_moved else 0) >= c.frozen_ticks


def is_missing(s: SensorState, output: int, ticks: int) -> bool:
    """Return whether an output has been bad for longer than so many ticks."""
    return s.bad_since[output] != NONE and s.now - s.bad_since[output] + 1 > ticks


def lacks_output(c: SensorConstants, s: SensorState, ticks: int) -> bool:
    """Return whether a controlled output has been bad for longer than so many ticks."""
    lacks: float = False
    if s.bad_count > 0:
        for output in range(len(c.controlled)):
            lacks = lacks or (c.controlled[output] and is_missing(s, output, ticks))
    return bool(lacks)


class SensorMonitor(SensorState):
    """Looks at every measurement. Scans can be missed.

    `initial` are the outputs at rest; `moves` is how far each input must have moved for something to be seen of it.
    """

    def __init__(self, settings: SensorCheckSettings, initial: Sequence[float], moves: Sequence[float] = ()) -> None:
        process, count = settings.process, len(initial)
        frozen_ticks, resting_ticks = (round(s / process.tick_s) for s in (settings.frozen_s, settings.resting_s))
        controlled = [output in process.controlled for output in range(count)]
        quantities, bath = [output.quantity for output in process.outputs], process.bath
        temperatures, pressures = (
            quantities.index(kind) if kind in quantities else 0 for kind in ("temperature", "pressure")
        )
        turbine = (-1, -1, -1)
        if bath is not None and bath.turbine_speed:
            before, behind = map(process.output_names.index, bath.turbine_pressures)
            turbine = process.output_names.index(bath.turbine_speed), before, behind
        low, high = zip(*settings.ranges, strict=True)
        self.constants = SensorConstants(
            low, high, [frozen_ticks if each else resting_ticks for each in controlled], controlled, temperatures,
            pressures, moves, settings.may_rest, settings.may_rest and not process.moves_as_one, frozen_ticks,
            *turbine, *process.load.stored_span, round(settings.bridged_s / process.tick_s),
            round(settings.estimated_s / process.tick_s), settings.estimated_most,
        )  # fmt: skip
        super().__init__(
            tick=NONE, now=0, good=list(initial), before=list(initial), unchanged=[0] * count,
            rests=[0 if each else -MOVES for each in controlled], inputs=[[0.0] * len(moves) for _ in initial],
            inputs_moved=[UNKNOWN] * count, bad_since=[NONE] * count, good_since=[NONE] * count, bad_count=0,
            standing=[False] * count, x=[math.nan] * len(process.states), load=math.nan,
            image_inputs=[0.0] * len(moves), image_count=0, image_moved=not settings.may_rest,
            is_unknown=False,
        )  # fmt: skip

    def set_back(self, tick: int) -> None:
        """Set the time back to `tick`: conditions that hold now begin there."""
        self.tick = NONE
        for ticks in (self.bad_since, self.good_since, self.inputs_moved):
            ticks[:] = [min(each, tick) for each in ticks]

    @property
    def bad(self) -> list[int]:
        """Outputs that are substituted."""
        return [output for output, since in enumerate(self.bad_since) if since != NONE] if self.bad_count else []

    @property
    def mask(self) -> int:
        """Bit i is set when output i is substituted."""
        return sum(1 << output for output in self.bad) if self.bad_count else 0
