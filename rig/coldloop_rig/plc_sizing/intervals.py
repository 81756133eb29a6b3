"""Findings of sampled loops, with confidence: 95 % intervals, certified iterations, whether an adaptive period pays.

The certified number of iterations is by sampled scenarios and the binomial bound.

A scenario is fifteen minutes under a random telegraph: a family of hour drawn from a to f, and a draw of it that no
study uses. Scenarios are independent of each other. Each gives, for each solver, two figures: the iterations that its
worst problem needs, and those that the problem at a random instant needs. A problem needs q iterations when from q on,
up to `LONGEST`, J stays within a tolerance of its optimum.

If k of N independent scenarios violate something, then with confidence 1 - beta the probability that a new one does is
at most the epsilon at which the chance of k or fewer violations is beta (Clopper and Pearson, Biometrika 26, 1934; for
k = 0 it is 1 - beta^(1/N), as in Tempo, Bai and Dabbene, Systems & Control Letters 30, 1997). For the number of
iterations itself, the largest of N is one decision made by scenarios, and the same bound holds for it: Campi and
Garatti, SIAM Journal on Optimization 19 (3), 2008, with one variable. The claim is about the distribution that the
scenarios are drawn from, and about problems that a converged loop meets, hot-started from the optimum before.
"""

import random
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betaincinv, stdtrit

from coldloop.errors import ConfigurationError, StudyError
from coldloop.process import declaration, lti_model, updating_periods
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.settings import SolverName
from coldloop_optimizer_plc.solvers import Solver, make_solver
from coldloop_plant.load import HOURS, drawn, find_load
from coldloop_rig import progress, text_tables
from coldloop_rig.cosim.one_process import OneProcessRig, run_ideal_loop
from coldloop_rig.cosim.scenario import Scenario, natural_ticks
from coldloop_rig.results.recording import Recorder, evaluate
from coldloop_rig.settings import Settings

TAIL: Final = 0.025  # probability on each side of an interval
MOST_CHANGE: Final = 2.0  # change of a logarithm when a draw is left out, up to which it is taken for smooth


class Interval(NamedTuple):
    """A value with its interval: NaN if there is none, infinite on a side where nothing is known."""

    value: float
    low: float
    high: float

    def text(self, digits: int = 3) -> str:
        """Write the value and the interval in brackets, which a single hour has not."""
        if np.isnan(self.low):
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"

    def in_words(self, below: str, above: str, without: str) -> str:
        """Return what it shows of a ratio: that it is below 1, above 1, neither, or that there is no interval."""
        if np.isnan(self.low):
            return without
        if self.high < 1.0:
            return below
        return above if self.low > 1.0 else "no difference is shown"

    def brief(self, digits: int = 3) -> str:
        """Write value and interval with so many significant digits."""
        value = f"{self.value:.{digits}g}" if np.isfinite(self.value) else "none"
        return value if np.isnan(self.low) else f"{value} [{self.low:.{digits}g} to {self.high:.{digits}g}]"


def failure_bound(failures: int, scenarios: int, beta: float) -> float:
    """Return the probability that is not exceeded with confidence 1 - beta, given failures among scenarios.

    It is the upper end of the one-sided Clopper-Pearson interval: the epsilon with sum_{i <= k} C(N, i) epsilon^i
    (1 - epsilon)^(N - i) = beta.
    """
    if failures >= scenarios:
        return 1.0
    return float(betaincinv(failures + 1, scenarios - failures, 1.0 - beta))


