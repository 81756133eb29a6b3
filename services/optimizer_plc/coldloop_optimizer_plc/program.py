"""The optimiser PLC's program: the implementation scheme of the paper's section II, steps (1) to (5).

For each update the control PLC latches, `plan` decides the updating period and `solve` computes the sequence that is
played from its end on. Decisions are those of `decisions.py`, the arithmetic is that of `scheme.py`, on the one state
of the session. Pure: no sockets, no clock, no sleeping.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from coldloop.errors import ConfigurationError
from coldloop.kernels import cache, compiled
from coldloop.process import declaration, lti_model
from coldloop.process.settings import InputLimits
from coldloop.registers import control_plc
from coldloop.registers import optimizer_plc as registers
from coldloop.safety.writers import InputSequence, with_checksum
from coldloop_optimizer_plc import computing_settings, decisions, scheme
from coldloop_optimizer_plc.decisions import Latched, Starts
from coldloop_optimizer_plc.estimator import OutsideEstimator, correct, estimator_of
from coldloop_optimizer_plc.qp import linear_algebra, problem
from coldloop_optimizer_plc.qp.prediction import prediction_of, rest_map, target_search
from coldloop_optimizer_plc.rules import OutsideRule, UpdatingRule, decide_by, make_rule
from coldloop_optimizer_plc.scheme import empty_state
from coldloop_optimizer_plc.settings import ProgramSettings
from coldloop_optimizer_plc.solvers import KernelSolver, make_solver


@np.errstate(over="ignore")
def _single(values: Sequence[float] | linear_algebra.Array) -> list[float]:
    """Return numbers as registers carry them: infinite beyond single precision."""
    single: list[float] = np.asarray(values, np.float64).astype(np.float32).tolist()
    return single


class OptimizerProgram:
    """Estimator, problem, solver and updating rule, put together."""

    def __init__(self, model: lti_model.LtiModel, settings: ProgramSettings, limits: InputLimits) -> None:
        precision = " in single precision" * (settings.arithmetic is computing_settings.Arithmetic.FLOAT32)
        with cache.kernels_of(f"the {settings.solver_name} solver{precision}", about_s=15):
            self.settings, self.process = settings, settings.process
            self.model_digest = model.short_digest
            self._real = linear_algebra.real_of(settings.arithmetic)
            self.disturbances = settings.estimator.disturbed
            self._prediction = prediction = prediction_of(model, self.disturbances, settings.design)
            self._forecasts = Forecasts(self.process, settings.design.decision_instants)
            self.problem = problem.PredictiveProblem(
                prediction, settings.design, limits, self._real, settings.penalties
            )
            self.solver = make_solver(settings)
            self.budget = computing_settings.PlcBudget(settings.budget, self.solver.tau_1_s)
            self.state = empty_state(prediction.n_states, len(model.u0), len(model.y0), self.problem.size, self._real)
            estimator = estimator_of(prediction, settings.estimator, self._real, settings.plausibility)
            self._nothing_ahead = np.zeros(0, self._real)
            at_rest = self.problem.at(problem.QpParameters(self.state.belief.x, self._real(0.0), self.state.u))
            self.method = self.solver.method(at_rest) if isinstance(self.solver, KernelSolver) else None
            target = target_search(prediction, settings.design, limits, self._real)
            self.constants = scheme.constants_of(
                estimator, self.problem, target, self.solver.alpha, settings, self.budget,
                rest_map(prediction, self._real),
            )  # fmt: skip
            self._compile_kernels(model)
        self.restart(settings.updating_period_s)

    def _compile_kernels(self, model: lti_model.LtiModel) -> None:
        """Go through two updates at the operating point, so that no session waits for the compiler."""
        u, y, x = (tuple(values.tolist()) for values in (model.u0, model.y0, model.x0))
        first = control_plc.Update(0, 0, 0, 0, load=model.w0, u_before=u, u=u, y=y, x=x)
        self.restart(0.0)
        planned = self.plan(first)
        sequence = self.solve()
        if not sequence.rows:
            raise ConfigurationError(
                "optimizer_plc.program.design: the problem at the operating point has no finite answer; where a mode"
                " grows the horizon may be too long: shorten decision_instants"
            )
        self.predictor()()
        self.answered(late=False)
        self.plan(first._replace(update=1, tick=planned.next_update_tick, playing=sequence.header.number))

    def restart(self, updating_period_s: float, rule: UpdatingRule | None = None) -> None:
        """Forget everything and begin a session at the operating point.

        `updating_period_s` is the fixed updating period; 0 is adaptive, by `rule` or by that of the settings.
        """
        fixed_ticks = round(updating_period_s / self.process.tick_s)
        self.constants = self.constants._replace(fixed_ticks=fixed_ticks)
        self.rule = rule or make_rule(self.settings, self.budget, fixed_ticks, self._real)
        self._entries: dict[Any, Callable[..., Any]] = {}
        """Compiled code of kernels whose arguments have the same types in the whole session."""
        outside = self.settings.outside.estimator
        self._estimator = OutsideEstimator(outside, self._prediction, self.settings.estimator) if outside else None
        self.solver.reset()
        for part in (self.state.numbers, self.state.playing.numbers, self.state.sent.numbers):
            part[:] = np.zeros(1, part.dtype)
        for array in (*self.state.playing[1:], *self.state.sent[1:], self.state.u, self.state.target, self.state.rule):
            array[:] = 0
        decisions.begin_session(self.constants, self.state)

    def _run(self, kernel: Callable[..., Any], *arguments: Any) -> Any:  # noqa: ANN401
        """Call a kernel whose arguments have the same types in the whole session."""
        entry = self._entries.get(kernel)
        if entry is None:
            entry = self._entries[kernel] = compiled.entry_of(kernel, *arguments)
        return entry(*arguments)

    def plan(self, update: control_plc.Update) -> control_plc.Plan:
        """Take the update latched at t_i and decide the updating period that begins there."""
        c, m = self.constants, self.state
        u_before, u, y, x = (np.array(values, self._real) for values in (update.u_before, update.u, update.y, update.x))
        load, ahead = self._real(update.load), self._ahead(update.tick)
        latched = Latched(update.update, update.tick, update.playing, load, u_before, u, y, x, ahead)
        if self.plans_by_steps:
            load_step = self._plan_by_steps(latched)
        else:
            starts = Starts(self.rule.first, self.rule.after_interruption())
            load_step = self._run(decisions.take_update, c, self.rule, starts, m, latched)
        now = self.state.numbers[0]
        return control_plc.Plan(
            update.update, update.tick + int(now["ticks"]), float(load_step), float(now["shortage"]),
            int(now["suspects"]),
        )  # fmt: skip

    def _ahead(self, tick: int) -> linear_algebra.Array:
        return self._forecasts.changes(tick).astype(self._real) if len(self._forecasts) else self._nothing_ahead

    @property
    def plans_by_steps(self) -> bool:
        """Whether estimator or rule are not ours, and called between the kernels that `take_update` calls."""
        return self._estimator is not None or isinstance(self.rule, OutsideRule)

    def _plan_by_steps(self, latched: Latched) -> float:
        """Do what `take_update` does; return the load step that ends the period, or 0."""
        c, m = self.constants, self.state
        wanted, load_step = decisions.follow(c, m, latched), float(c.load_step)
        if wanted == decisions.FIRST:
            wanted = self.rule.first
        elif wanted == decisions.AFTER_A_STEP:
            wanted, load_step = self.rule.after_interruption(), 0.0
        if self._estimator is None:
            correct(c.estimator, m.belief, latched.u_before, latched.load, latched.y, latched.x)
        else:
            self._estimator.correct(c.estimator, m.belief, latched.u_before, latched.load, latched.y)
        effective = decisions.judge_played(c, m, latched.load, latched.y)
        if wanted == decisions.BY_THE_RULE:
            wanted = decide_by(self.rule, m.rule, *decisions.assess_period(c, m, effective))
        decisions.begin_period(c, m, wanted, latched, effective)
        return load_step

    def answer_after_s(self) -> float:
        """Return the plant time from the instant of the last `plan` until the PLC has computed its answer."""
        return self.budget.answer_after_s(self._iterations)

    @property
    def _iterations(self) -> int:
        if not self.state.numbers[0]["planned"]:
            raise RuntimeError("call plan before solve and answer_after_s")
        return int(self.state.numbers[0]["iterations"])

    def solve(self) -> InputSequence:
        """Predict the state at t_{i+1}, shift the profile, iterate; return the sequence to play from there.

        It has no rows where something was not finite.
        """
        n, now = self._iterations, self.state.numbers[0]
        if ahead := len(self._forecasts):
            self.state.belief.x[-ahead:] = self._ahead(int(now["tick"]) + int(now["ticks"]))
        if isinstance(self.solver, KernelSolver):
            self._run(scheme.solve, self.constants, self.method, self.state)
        else:
            qp, guess = scheme.pose(self.constants, self.state)
            with computing_settings.in_its_name(
                computing_settings.Part.SOLVER, self.settings.outside.solver or self.settings.solver
            ):
                answer = self.solver.solve(qp, guess, (n - 1, n))
            scheme.deliver(self.constants, self.state, qp, answer)
        sent, rows = self.state.sent.numbers[0], self.state.sent.rows
        length, held = int(sent["length"]), self.process.ticks_per_sample
        inputs = list(map(tuple, rows[:length:held].tolist()))
        header = control_plc.SequenceHeader(
            number=int(sent["number"]), update=int(now["update"]), first_tick=int(sent["first_tick"]), length=length,
            tau_u=int(now["ticks"]), model_digest=self.model_digest, crc=0,
        )  # fmt: skip
        return with_checksum(header, [inputs[tick // held] for tick in range(length)])

    def answered(self, *, late: bool) -> None:
        """Note how an answer came."""
        self._run(decisions.note_answer, self.state, late)

    def predictor(self) -> Callable[[], registers.Prediction]:
        """Return what computes the expected result of the last profile, also after later updates."""
        header, sent = self.state.sent.numbers[0], self.state.sent
        if not header["length"]:
            raise RuntimeError("call solve before predictor")
        update, first_tick, z = int(self.state.numbers[0]["update"]), int(header["first_tick"]), sent.z.copy()
        at = problem.QpParameters(sent.x.copy(), header["w"], sent.u_before.copy())

        def predict() -> registers.Prediction:
            horizon = self.problem.design.horizon
            outputs, inputs = self.problem.outputs(z, at), self.problem.inputs(z, horizon)
            shown = outputs[[min(sample, horizon) - 1 for sample in registers.PREDICTED_SAMPLES]]
            planned = inputs[[min(sample, horizon) - 1 for sample in registers.INPUT_SAMPLES]]
            y, u = tuple(shown.T.ravel().tolist()), tuple(planned.ravel().tolist())
            return registers.Prediction(update, first_tick, y, u)

        return predict

    def model_deviation(self) -> registers.ModelDeviation:
        """Return how the plant differs from the model, as the filter has estimated it at the last update."""
        belief, n_y = self.state.belief, len(self.process.outputs)
        constants = np.zeros(n_y + len(self.process.inputs))
        end = self._prediction.n_estimated
        constants[list(self.disturbances)] = belief.x[end - len(self.disturbances) : end]
        return registers.ModelDeviation(
            _single([belief.numbers[0]["mismatch"]])[0], tuple(_single(constants[n_y:])),
            tuple(_single(constants[:n_y])), tuple(_single(np.sqrt(belief.surprise))),
        )  # fmt: skip

    @property
    def operating_limits(self) -> registers.OperatingLimits:
        """Bands, bounds and rates that profiles keep."""
        design, limits = self.settings.design, self.problem.limits
        return registers.OperatingLimits(design.output_low, design.output_high, limits.low, limits.high, limits.rate)

    def rule_status(self) -> registers.UpdatingRuleStatus:
        """Return what decides the updating period in this session."""
        times = self.budget.times
        return self.rule.status._replace(slots=times.slots, preparation=times.preparation, iteration=times.iteration)

    def report(self, verdict: control_plc.Verdict) -> registers.Optimization:
        """Return what was done with the last update, once the control PLC has answered."""
        if not (self.state.sent.numbers[0]["length"] or self.state.numbers[0]["solved"]):
            raise RuntimeError("call solve before report")
        records = self.state.numbers[0], self.state.sent.numbers[0]
        now, sent = (dict(zip(record.dtype.names or (), record.item(), strict=True)) for record in records)
        of_sent, of_now = ("j_dev", "j_cst", "violation"), ("efficiency", "mismatch", "contraction", "gamma")
        numbers = [self.state.belief.numbers[0]["mismatch"], now["effective"], sent["hot_start"], sent["delivered"]]
        mismatch, effective, hot_start, delivered, *others = _single(
            [*numbers, *(sent[name] for name in of_sent), *(now[name] for name in of_now)]
        )
        return registers.Optimization(
            update=now["update"], tick=now["tick"], tau_u=now["ticks"], q=now["q"],
            iterations=sent["iterations"], verdict=verdict,
            load_mismatch=mismatch, j_effective=effective, j_hot_start=hot_start, j_delivered=delivered,
            **dict(zip((*of_sent, *of_now), others, strict=True)),
        )  # fmt: skip


class Forecasts:
    """Forecasts over plant time. Only their changes count: how large a disturbance is now is measured or estimated.

    Last samples of the parts of the horizon are its `ends`, rising.
    """

    def __init__(self, process: declaration.Process, ends: Sequence[int]) -> None:
        self._edges = process.ticks_per_sample * np.array([0, *ends])
        self._courses = []
        for one in process.forecasts:
            ticks, values = np.array(one.ticks, dtype=np.float64), np.array(one.values)
            until = np.concatenate([[0.0], np.cumsum(np.diff(ticks) * values[:-1])])
            self._courses.append((ticks, values, until))

    def __len__(self) -> int:
        return len(self._courses) * (len(self._edges) - 1)

    def changes(self, tick: int) -> linear_algebra.Array:
        """Return for each forecast its mean over each part of a horizon that begins at `tick`, less what it is there.

        Shape (forecasts x parts,), in the units of the disturbances.
        """
        parts = []
        for ticks, values, until in self._courses:
            at = tick + self._edges
            step = np.searchsorted(ticks, at, side="right") - 1
            integral = until[step] + values[step] * (at - ticks[step])
            parts.append(np.diff(integral) / np.diff(self._edges) - values[step[0]])
        return np.concatenate(parts)
