"""What the rack applies, whose it is, and whether outputs that arrive may replace it. No registers, no clock."""

from typing import Final

from coldloop.lease import SIMPLE_CLIENT
from coldloop.registers.bank import Caller
from coldloop.registers.plant import Actuators, OutputVerdict

STALE_TICKS: Final = 8
"""In real time, outputs that are further than this from the present tick are not taken."""

Inputs = tuple[float, float, float]


class AppliedOutputs:
    """The outputs being applied, and the judgement of those that are sent.

    A *generation* is a stretch of time in which at most one writer has changed the outputs. It ends when something else
    changes them: a session begins, the safe state is applied, the rack restarts, another writer comes. Who sends the
    generation that it has read back therefore knows what is applied; all others are answered `CHANGED`.

    Args:
        u: CV155 %, NCR22_A W, CV156 %.
        holder: Number of the client whose outputs these are; `SIMPLE_CLIENT` is also that of the safe state, and of
            what a session begins with.
        generation: 1 or more.
    """

    def __init__(self, u: Inputs, *, holder: int = SIMPLE_CLIENT, generation: int = 1) -> None:
        self.u = u
        self.holder = holder
        self.generation = generation
        self.verdict = OutputVerdict.NONE
        """On the outputs that were sent last in this generation."""
        self._writer: Caller | None = None

    def replace(self, u: Inputs) -> None:
        """Apply other outputs than a client's; a generation begins."""
        self.u, self.holder = u, SIMPLE_CLIENT
        self._begin_generation()

    def offer(self, asked: Actuators, caller: Caller, *, session: int, tick: int, realtime: bool) -> OutputVerdict:
        """Judge outputs, and take them if they are for the present session (0 is none), tick and generation."""
        if not session or asked.session != session:
            self.verdict = OutputVerdict.WRONG_SESSION
        elif abs(asked.tick - tick) > (STALE_TICKS if realtime else 0):
            self.verdict = OutputVerdict.UNTIMELY
        else:
            self.verdict = self._judge_writer(asked, caller)
        return self.verdict

    def _judge_writer(self, asked: Actuators, caller: Caller) -> OutputVerdict:
        if self._writer is not None and not self._is_writer(asked.holder, caller):
            self._begin_generation()
        if asked.generation not in (0, self.generation):
            return OutputVerdict.CHANGED
        self.u, self.holder = (asked.cv155, asked.ncr22, asked.cv156), asked.holder
        self._writer = caller
        return OutputVerdict.TAKEN

    def _is_writer(self, holder: int, caller: Caller) -> bool:
        """Tell whether the writer of this generation writes: its number says so, or the connection of one without."""
        if holder != self.holder:
            return False
        return holder != SIMPLE_CLIENT or (self._writer is not None and self._writer.connection == caller.connection)

    def _begin_generation(self) -> None:
        self.generation = next_generation(self.generation)
        self.verdict = OutputVerdict.NONE
        self._writer = None


def next_generation(generation: int) -> int:
    """Return the number after a generation's: 1 to 2^32 - 1, never 0."""
    return generation % 0xFFFF_FFFF + 1