def jackknife(statistic: Callable[[list[int]], float], draws: int, above: float = -np.inf) -> Interval:
    """Return a statistic of draws with its interval by the jackknife and Student's t (Efron and Tibshirani, 1993).

    Its values without each draw in turn give its variance, with draws - 1 degrees of freedom. Of a mean this is
    Student's interval, and of a geometric mean that of the logarithms. With 3 to 12 log-normal draws it covers
    geometric means in 95 %, means and ratios of sums in 92 to 95 % if draws are alike, and in less if few decide
    (docs/studies.md); percentiles of a bootstrap cover 72 to 91 %.

    Args:
        statistic: Of the numbers of the draws it is computed from, 0 to `draws` - 1.
        draws: Of one draw there is no interval: it is NaN. Without limits if there is no value without some draw.
        above: The statistic cannot be less: the interval is one of the logarithm of the distance from it, unless a
            draw changes this by more than `MOST_CHANGE`; then it is cut off there.

    Raises:
        ValueError: The statistic is below `above`.
    """
    every = range(draws)
    value = statistic(list(every))
    if draws < 2 or not np.isfinite(value):
        return Interval(value, np.nan, np.nan)
    without = np.array([statistic([draw for draw in every if draw != left]) for left in every])
    if not np.isfinite(without).all():
        return Interval(value, above, np.inf)
    least = min(value, *without)
    if least < above:
        raise ValueError(f"a statistic of {least:g} that cannot be below {above:g}")
    quantile = float(stdtrit(draws - 1, 1.0 - TAIL)) * (draws - 1) ** 0.5
    if -np.inf < above < least:
        logarithms = np.log((without - above) / (value - above))
        if np.abs(logarithms).max() < MOST_CHANGE:
            factor = float(np.exp(quantile * logarithms.std()))
            return Interval(value, above + (value - above) / factor, above + (value - above) * factor)
    reach = quantile * float(without.std())
    return Interval(value, max(value - reach, above), value + reach)


def interval_of_share(of_interest: int, hours: int) -> Interval:
    """Return a share of the hours with its Clopper-Pearson interval.

    It covers 95 to 100 %, with 3 hours 98 to 100 %: a count has few values, and no interval covers 95 % of each share.
    """
    low = 1.0 - failure_bound(hours - of_interest, hours, TAIL)
    return Interval(of_interest / hours, low, failure_bound(of_interest, hours, TAIL))


def geometric_mean(ratios: Array) -> float:
    """Return the geometric mean of positive numbers."""
    return float(np.exp(np.log(ratios).mean()))


def mean_ratio(costs: Array, reference: Array) -> Interval:
    """Return the geometric mean over the hours of costs over reference, shape (n,) each."""
    ratios = costs / reference
    return jackknife(lambda which: geometric_mean(ratios[which]), len(ratios), above=0.0)


