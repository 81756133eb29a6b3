"""The optimiser PLC's program: the implementation scheme of the paper's section II, steps (1) to (5).

For each update the control PLC latches, `plan` decides the updating period and `solve` computes the sequence that is
played from its end on. Pure: no sockets, no clock, no sleeping.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coldloop.limits import InputLimits
from coldloop.lti_model import LtiModel
from coldloop.process import TICK_S, TICKS_PER_SAMPLE
from coldloop.registers.codec import as_transmitted
from coldloop.registers.control_plc import SEQUENCE_ROWS, Plan, SequenceHeader, SequenceRow, Update, Verdict
from coldloop.registers.optimizer_plc import (
    INPUT_SAMPLES,
    PREDICTED_SAMPLES,
    OperatingLimits,
    Optimization,
    Prediction,
    UpdatingRuleStatus,
)
from coldloop.sequence import InputSequence, with_checksum
from optimizer_plc.arithmetic import real_of
from optimizer_plc.budget import MAX_PERIOD_TICKS, PlcBudget
from optimizer_plc.costs import augmented_cost, indicators
from optimizer_plc.estimator import make_estimator
from optimizer_plc.prediction import PredictionModel
from optimizer_plc.problem import PredictiveProblem, QuadraticProblem, Situation
from optimizer_plc.rules import make_rule
from optimizer_plc.session_state import UNDECIDED, Delivery, Period, SessionState
from optimizer_plc.settings import ProgramSettings
from optimizer_plc.solvers import make_solver
from optimizer_plc.updating_period import Assessment, Observation, UpdatingRule

Array = NDArray[np.float64]

LONGEST_GAP_TICKS = 4 * SEQUENCE_ROWS
"""After a longer time without an update nothing is predicted from the last one."""


class OptimizerProgram:
    """Estimator, problem, solver and updating rule, put together."""

    def __init__(self, model: LtiModel, settings: ProgramSettings, limits: InputLimits) -> None:
        self.settings = settings
        self.model_digest = model.short_digest
        self._real = real_of(settings.arithmetic)
        self.model = PredictionModel(model)
        self.problem = PredictiveProblem(self.model, settings.design, limits, self._real, settings.penalties)
        self.solver = make_solver(settings)
        self.budget = PlcBudget(settings.budget, self.solver.tau_1_s)
        self.estimator = make_estimator(self.model, settings.estimator, self._real)
        self.model = self.model.rounded(self._real)
        self._compile_kernels(model)
        self.restart(settings.updating_period_s)

    def _compile_kernels(self, model: LtiModel) -> None:
        """Go once through an update at the operating point, so that no session waits for the compiler."""
        self.restart(0.0)
        u, y, x = (tuple(values.tolist()) for values in (model.u0, model.y0, model.x0))
        self.plan(Update(0, 0, 0, 0, load=model.w0, u_before=u, u=u, y=y, x=x))
        self.solve()
        self.report(Verdict.NONE)

    def restart(self, updating_period_s: float, rule: UpdatingRule | None = None) -> None:
        """Forget everything and begin a session at the operating point.

        Args:
            updating_period_s: Fixed updating period; 0 is adaptive.
            rule: Decides adaptive periods instead of the rule that the settings name.
        """
        self.fixed_ticks = round(updating_period_s / TICK_S)
        self.rule = rule or make_rule(self.settings, self.budget, self.fixed_ticks)
        self.estimator.reset()
        self.solver.reset()
        at_rest = np.zeros(3, self._real)
        nothing = Situation(np.zeros(self.model.n_states, self._real), self._real(0.0), at_rest)
        self.state = SessionState(Delivery(self.problem.hold(at_rest), nothing, 0, None))

    # -- steps (4), (5) and (2): at an updating instant ---------------------------------------------------------------

    def plan(self, update: Update) -> Plan:
        """Take the update latched at t_i and decide the updating period that begins there."""
        elapsed = update.tick - self.state.last.update.tick if self.state.last else 0
        if not 0 <= elapsed <= LONGEST_GAP_TICKS or not self._knows_what_is_played(update):
            self._begin_again(update)
        self._predict_to(update)
        interrupted = self._is_interrupted(update)
        estimate = self.estimator.correct(update)
        self._follow(update)
        self.state.sequences = max(self.state.sequences, update.playing)
        played = self.state.playing
        here = played.situation._replace(x=estimate.x, w=estimate.w)
        effective = self._cost(self.problem.at(here), played.z)
        wanted, assessment = self._decide(effective, update, interrupted=interrupted)
        iterations = min(wanted, self.budget.iterations(MAX_PERIOD_TICKS))
        ticks = self.fixed_ticks or min(self.budget.period(iterations) + self.state.allowance, MAX_PERIOD_TICKS)
        self.state.last = Period(update, estimate, iterations, ticks, effective, assessment)
        # a load that keeps moving must not keep the control PLC waiting for ever
        load_step = 0.0 if interrupted else self.settings.interrupting_load_step_w
        return Plan(update.update, update.tick + ticks, load_step)

    def _knows_what_is_played(self, update: Update) -> bool:
        """Tell whether the control PLC plays something of ours, or has not begun to."""
        if self.state.playing.sequence is None:
            return True
        ours = (delivery.sequence for delivery in (self.state.playing, self.state.sent) if delivery is not None)
        return any(sequence is not None and sequence.header.number == update.playing for sequence in ours)

    def _begin_again(self, update: Update) -> None:
        """Forget what was sent: others have moved the inputs since, from which the next profile sets out."""
        self.estimator.reset()
        u = np.asarray(update.u, self._real) - self.model.u0
        situation = self.state.playing.situation._replace(u_before=u)
        self.state.playing = Delivery(self.problem.hold(u), situation, update.tick, None)
        self.state.sent = self.state.last = None

    def _predict_to(self, update: Update) -> None:
        """Predict to this instant if another one was planned."""
        last = self.state.last
        if last is not None and 0 < (elapsed := update.tick - last.update.tick) != last.ticks:
            self.estimator.predict(self._segments(last.update, elapsed))

    def _is_interrupted(self, update: Update) -> bool:
        """Tell whether a load step has cut the last period off."""
        last = self.state.last
        if last is None:
            return False
        elapsed = update.tick - last.update.tick
        stepped = abs(update.load - last.update.load) > self.settings.interrupting_load_step_w > 0
        return stepped and 0 < elapsed < last.ticks

    def _follow(self, update: Update) -> None:
        """Find out which profile the control PLC plays from this instant on."""
        sent = self.state.sent
        if sent is not None and sent.sequence is not None and sent.sequence.header.number == update.playing:
            late = update.tick - sent.first_tick  # scans were missed: it began before this instant
            self.state.playing = replace(sent, z=self.problem.shifted(sent.z, late)) if late > 0 else sent
        elif self.state.last is not None:
            late, played = update.tick - self.state.last.update.tick, self.state.playing
            self.state.playing = Delivery(
                self.problem.shifted(played.z, late), played.situation, played.first_tick, played.sequence
            )

    def _decide(self, effective: float, update: Update, *, interrupted: bool) -> tuple[int, Assessment]:
        """Step (4): the rule decides, unless the last sequence never took effect."""
        last, played = self.state.last, self.state.playing
        if last is None:
            return self.rule.first, UNDECIDED
        if interrupted:
            return self.rule.after_interruption(), UNDECIDED
        if played is not self.state.sent or played.first_tick != update.tick:
            return last.iterations, UNDECIDED
        observation = Observation(
            last.iterations,
            last.ticks * TICK_S,
            last.effective,
            played.hot_start,
            played.last_but_one,
            played.delivered,
            effective,
        )
        return self.rule.next(observation)

    # -- step (3): during the updating period -------------------------------------------------------------------------

    def answer_after_s(self) -> float:
        """Return the plant time from the instant of the last `plan` until the PLC has computed its answer."""
        return self.budget.answer_after_s(self._period.iterations)

    @property
    def _period(self) -> Period:
        if self.state.last is None:
            raise RuntimeError("solve and answer_after_s follow plan")
        return self.state.last

    def solve(self) -> InputSequence:
        """Predict the state at t_{i+1}, shift the profile, do q iterations; return the sequence to play from there."""
        period = self._period
        segments = self._segments(period.update, period.ticks)
        x = self.estimator.predict(segments)
        situation = Situation(x, period.estimate.w, segments[-1][0], period.ticks)
        qp = self.problem.at(situation)
        guess = self.problem.shifted(self.state.playing.z, period.ticks)
        answer = self.solver.solve(qp, guess, (period.iterations - 1, period.iterations))
        z = self.problem.within_first_rate(answer.z, situation)
        sequence = self._sequence(period, z)
        self.state.sent = Delivery(
            z, situation, sequence.header.first_tick, sequence, qp,
            self._with_floor(answer.guessed, qp), self._with_floor(answer.costs[0], qp),
            self._with_floor(answer.costs[1], qp), int(answer.iterations[1]),
        )  # fmt: skip
        return sequence

    def _segments(self, update: Update, ticks: int) -> list[tuple[Array, int]]:
        """Return the inputs played from an update on as (deviation, ticks), runs of equal inputs joined."""
        u0 = self.model.u0
        sequence = self.state.playing.sequence
        if sequence is None:
            return [(np.asarray(update.u, self._real) - u0, ticks)]
        segments: list[tuple[Array, int]] = []
        previous: SequenceRow | None = None
        for tick in range(update.tick, update.tick + ticks):
            row = sequence.rows[min(tick - self.state.playing.first_tick, len(sequence.rows) - 1)]
            if row == previous:
                segments[-1] = (segments[-1][0], segments[-1][1] + 1)
            else:
                segments.append((np.asarray(row, self._real) - u0, 1))
            previous = row
        return segments

    def _sequence(self, period: Period, z: Array) -> InputSequence:
        length = max(self.settings.sequence_ticks, 2 * period.ticks)
        samples = -(-length // TICKS_PER_SAMPLE)
        inputs = [as_transmitted(SequenceRow(*row)) for row in self.problem.inputs(z, samples).tolist()]
        rows = [inputs[tick // TICKS_PER_SAMPLE] for tick in range(length)]
        self.state.sequences += 1
        header = SequenceHeader(
            number=self.state.sequences,
            update=period.update.update,
            first_tick=period.update.tick + period.ticks,
            length=length,
            tau_u=period.ticks,
            model_digest=self.model_digest,
            crc=0,
        )
        return with_checksum(header, rows)

    def _cost(self, qp: QuadraticProblem, z: Array) -> float:
        return self._with_floor(augmented_cost(qp, z, self._real(self.solver.alpha)), qp)

    def _with_floor(self, cost: float, qp: QuadraticProblem) -> float:
        """Return J with its constant and its floor; rounding, in single precision, must not take it below the floor."""
        floor = self._real(self.settings.adaptive.cost_floor)
        return max(self._real(cost) + (qp.constant + floor), floor)

    def answered(self, *, late: bool) -> None:
        """Note how an answer came: after a late one adaptive periods get longer, after one in time shorter again.

        The budget is what the PLC should need; this is what machine and link really take. Each late answer doubles
        what is allowed for them, each one in time takes a tick off.
        """
        if late:
            self.state.allowance = min(max(1, 2 * self.state.allowance), MAX_PERIOD_TICKS)
        else:
            self.state.allowance = max(0, self.state.allowance - 1)

    # -- diagnostics --------------------------------------------------------------------------------------------------

    def prediction(self) -> Prediction:
        """Return what the last profile is expected to lead to."""
        sent = self.state.sent
        if sent is None or sent.sequence is None:
            raise RuntimeError("prediction follows solve")
        horizon = self.problem.design.horizon
        outputs = self.problem.outputs(sent.z, sent.situation)
        inputs = self.problem.inputs(sent.z, horizon)
        shown = outputs[[min(sample, horizon) - 1 for sample in PREDICTED_SAMPLES]]
        planned = inputs[[min(sample, horizon) - 1 for sample in INPUT_SAMPLES]]
        header = sent.sequence.header
        return Prediction(
            header.update, header.first_tick, tuple(shown[:, 0].tolist()), tuple(shown[:, 1].tolist()),
            tuple(planned.ravel().tolist()),
        )  # fmt: skip

    @property
    def operating_limits(self) -> OperatingLimits:
        """Bands, bounds and rates that profiles keep."""
        design, limits = self.settings.design, self.problem.limits
        return OperatingLimits(design.output_low, design.output_high, limits.low, limits.high, limits.rate)

    def rule_status(self) -> UpdatingRuleStatus:
        """Return what decides the updating period in this session."""
        return self.rule.status._replace(**self.budget.times._asdict())

    def report(self, verdict: Verdict) -> Optimization:
        """Return what was done with the last update, once the control PLC has answered."""
        period, sent = self._period, self.state.sent
        if sent is None or sent.qp is None:
            raise RuntimeError("report follows solve")
        predicted = indicators(self.problem, sent.qp, sent.z, sent.situation)
        a = period.assessment
        return Optimization(
            update=period.update.update, tick=period.update.tick, tau_u=period.ticks, iterations=sent.iterations,
            verdict=verdict, j_effective=float(period.effective), j_hot_start=float(sent.hot_start),
            j_delivered=float(sent.delivered), j_dev=predicted.j_dev, j_cst=predicted.j_cst,
            violation=predicted.violation, efficiency=float(a.efficiency), mismatch=float(a.mismatch),
            contraction=float(a.contraction), gamma=float(a.gamma), load_mismatch=float(period.estimate.mismatch),
        )  # fmt: skip
