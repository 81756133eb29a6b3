"""Outputs of the rack: which it applies, whose they are, and whether those that arrive may replace them."""

from typing import Final

from coldloop.kernels.single_precision import single
from coldloop.registers.bank import Caller
from coldloop.registers.plant import Actuators, OutputVerdict
from coldloop.safety.lease import SIMPLE_CLIENT

STALE_TICKS: Final = 8
"""In real time, outputs that are further than this from the present tick are not taken."""

ROUNDING: Final = 1e-6
"""Share of a value that single precision may add to a change."""

Inputs = tuple[float, ...]


class AppliedOutputs:
    """The outputs being applied, and the judgement of those that are sent.

    A *generation* is a stretch of time in which at most one writer has changed the outputs. It ends when something else
    changes them: a session begins, the safe state is applied, the rack restarts, another writer comes, or the rack lets
    its writer move them only a part of the way. Who sends the generation that it has read back therefore knows what is
    applied; all others are answered `CHANGED`.

    For all writers together: in one tick of the rack no output moves further than its rate.

    Args:
        u: Outputs, in the order of the inputs of the process.
        rate: Largest change of each in one tick; None does not limit.
        holder: Number of the client whose outputs these are; `SIMPLE_CLIENT` is also that of the safe state, and of
            what a session begins with.
        generation: 1 or more.
    """

    def __init__(
        self, u: Inputs, *, rate: Inputs | None = None, holder: int = SIMPLE_CLIENT, generation: int = 1
    ) -> None:
        self.u = u
        self._rate = rate
        self._at_beginning = u
        """Outputs that were applied when the present tick began."""
        self.holder = holder
        self.generation = generation
        self.verdict = OutputVerdict.NONE
        """On the outputs that were sent last in this generation."""
        self._writer: Caller | None = None

    def begin_tick(self) -> None:
        """Note that a tick of the rack begins."""
        self._at_beginning = self.u

    def replace(self, u: Inputs) -> None:
        """Apply other outputs than a client's, in one step; a generation begins."""
        self.u, self.holder = u, SIMPLE_CLIENT
        self._at_beginning = u
        self._begin_generation()

    def offer(
        self, asked: Actuators, caller: Caller, *, session: int, tick: int, realtime: bool, ended: bool = False
    ) -> OutputVerdict:
        """Judge outputs, and take them if they are for the present session (0 is none), tick and generation.

        The tick in which a session has `ended` takes none.
        """
        if not session or asked.session != session:
            self.verdict = OutputVerdict.WRONG_SESSION
        elif ended or abs(asked.tick - tick) > (STALE_TICKS if realtime else 0):
            self.verdict = OutputVerdict.STALE
        else:
            self.verdict = self._judge_writer(asked, caller)
        return self.verdict

    def _judge_writer(self, asked: Actuators, caller: Caller) -> OutputVerdict:
        if self._writer is not None and not self._is_writer(asked.holder, caller):
            self._begin_generation()
        if asked.generation not in (0, self.generation):
            return OutputVerdict.CHANGED
        wanted = asked.u
        self.u, self.holder = self._within_reach(wanted), asked.holder
        taken = self.u == wanted
        if not taken:
            self._begin_generation()
        self._writer = caller
        return OutputVerdict.ACCEPTED if taken else OutputVerdict.LIMITED

    def _within_reach(self, wanted: Inputs) -> Inputs:
        """Return outputs as far as they may move in the present tick."""
        if self._rate is None:
            return wanted
        return tuple(map(_limited, wanted, self._at_beginning, self._rate))

    def _is_writer(self, holder: int, caller: Caller) -> bool:
        """Return whether the writer of this generation writes: its number says so, or the connection of one without."""
        if holder != self.holder:
            return False
        return holder != SIMPLE_CLIENT or (self._writer is not None and self._writer.connection == caller.connection)

    def _begin_generation(self) -> None:
        self.generation = next_generation(self.generation)
        self.verdict = OutputVerdict.NONE
        self._writer = None


def _limited(wanted: float, before: float, rate: float) -> float:
    if abs(wanted - before) <= rate + ROUNDING * abs(before):
        return wanted
    return single(min(max(wanted, before - rate), before + rate))


def next_generation(generation: int) -> int:
    """Return the number after a generation's: 1 to 2^32 - 1, never 0."""
    return generation % 0xFFFF_FFFF + 1