def interval_of_mean(values: Sequence[float], above: float = -np.inf) -> Interval:
    """Return the mean of one value a draw, none less than `above`; draws without a value are left out."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return Interval(np.nan, np.nan, np.nan)
    return jackknife(lambda which: float(known[which].mean()), len(known), above)


def crossing(powers: Array, one: Array, other: Array) -> float:
    """Return the power from which on `one` is not above `other` any more; NaN if there is none."""
    above = np.log(one / other)
    behind = np.flatnonzero(above > 0)
    if not np.isfinite(above).all() or (len(behind) and behind[-1] == len(powers) - 1):
        return float("nan")
    if not len(behind):
        return float(powers[0])
    i = behind[-1]
    share = above[i] / (above[i] - above[i + 1])
    return float(np.exp(np.interp(share, [0, 1], np.log(powers[i : i + 2]))))


# -- certified iterations ----------------------------------------------------------------------------------------------


FAMILIES: Final = "abcdef"
SCENARIO_TICKS: Final = 3600
LONGEST: Final = 200
"""Iterations after which a problem counts as not solved: those of 5 s at ten times the power of the PLC."""
OWN_SEEDS: Final = 10**9  # first seed of the scenarios: no named load has one so large


class Problem(NamedTuple):
    """A problem that the loop met, with the guess, which is the shifted optimum of the problem before."""

    qp: QuadraticProblem
    guess: Array
    optimum: Array


class Needs(NamedTuple):
    """Iterations that the problems of one scenario need; `LONGEST` + 1 means more."""

    worst: int
    at_random: int


def iterations_needed(solver: Solver, problem: Problem, tolerance: float, floor: float) -> int:
    """Return from which iteration on J stays within a tolerance, a share of its optimum; `LONGEST` + 1 if from none.

    The solver begins from the problem's guess; `floor` is a constant that J has besides that of the problem, as in
    Algorithm 1.
    """
    qp = problem.qp
    rest = qp.constant + floor
    enough = (1.0 + tolerance) * (float(augmented_cost(qp, problem.optimum, solver.alpha)) + rest)
    answer = solver.solve(qp, problem.guess, range(1, LONGEST + 1))
    above = np.flatnonzero(np.array([answer.guessed, *answer.costs]) + rest > enough)
    return int(above[-1]) + 1 if len(above) else 0


def scenario_problems(settings: Settings, number: int) -> list[Problem]:
    """Return the problems of a scenario, at instants of 5 s of the converged loop."""
    draw = random.Random(OWN_SEEDS + number)  # noqa: S311 not for secrets; the one generator stable over versions
    hour = draw.choice(FAMILIES)
    family = HOURS[hour]._replace(seed=OWN_SEEDS + number)
    profile = drawn(family, hour, lti_model.load(settings.model.file).w0, settings.process)
    problems: list[Problem] = []
    scenario = Scenario(SCENARIO_TICKS, profile, 0.0, number)
    run_ideal_loop(
        settings, scenario, Recorder(SCENARIO_TICKS, []), settings.process.ticks_per_sample,
        lambda qp, guess, optimum: problems.append(Problem(qp, guess, optimum)),
    )  # fmt: skip
    return problems[1:]  # the first is at rest, and a chain of qpOASES begins with it


def scenario_needs(solver: Solver, problems: list[Problem], number: int, tolerance: float, floor: float) -> Needs:
    """Return what a scenario needs of a solver, beginning without a hot start."""
    solver.reset()
    needs = [iterations_needed(solver, problem, tolerance, floor) for problem in problems]
    return Needs(max(needs), needs[random.Random(number).randrange(len(needs))])  # noqa: S311


def failed(needs: Sequence[int], fitting: int, beta: float) -> tuple[str, str]:
    """Return in how many scenarios more iterations are needed than fit, and the bound of their share, as text."""
    failures = sum(one > fitting for one in needs)
    return f"{failures} of {len(needs)}", f"{100 * failure_bound(failures, len(needs), beta):.1f} %"


def certification_table(settings: Settings, scenarios: int, tolerance_pct: float, confidence_pct: float) -> str:
    """Sample scenarios, 1 or more, and return what they certify of each solver that is installed, as text.

    An answer is good when its J is within `tolerance_pct` (%) of the optimum; the bounds have `confidence_pct` (%).
    """
    beta, program = 1.0 - confidence_pct / 100.0, settings.optimizer_plc.program
    solvers = dict[SolverName, Solver]()
    for name in SolverName:
        with suppress(ConfigurationError):  # it is not installed
            solvers[name] = make_solver(program.model_copy(update={"solver": name}))
    needs: dict[SolverName, list[Needs]] = {name: [] for name in solvers}
    with progress.make_console().status("") as status:
        for number in range(scenarios):
            problems = scenario_problems(settings, number)
            for name, solver in solvers.items():
                needed = scenario_needs(solver, problems, number, tolerance_pct / 100.0, program.adaptive.cost_floor)
                needs[name].append(needed)
            status.update(f"{number + 1} of {scenarios} scenarios")
    none_failed = 100.0 * failure_bound(0, scenarios, beta)
    power, period_s = program.budget.power, settings.process.sampling_period_s
    heading = (
        f"{scenarios} independent scenarios of {SCENARIO_TICKS // 240} min under random telegraphs, problems "
        f"every {period_s:g} s; good is an answer within {tolerance_pct:g} % of the optimal J\n"
        f"with confidence {confidence_pct:g} %: at most so many problems at a random instant are not good after "
        f"the iterations that fit into {period_s:g} s at P = {power:g};\n"
        "at most so many scenarios have one that is not; and at most "
        f"{none_failed:.2f} % have one that needs more iterations than the most needed\n\n"
    )
    fit = f"fit into {period_s:g} s"
    header = ("solver", fit, "problems failed", "at most", "scenarios failed", "at most", "most needed")
    rows: list[tuple[str, ...]] = [header]
    for name, solver in solvers.items():
        fitting = PlcBudget(program.budget, solver.tau_1_s).iterations(program.process.ticks_per_sample)
        worst = [one.worst for one in needs[name]]
        at_random = failed([one.at_random for one in needs[name]], fitting, beta)
        most = f"{max(worst)}" if max(worst) <= LONGEST else f"over {LONGEST}"
        rows.append((name, f"{fitting}", *at_random, *failed(worst, fitting, beta), most))
    return heading + text_tables.aligned(rows, numbers=True)


# -- whether an adaptive period pays -----------------------------------------------------------------------------------


ADAPTIVE: Final = 0.0
"""An updating period, s."""


def loop_cost(settings: Settings, name: str, period_s: float, run: Callable[[Scenario, Recorder], None]) -> float:
    """Return J_BF under a load, a named one or a file, with what runs a scenario."""
    model = lti_model.load(settings.model.file)
    profile = find_load(name, model.w0, settings.process)
    scenario = Scenario(natural_ticks(name, profile), profile, period_s, settings.plant.seed)
    recorder = Recorder(scenario.ticks)
    run(scenario, recorder)
    return evaluate(recorder.recording(), model, settings.optimizer_plc.program.design).J_BF


def require_costs(costs: ArrayLike) -> None:
    """Refuse costs of which a ratio would say nothing, those of loops in which nothing happens (`StudyError`)."""
    if not np.all(np.asarray(costs) > 0.0):
        raise StudyError(
            "under some load the loop costs nothing (J_BF is 0): with the inputs at rest all outputs stay in their "
            "bands. Give the process a load or disturbances that drive them out, or a setpoint where it does not rest"
        )


SHARES: Final = (0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
"""Updating periods that are compared unless one is given, as shares of the sampling period."""


def fixed_periods(process: declaration.Process) -> tuple[float, ...]:
    """Return the updating periods, s, that are compared."""
    ticks = sorted({round(share * process.ticks_per_sample) for share in SHARES})
    return tuple(each * process.tick_s for each in ticks if each >= updating_periods.SHORTEST_TICKS)


def adaptive_gain(
    settings: Settings, names: Sequence[str], period_s: float | None, done: Callable[[int, int], None]
) -> str:
    """Return, as a sentence, J_BF of the adaptive period over that of a fixed one under loads, named ones or files.

    The settings have the power of the PLC. Without `period_s` the fixed one is the best of `fixed_periods` in which an
    iteration fits, chosen on the same loads, which favours it. `done` takes the numbers of runs done and of all.
    """
    program = settings.optimizer_plc.program
    budget = PlcBudget(program.budget, program.iteration_s)
    periods = fixed_periods(settings.process)
    fitting = [period for period in periods if budget.times.holds(round(period / settings.process.tick_s))]
    fixed = fitting or [periods[-1]] if period_s is None else [period_s]
    rig, runs = OneProcessRig(settings), list(product((ADAPTIVE, *fixed), names))
    costs = []
    for number, (period, name) in enumerate(runs):
        done(number, len(runs))
        costs.append(loop_cost(settings, name, period, rig.run))
    best, ratio = over_best_fixed(np.array(costs).reshape(-1, len(names)))
    which = f"a fixed {fixed[best - 1]:g} s" + (", the best fixed one" if len(fixed) > 1 else "")
    loads = f"load{'s' if len(names) > 1 else ''} {', '.join(names)}"
    return f"With {loads} an adaptive period costs {ratio.text()} of {which}: {pays(ratio)}."


def over_best_fixed(costs: Array) -> tuple[int, Interval]:
    """Return which row is the best fixed period, and the cost of the first row, the adaptive one, over its.

    Costs have a row for each period, a column for each load. Raises StudyError: a loop costs nothing.
    """
    require_costs(costs)
    best = min(range(1, len(costs)), key=lambda which: geometric_mean(costs[which]))
    return best, mean_ratio(costs[0], costs[best])


def pays(ratio: Interval) -> str:
    """Return whether it does, in words; of costs, those of the adaptive period over others."""
    return ratio.in_words("it pays", "it does not pay", "one load has no interval; name several")
