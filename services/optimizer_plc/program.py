"""The optimiser PLC's program: the implementation scheme of the paper's section II, steps (1) to (5).

For each update the control PLC latches, `plan` decides the updating period and `solve` computes the sequence that is
played from its end on. Here are the decisions; the arithmetic is that of `scheme.py`, on the one state of the session.
Pure: no sockets, no clock, no sleeping.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.first_use import kernels_of
from coldloop.process.limits import InputLimits
from coldloop.process.loaded import PROCESS
from coldloop.process.lti_model import LtiModel
from coldloop.process.signals import CONTROLLED, INPUT_NAMES, OUTPUT_NAMES, TICK_S, TICKS_PER_SAMPLE
from coldloop.registers.control_plc import SEQUENCE_ROWS, Plan, SequenceHeader, SequenceRow, Update, Verdict
from coldloop.registers.optimizer_plc import (
    INPUT_SAMPLES,
    PREDICTED_SAMPLES,
    ModelDeviation,
    OperatingLimits,
    Optimization,
    Prediction,
    UpdatingRuleStatus,
)
from coldloop.safety.sequence import InputSequence, with_checksum
from optimizer_plc import scheme
from optimizer_plc.budget import PlcBudget
from optimizer_plc.computing_settings import Arithmetic
from optimizer_plc.estimator import correct, estimator_of
from optimizer_plc.forecasts import Forecasts
from optimizer_plc.outside_estimator import OutsideEstimator
from optimizer_plc.qp.arithmetic import real_of
from optimizer_plc.qp.prediction import prediction_of
from optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from optimizer_plc.qp.rest import rest_map
from optimizer_plc.qp.target import target_search
from optimizer_plc.rules import OutsideRule, UpdatingRule, make_rule
from optimizer_plc.rules.interface import decide_by
from optimizer_plc.session_state import empty_state
from optimizer_plc.settings import ProgramSettings
from optimizer_plc.solvers import KernelSolver, make_solver

Array = NDArray[np.float64]

PROVEN: Final = 8
"""Answers in time, one after the other, after which the next is tried with half of what is allowed for late ones: where
some ticks are needed for good, one answer in nine is late."""
LONGEST_GAP_TICKS: Final = 4 * SEQUENCE_ROWS
"""After a longer time without an update nothing is predicted from the last one."""


def _described(settings: ProgramSettings) -> str:
    return f"the {settings.solver_name} solver{' in single precision' * (settings.arithmetic is Arithmetic.FLOAT32)}"


class OptimizerProgram:
    """Estimator, problem, solver and updating rule, put together."""

    def __init__(self, model: LtiModel, settings: ProgramSettings, limits: InputLimits) -> None:
        with kernels_of(_described(settings), about_s=15):
            self.settings = settings
            self.model_digest = model.short_digest
            self._real = real_of(settings.arithmetic)
            self.disturbances = settings.estimator.disturbed
            self._prediction = prediction = prediction_of(model, self.disturbances, settings.design)
            self._forecasts = Forecasts(PROCESS.forecasts, settings.design.decision_instants)
            self.problem = PredictiveProblem(prediction, settings.design, limits, self._real, settings.penalties)
            self.solver = make_solver(settings)
            self.budget = PlcBudget(settings.budget, self.solver.tau_1_s)
            self.state = empty_state(prediction.n_states, self.problem.size, self._real)
            estimator = estimator_of(prediction, settings.estimator, self._real, settings.plausibility)
            self._rest_map = rest_map(prediction, self._real)
            at_rest = self.problem.at(QpParameters(self.state.belief.x, self._real(0.0), self.state.u))
            self.method = self.solver.method(at_rest) if isinstance(self.solver, KernelSolver) else None
            target = target_search(prediction, settings.design, limits, self._real)
            self.constants = scheme.constants_of(
                estimator, self.problem, target, self.solver.alpha, settings, self.budget
            )
            self._compile_kernels(model)
        self.restart(settings.updating_period_s)

    def _compile_kernels(self, model: LtiModel) -> None:
        """Go through two updates at the operating point, so that no session waits for the compiler."""
        u, y, x = (tuple(values.tolist()) for values in (model.u0, model.y0, model.x0))
        first = Update(0, 0, 0, 0, load=model.w0, u_before=u, u=u, y=y, x=x)
        self.restart(0.0)
        planned = self.plan(first)
        sequence = self.solve()
        self.prediction()
        self.plan(first._replace(update=1, tick=planned.next_update_tick, playing=sequence.header.number))

    def restart(self, updating_period_s: float, rule: UpdatingRule | None = None) -> None:
        """Forget everything and begin a session at the operating point.

        Args:
            updating_period_s: Fixed updating period; 0 is adaptive.
            rule: Decides adaptive periods instead of the rule that the settings name.
        """
        fixed_ticks = round(updating_period_s / TICK_S)
        self.constants = self.constants._replace(fixed_ticks=fixed_ticks)
        self.rule = rule or make_rule(self.settings, self.budget, fixed_ticks, self._real)
        outside = self.settings.outside.estimator
        self._estimator = OutsideEstimator(outside, self._prediction, self.settings.estimator) if outside else None
        self.solver.reset()
        for part in (self.state.numbers, self.state.playing.numbers, self.state.sent.numbers):
            part[:] = np.zeros(1, part.dtype)
        for array in (*self.state.playing[1:], *self.state.sent[1:], self.state.u, self.state.target, self.state.rule):
            array[:] = 0
        self.state.belief.forget()
        self._now["guessed_before"] = self._now["delivered_before"] = np.inf
        self._playing["ticks"], self._playing["share"] = TICKS_PER_SAMPLE, self.constants.rate_shares[TICKS_PER_SAMPLE]

    @property
    def _now(self) -> np.void:
        """Numbers of the period under way."""
        record: np.void = self.state.numbers[0]
        return record

    @property
    def _playing(self) -> np.void:
        """Numbers of what is played."""
        record: np.void = self.state.playing.numbers[0]
        return record

    @property
    def _sent(self) -> np.void:
        """Numbers of the last answer."""
        record: np.void = self.state.sent.numbers[0]
        return record

    # -- steps (4), (5) and (2): at an updating instant ---------------------------------------------------------------

    def plan(self, update: Update) -> Plan:
        """Take the update latched at t_i and decide the updating period that begins there."""
        now, state, estimator = self._now, self.state, self.constants.estimator
        u = np.asarray(update.u, self._real) - estimator.u0
        elapsed = update.tick - int(now["tick"]) if now["planned"] else 0
        known = now["planned"] or update.tick == 0  # a session begins at the operating point
        if not (known and 0 <= elapsed <= LONGEST_GAP_TICKS and self._knows_what_is_played(update)):
            self._begin_again(update, u)
        elif 0 < elapsed != now["ticks"]:
            scheme.predict_played(self.constants, state, elapsed)
        interrupted = self._is_interrupted(update)
        in_time = self._follow(update, u)
        now["sequences"] = max(int(now["sequences"]), update.playing)
        state.u[:] = u
        self._look_ahead(state.belief.predicted, update.tick)
        self._take(self._wanted(interrupted=interrupted, in_time=in_time), update)
        # a load that keeps moving must not keep the control PLC waiting for ever
        load_step = 0.0 if interrupted else self.settings.interrupting_load_step_w
        return Plan(
            update.update, update.tick + int(now["ticks"]), load_step, float(now["shortage"]), int(now["suspects"])
        )

    def _look_ahead(self, x: Array, tick: int) -> None:
        """Write into a state (n,) what is forecast from `tick` on."""
        if ahead := len(self._forecasts):
            x[-ahead:] = self._forecasts.changes(tick)

    @property
    def plans_by_steps(self) -> bool:
        """Whether estimator or rule are not ours, and called between the kernels that `scheme.plan` calls."""
        return self._estimator is not None or isinstance(self.rule, OutsideRule)

    def _take(self, wanted: int, update: Update) -> None:
        """Take a measurement and decide the period, by `scheme.plan` or step by step."""
        c, m, load = self.constants, self.state, self._real(update.load)
        u_before, y, x = (np.array(values, self._real) for values in (update.u_before, update.y, update.x))
        if not self.plans_by_steps:
            scheme.plan(c, self.rule, m, wanted, update.update, update.tick, u_before, load, y, x)
            return
        scheme.end_period(m)
        if self._estimator is None:
            correct(c.estimator, m.belief, u_before, load, y, x)
        else:
            self._estimator.correct(c.estimator, m.belief, u_before, load, y)
        effective = scheme.judge_played(c, m, load, y)
        if wanted == scheme.BY_THE_RULE:
            wanted = decide_by(self.rule, m.rule, *scheme.assess_period(c, m, effective))
        scheme.begin_period(c, m, wanted, update.update, update.tick, load, effective)

    def _knows_what_is_played(self, update: Update) -> bool:
        """Return whether the control PLC plays something of ours, or has not begun to."""
        ours = [one["number"] for one in (self._playing, self._sent) if one["length"]]
        return not self._playing["length"] or update.playing in ours

    def _begin_again(self, update: Update, u: Array) -> None:
        """Forget what was sent: others have moved the inputs since, from which the next profile sets out.

        For want of a past the plant is believed to rest: a filter that began at the operating point would take minutes.
        """
        estimator = self.constants.estimator
        load = update.load - estimator.w0 if estimator.load_known else None
        first = CONTROLLED[0]
        level = update.y[first] - estimator.y0[first] if math.isfinite(update.y[first]) else 0.0
        self.state.belief.begin_at_rest(self._rest_map, u, load, level)
        playing = self.state.playing
        playing.z[:], playing.u_before[:] = self.problem.hold(u), u
        self._playing["first_tick"], self._playing["length"] = update.tick, 0
        self._sent["length"] = 0
        self._now["planned"] = False

    def _is_interrupted(self, update: Update) -> bool:
        """Return whether a load step has cut the last period off."""
        now = self._now
        if not now["planned"]:
            return False
        elapsed = update.tick - int(now["tick"])
        stepped = abs(update.load - float(now["load"])) > self.settings.interrupting_load_step_w > 0
        return stepped and 0 < elapsed < int(now["ticks"])

    def _follow(self, update: Update, u: Array) -> bool:
        """Find out which profile is played from this instant on; return whether it is the last answer, in time."""
        sent, playing = self._sent, self.state.playing
        late = 0
        if begun := bool(sent["length"] and sent["number"] == update.playing):
            scheme.begin_sent(self.state)
            late = update.tick - int(sent["first_tick"])  # scans were missed: it began before this instant
        elif self._now["planned"] and not self._playing["length"]:  # others may have moved the inputs again
            playing.z[:], playing.u_before[:] = self.problem.hold(u), u
        elif self._now["planned"]:
            late = update.tick - int(self._now["tick"])
        if late > 0:
            playing.z[:] = self.problem.shifted(playing.z, late)
        return begun and late == 0

    def _wanted(self, *, interrupted: bool, in_time: bool) -> int:
        """Return the q of the period, which the rule decides unless the last sequence never took effect."""
        if not self._now["planned"]:
            return self.rule.first
        if interrupted:
            return self.rule.after_interruption(self.state.rule)
        return scheme.BY_THE_RULE if in_time else int(self._now["q"])

    # -- step (3): during the updating period -------------------------------------------------------------------------

    def answer_after_s(self) -> float:
        """Return the plant time from the instant of the last `plan` until the PLC has computed its answer."""
        return self.budget.answer_after_s(self._iterations)

    @property
    def _iterations(self) -> int:
        if not self._now["planned"]:
            raise RuntimeError("call plan before solve and answer_after_s")
        return int(self._now["iterations"])

    def solve(self) -> InputSequence:
        """Predict the state at t_{i+1}, shift the profile, iterate; return the sequence to play from there."""
        n = self._iterations
        self._look_ahead(self.state.belief.x, int(self._now["tick"]) + int(self._now["ticks"]))
        if isinstance(self.solver, KernelSolver):
            scheme.solve(self.constants, self.method, self.state)
        else:
            qp, guess = scheme.pose(self.constants, self.state)
            scheme.deliver(self.constants, self.state, qp, self.solver.solve(qp, guess, (n - 1, n)))
        return self._sequence()

    def _sequence(self) -> InputSequence:
        """Return the last answer as the control PLC takes it."""
        now, sent, rows = self._now, self._sent, self.state.sent.rows
        length = int(sent["length"])
        inputs = [SequenceRow(*row) for row in rows[:length:TICKS_PER_SAMPLE].tolist()]
        header = SequenceHeader(
            number=int(sent["number"]),
            update=int(now["update"]),
            first_tick=int(sent["first_tick"]),
            length=length,
            tau_u=int(now["ticks"]),
            model_digest=self.model_digest,
            crc=0,
        )
        return with_checksum(header, [inputs[tick // TICKS_PER_SAMPLE] for tick in range(length)])

    def answered(self, *, late: bool) -> None:
        """Note how an answer came: after a late one adaptive periods get longer, after one in time shorter again.

        The budget is what the PLC should need; this is what machine and link really take. Each late answer doubles
        what is allowed for them, `PROVEN` in time halve it. Where a period is fixed, or is the longest, there are fewer
        iterations instead.
        """
        now, allowance = self._now, int(self._now["allowance"])
        now["in_time"] = 0 if late else (now["in_time"] + 1) % PROVEN
        if late:
            now["allowance"] = min(max(1, 2 * allowance), int(now["ticks"]))
        elif not now["in_time"]:
            now["allowance"] = allowance // 2

    # -- diagnostics --------------------------------------------------------------------------------------------------

    def prediction(self) -> Prediction:
        """Return what the last profile is expected to lead to."""
        header, sent = self._sent, self.state.sent
        if not header["length"]:
            raise RuntimeError("call solve before prediction")
        horizon = self.problem.design.horizon
        outputs = self.problem.outputs(sent.z, QpParameters(sent.x, header["w"], sent.u_before))
        inputs = self.problem.inputs(sent.z, horizon)
        shown = outputs[[min(sample, horizon) - 1 for sample in PREDICTED_SAMPLES]]
        planned = inputs[[min(sample, horizon) - 1 for sample in INPUT_SAMPLES]]
        return Prediction(
            int(self._now["update"]), int(header["first_tick"]), *map(tuple, shown.T.tolist()),
            tuple(planned.ravel().tolist()),
        )  # fmt: skip

    def model_deviation(self) -> ModelDeviation:
        """Return how the plant differs from the model, as the filter has estimated it at the last update."""
        belief, n_y = self.state.belief, len(OUTPUT_NAMES)
        constants = np.zeros(n_y + len(INPUT_NAMES))
        end = self._prediction.n_estimated
        constants[list(self.disturbances)] = belief.x[end - len(self.disturbances) : end]
        return ModelDeviation(
            float(belief.numbers[0]["mismatch"]), tuple(constants[n_y:].tolist()), tuple(constants[:n_y].tolist()),
            tuple(np.sqrt(belief.surprise).tolist()),
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
        if not self._sent["length"]:
            raise RuntimeError("call solve before report")
        now, sent = self._now, self._sent
        return Optimization(
            update=int(now["update"]), tick=int(now["tick"]), tau_u=int(now["ticks"]), q=int(now["q"]),
            iterations=int(sent["iterations"]), verdict=verdict, j_effective=float(now["effective"]),
            j_hot_start=float(sent["hot_start"]), j_delivered=float(sent["delivered"]), j_dev=float(sent["j_dev"]),
            j_cst=float(sent["j_cst"]), violation=float(sent["violation"]), efficiency=float(now["efficiency"]),
            mismatch=float(now["mismatch"]), contraction=float(now["contraction"]), gamma=float(now["gamma"]),
            load_mismatch=float(self.state.belief.numbers[0]["mismatch"]),
        )  # fmt: skip
