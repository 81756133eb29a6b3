"""Registers of the optimiser PLC: what it shows, and what operators write."""

from collections.abc import Callable, Mapping
from typing import Final

from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers import optimizer_plc as registers
from coldloop.registers.bank import Caller, IllegalValueError, RegisterBank
from coldloop.registers.codec import WordOrder, blank
from coldloop.registers.common import EventKind, Identity, JournalQuery, ServiceState, SessionPace, pace_subject
from coldloop.registers.declaration import Block, RegisterMap
from coldloop.service.journal import Journal, JournalPublication
from coldloop.session import TimeBase
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.control_link import ControlLink

NO_UPDATE: Final = registers.Optimization(*(0,) * len(registers.Optimization._fields))


class OptimizerPublication:
    """Registers and journal of the optimiser PLC.

    Args:
        register_map: Of this service, for the process.
        order: Word order of the registers.
        budget: Decides which updating periods can be asked for in real time.
        limits: Bands, bounds and rates of the problem.
        model_digest: Of our model.
        holder: Number that this optimiser gives itself.
    """

    def __init__(
        self, register_map: RegisterMap, order: WordOrder, budget: PlcBudget, limits: registers.OperatingLimits,
        model_digest: int, holder: int,
    ) -> None:  # fmt: skip
        self.bank = RegisterBank(register_map, order)
        self.bank.put(limits)
        self.bank.put_sealed(blank(registers.Prediction, self.bank.map))
        self.bank.judged_by(self._judge, registers.OptimizerSession)
        self.bank.judged_by(self._judge_pace, SessionPace)
        self.pace = TimeBase(realtime=False, factor=1.0)
        """Time base of the session under way."""
        self._budget = budget
        self._model_digest = model_digest
        self._journal = Journal()
        self._shown = JournalPublication(self._journal, self.bank)
        self._asked_by = ""
        self._last: registers.Optimization | None = None
        self._session = self._tick = 0
        self._predict: Callable[[], registers.Prediction] | None = None
        """Computes the prediction that is to be shown; None when the registers have it."""
        self._journal.note(0, EventKind.BOOT)
        self._shown.show()
        self.link = ControlLink(holder, self._journal, self._shown.show)
        self.bank.keep_fresh(registers.ControlLinkStatus, self.link.registers)
        self.bank.keep_fresh(Identity, self._identity)
        self.bank.keep_fresh(registers.Prediction, self._prediction)

    # -- what operators write ------------------------------------------------------------------------------------------

    def _judge(self, asked: registers.OptimizerSession, _row: int, _caller: Caller) -> None:
        """Refuse an updating period that there is not, or whose answers would never be there in time."""
        ticks = asked.updating_period
        if 0 < ticks < SHORTEST_TICKS:
            raise IllegalValueError(
                f"session.updating_period = {ticks}: give {SHORTEST_TICKS} or more, or 0 (adaptive)"
            )
        if ticks and asked.realtime and not self._budget.is_enough(ticks):
            period_s = ticks * self._budget.times.tick_s
            raise IllegalValueError(
                f"session.updating_period = {ticks}: in real time no answer is there within {period_s:g} s, one "
                f"iteration takes {self._budget.answer_after_s(1):g} s with its preparation: give more, or 0 (adaptive)"
            )

    def _judge_pace(self, asked: SessionPace, _row: int, _caller: Caller) -> None:
        try:
            asked.of(self._session)
        except ValueError as error:
            raise IllegalValueError(f"pace: {error}") from None

    def on_write(self, block: Block, caller: Caller) -> None:
        """Answer a query of the journal; the settings of a session are taken when it begins."""
        if block.record is JournalQuery:
            self._shown.answer(self.bank.get(JournalQuery))
        elif block.record is registers.OptimizerSession:
            self._asked_by = caller.name
        elif block.record is SessionPace:
            before, pace = self.pace, self.bank.get(SessionPace).of(self._session)
            self.bank.put(SessionPace.shown(self._session, pace))
            if pace == before:
                return
            self.pace = pace
            self._journal.note(self.link.tick, EventKind.PACE, pace_subject(pace), value=pace.factor, who=caller.name)
            self._shown.show()

    def asked_for(self, session: int) -> registers.OptimizerSession | None:
        """Return the settings that an operator has written for a session."""
        asked = self.bank.get(registers.OptimizerSession)
        return asked if asked.session == session else None

    # -- what is shown -------------------------------------------------------------------------------------------------

    def session_started(self, session: int, pace: TimeBase, rule: registers.UpdatingRuleStatus) -> None:
        """Show that a session has begun."""
        who = self._asked_by if self.asked_for(session) is not None else ""
        self._session, self._tick, self._last = session, 0, None
        for row in range(
            registers.HISTORY_ROWS
        ):  # what another session did is not to be taken for an update of this one
            self.bank.put(NO_UPDATE, row)
        self._journal.note(self.link.tick, EventKind.SESSION, int(pace.realtime), value=pace.factor, who=who)
        self.pace = pace
        self.bank.put(SessionPace.shown(session, pace))
        self.bank.put(rule)
        self._predict = None
        self.bank.put_sealed(blank(registers.Prediction, self.bank.map))
        self._shown.show()

    def optimised(self, tick: int, done: registers.Optimization) -> None:
        """Show what was done with the update latched at `tick`."""
        self._tick, self._last = tick, done
        self.bank.put(done, done.update % registers.HISTORY_ROWS)

    def predicted(self, predict: Callable[[], registers.Prediction]) -> None:
        """Show what a delivered sequence is expected to lead to: it is computed when it is read."""
        self._predict = predict

    def _prediction(self) -> registers.Prediction | None:
        predict, self._predict = self._predict, None
        return None if predict is None else predict()

    def _identity(self) -> Identity:
        return Identity(
            map_digest=self.bank.map.digest, map_version=self.bank.map.version,
            state=ServiceState.RUNNING if self._session else ServiceState.READY, model_digest=self._model_digest,
            session=self._session, tick=self._tick, heartbeat=(self._last.update + 1 if self._last else 0) & 0xFFFF,
        )  # fmt: skip

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        shown = {"session": self._session, "link": self.link.state.name.lower()}
        return {**shown, **(self._last._asdict() if self._last else {})}
