"""The paired part of the solver comparison: profiles as they are played, the lowest cost, and what is made of them."""

from dataclasses import replace
from typing import TYPE_CHECKING

import daqp
import numpy as np
import pytest

from coldloop.errors import StudyError
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.lti_model import load as load_model
from coldloop.process.settings import SHIPPED_MODELS, InputLimits
from coldloop_optimizer_plc.computing_settings import QpoasesSettings
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.settings import ControlDesign, Preset, ProgramSettings, SolverName
from coldloop_optimizer_plc.solvers import make_solver
from coldloop_plant.load import find_load
from coldloop_rig.cosim.scenario import Scenario
from coldloop_studies.paired_run import (
    PlayedProfiles,
    ProblemSequence,
    equal_counts,
    harsh_run,
    paired_indicators,
    paired_run,
    problem_sequence,
)
from coldloop_studies.reproduction import STUDIES
from coldloop_studies.request import Outcome, perform
from coldloop_studies.solver_comparison import (
    LABELS,
    harsh_request,
    harsh_table,
    harsh_values,
    open_loop,
    open_loop_table,
    paired_request,
    powers_of,
    watch,
)
from coldloop_studies.study import StudyOptions, draw_of

if TYPE_CHECKING:
    from pathlib import Path

    from tests.studies.conftest import MakeOutcome


UNBOUNDED = 1e30


def with_solver(name: str) -> ProgramSettings:
    return ProgramSettings(preset=Preset.PAPER, solver=SolverName(name))


@pytest.fixture(scope="module")
def problem() -> PredictiveProblem:
    return PredictiveProblem(PredictionModel(load_model(SHIPPED_MODELS["cold-box"])), ControlDesign(), InputLimits())


@pytest.fixture(scope="module")
def profiles(problem: PredictiveProblem) -> PlayedProfiles:
    return PlayedProfiles(problem)


def situation(rng: np.random.Generator) -> QpParameters:
    """Return a state some kPa, % and K away, and any load and input in reach."""
    model = load_model(SHIPPED_MODELS["cold-box"])
    scale = np.full(len(model.x0), 1.0)
    scale[0], scale[1] = 2000.0, 1.0 / model.C[0, 1]
    return QpParameters(
        scale * rng.normal(size=len(scale)), float(rng.uniform(-150, 200)), rng.uniform([-8, -60, -8], [8, 60, 8])
    )


@pytest.fixture(scope="module")
def sequence() -> ProblemSequence:
    """The problems of five minutes of load e, the first load steps among them."""
    load = find_load("e", load_model(SHIPPED_MODELS["cold-box"]).w0, COLD_BOX)
    return problem_sequence(Scenario(1200, load, 5.0, seed=1), ())


# -- as played --------------------------------------------------------------------------------------------------------


def test_each_knot_is_moved_to_within_the_rate_of_the_one_before(
    problem: PredictiveProblem, profiles: PlayedProfiles
) -> None:
    """Knots at 1, 2, 4, 8, 16, 50 and 100 periods; CV155 moves by 0.5 % a period, 0.05 when scaled by 10 %."""
    qp = problem.at(QpParameters(np.zeros(28), 0.0, np.zeros(3)))
    knots = np.zeros((7, 3))
    knots[:, 0] = [0.05, 0.30, 0.30, 0.05, 0.05, 2.0, 2.0]
    knots[:, 1] = [0.1, 0.5, 0.5, -5.0, -1.0, 0.0, 0.0]  # the heater moves by 10 W a period, 0.2 when scaled by 50 W
    z = np.concatenate([knots.ravel(), np.ones(28)])
    played = profiles.played(qp, z)
    found = played[:21].reshape(7, 3)
    assert found[:, 0] == pytest.approx([0.05, 0.10, 0.20, 0.05, 0.05, 1.75, 2.0])
    assert found[:, 1] == pytest.approx([0.1, 0.3, 0.5, -0.3, -1.0, 0.0, 0.0])
    assert (played[21:] == 0).all()
    assert (z[21:] == 1).all(), "the profile that was handed in is not touched"


def test_for_ten_seconds_it_is_what_the_optimiser_sends(problem: PredictiveProblem, profiles: PlayedProfiles) -> None:
    rng = np.random.default_rng(41)
    for _ in range(20):
        qp = problem.at(situation(rng))
        z = np.clip(np.concatenate([rng.normal(size=21), np.zeros(28)]), qp.low, qp.high)
        assert problem.inputs(profiles.played(qp, z), 2) == pytest.approx(problem.inputs(z, 2), abs=1e-12)


def test_what_keeps_its_rates_is_played_as_it_is(problem: PredictiveProblem, profiles: PlayedProfiles) -> None:
    rng = np.random.default_rng(42)
    for _ in range(10):
        where = situation(rng)
        qp = problem.at(where)
        best = profiles.optimum(qp, where)
        assert profiles.played(qp, best) == pytest.approx(best, abs=1e-9)


# -- the lowest cost --------------------------------------------------------------------------------------------------


def lowest_by_daqp(problem: PredictiveProblem, qp: QuadraticProblem, where: QpParameters) -> float:
    """Minimise the played cost as one quadratic problem: a slack for each output, side and sample, 421 variables."""
    n, samples = problem.n_inputs, problem.design.horizon
    Y, y0 = problem.predicted.of_z[:n].T, problem.outputs(np.zeros(49), where).ravel()
    low, high, weight = (np.tile(row, samples) for row in problem.predicted.bands)
    m = len(Y)
    H = np.zeros((n + 2 * m, n + 2 * m))
    H[:n, :n] = 2.0 * problem.Phi[:n, :n]
    H[n:, n:] = np.diag(2.0 * np.concatenate([weight, weight]))
    f = np.concatenate([qp.phi[:n], np.zeros(2 * m)])
    one = np.eye(m)
    rates = qp.Gamma[56:, :n]
    rows = np.vstack([
        np.hstack([Y, -one, 0 * one]), np.hstack([-Y, 0 * one, -one]), np.hstack([rates, np.zeros((len(rates), 2 * m))])
    ])  # fmt: skip
    upper = np.concatenate([qp.high[:n], np.full(2 * m, UNBOUNDED), high - y0, y0 - low, qp.gamma[56:]])
    lower = np.concatenate([qp.low[:n], np.zeros(2 * m), np.full(len(rows), -UNBOUNDED)])
    _, found, flag, _ = daqp.solve(H, f, rows, upper, lower, np.zeros(len(upper), np.int32), primal_tol=1e-9)
    assert flag == 1
    return float(found) + qp.constant


def test_the_lowest_cost_is_that_of_one_large_quadratic_problem(
    problem: PredictiveProblem, profiles: PlayedProfiles
) -> None:
    rng = np.random.default_rng(43)
    for _ in range(3):
        where = situation(rng)
        qp = problem.at(where)
        found = profiles.cost(qp, profiles.optimum(qp, where), where).total
        assert found == pytest.approx(lowest_by_daqp(problem, qp, where), rel=1e-7)


def test_no_profile_that_can_be_played_costs_less(problem: PredictiveProblem, profiles: PlayedProfiles) -> None:
    rng = np.random.default_rng(44)
    for _ in range(20):
        where = situation(rng)
        qp = problem.at(where)
        best = profiles.optimum(qp, where)
        lowest = profiles.cost(qp, best, where).total
        for size in (1e-6, 1e-3, 0.1, 1.0):
            other = np.clip(best + size * rng.normal(size=49), qp.low, qp.high)
            assert profiles.cost(qp, other, where).total >= lowest * (1 - 1e-12)


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", [name.value for name in SolverName])
@pytest.mark.parametrize("power", [0.2, 10.0])
def test_no_solver_at_any_power_gets_below_the_lowest_cost(name: str, power: float, sequence: ProblemSequence) -> None:
    program = with_solver(name)
    budget = program.budget.model_copy(update={"power": power, "preparation_slots": 0})
    columns = paired_run(sequence, program.model_copy(update={"budget": budget}))
    total, lowest = np.array(columns["j_dev"]) + np.array(columns["j_cst"]), np.array(columns["lowest"])
    assert len(total) == len(sequence.recorded) == 59
    assert (total >= lowest - 1e-9 * (1 + lowest)).all()
    if name in ("qpoases", "daqp") and power == 10.0:
        assert total.sum() < 1.02 * lowest.sum(), "a converged solver is near it: its slacks bend at the knots only"


# -- what a solver is given, and what is kept of it --------------------------------------------------------------------


@pytest.mark.usefixtures("compiles")
def test_a_solver_starts_each_problem_from_its_own_last_profile(sequence: ProblemSequence) -> None:
    """Replayed here, solver, shifts and costs by hand."""
    program = ProgramSettings(
        preset=Preset.PAPER,
        solver=SolverName.INTERIOR_POINT,
        budget=ProgramSettings().budget.model_copy(update={"power": 0.2, "preparation_slots": 0}),
    )
    columns = paired_run(sequence, program)
    solver, z = make_solver(program), np.zeros(49)
    for row, (where, _) in enumerate(sequence.recorded[:20]):
        qp = sequence.problem.at(where)
        answer = solver.solve(qp, sequence.problem.shifted(z, 20), (5,))
        assert columns["iterations"][row] == answer.iterations[-1], "5 s at P = 0.2 over 0.17 s"
        z = answer.z
        cost = sequence.profiles.cost(qp, z, where)
        assert (columns["j_dev"][row], columns["j_cst"][row]) == (cost.j_dev, cost.j_cst)


def test_equal_plc_times_hold_these_iterations() -> None:
    program = ProgramSettings()
    counts = {name: tuple(equal_counts(program, make_solver(with_solver(name))).values()) for name in SolverName}
    # 0.34, 0.68, 1.02 and 1.36 s over 0.25, 0.475, 0.05, 0.03, 0.17 and 4.75 s
    assert counts == {
        "ode": (1, 2, 4, 5), "qpoases": (0, 1, 2, 2), "osqp": (6, 13, 20, 27), "fast-gradient": (11, 22, 34, 45),
        "interior-point": (2, 4, 6, 8), "hybrid": (1, 2, 4, 5), "daqp": (0, 0, 0, 0),
    }  # fmt: skip
    assert QpoasesSettings().tau_1_s == 0.475


@pytest.mark.usefixtures("compiles")
def test_on_harsh_problems_all_begin_at_the_same_guess(sequence: ProblemSequence) -> None:
    found = {name: harsh_run(sequence, with_solver(name)) for name in ("ode", "qpoases", "daqp")}
    assert len(found["ode"]["guess"]) >= 2, "the first load steps"
    assert found["ode"]["guess"] == found["qpoases"]["guess"] == found["daqp"]["guess"]
    assert found["daqp"]["after_8"] == found["daqp"]["guess"], "no solve of DAQP is as short"
    for columns in found.values():
        guess, lowest = np.array(columns["guess"]), np.array(columns["lowest"])
        assert (guess + 1 > 10 * (lowest + 1)).all()
        assert (np.array(columns["after_8"]) >= lowest * (1 - 1e-9)).all()


def test_indicators_of_problems_are_sums_and_means() -> None:
    found = paired_indicators(
        {
            "j_dev": [1.0, 3.0],
            "j_cst": [0.0, 8.0],
            "violation": [0.5, 0.1],
            "iterations": [3.0, 4.0],
            "lowest": [1.0] * 2,
        },
        5.0,
    )
    assert (found.J_dev, found.J_cst, found.J_open_mean, found.c1, found.c2) == (4.0, 8.0, 6.0, 0.5, 0.3)
    assert (found.tau_u_mean, found.iterations_total) == (5.0, 7)
    assert np.isnan(found.J_BF)


@pytest.mark.usefixtures("compiles")
def test_a_request_gives_the_problems_and_no_trace() -> None:
    load = draw_of("e", 1, StudyOptions(seeds=1, ticks=400))
    outcome = Outcome.from_json(perform(paired_request(load, "ode", 1.0)))
    assert len(outcome.column("lowest")) == 19
    assert outcome.trace == {}
    assert set(outcome.column("iterations")) == {20.0}
    harsh = Outcome.from_json(perform(harsh_request(load, "ode")))
    assert len(harsh.column("guess")) <= 19


# -- what is made of outcomes -----------------------------------------------------------------------------------------


def test_a_profile_below_the_optimum_ends_the_study(made_up: "MakeOutcome") -> None:
    run = made_up({"lowest": [1.0, 100.0]})
    watch(run, np.array([1.0 - 1e-10, 100.0 - 1e-8]), "rounding")
    with pytest.raises(
        StudyError, match=r"^ode at P = 1: problem 1 costs 99.9, less than the optimum of 100; "
    ) as caught:
        watch(run, np.array([1.0, 99.9]), "ode at P = 1")
    assert "\n" not in str(caught.value)


@pytest.fixture
def short() -> StudyOptions:
    """A quick study of two named draws."""
    return StudyOptions(loads=("e", "e@2"), ticks=120, quick=True)


def test_totals_are_pooled_before_they_are_divided(short: StudyOptions, made_up: "MakeOutcome") -> None:
    """Over lowest costs of 10 and 30, qpOASES costs 100 / P more, and the ODE-based solver always 10 more."""
    outcomes = {}
    for load, lowest in ((draw_of("e", 1, short), 10.0), (draw_of("e@2", 1, short), 30.0)):
        for solver in LABELS:
            for power in powers_of(solver, short):
                cost = lowest + 10.0 if solver == "ode" else lowest + 100.0 / power
                outcomes[paired_request(load, solver, power)] = made_up(
                    {"j_dev": [cost - 1.0], "j_cst": [1.0], "lowest": [lowest]},
                    J_dev=cost - 1.0,
                    J_cst=1.0,
                    c1=0.5,
                    c2=0.25,
                )
    found = open_loop(short, outcomes)
    assert found.over_lowest("ode", 0.2, [0, 1]) == 1.5, "60 / 40"
    assert found.over_lowest("qpoases", 1.0, [0, 1]) == 6.0, "(110 + 130) / 40"
    # without one draw or the other the excess is 10 / 30 and 10 / 10, a factor of 3 apart; t = 12.7
    factor = 3 ** (12.7062 / 2)
    assert found.interval("ode", 0.2) == pytest.approx((1.5, 1 + 0.5 / factor, 1 + 0.5 * factor), rel=1e-4)
    # between P = 1 and 25 the ratio to the ODE-based solver falls from 240 / 60 to 48 / 60
    share = np.log(4.0) / (np.log(4.0) - np.log(0.8))
    assert found.crossing("qpoases", "ode").value == pytest.approx(25**share)
    text = open_loop_table(found)
    assert "| ODE | 1.5 [1 to 538.2] |" in text
    assert "qpOASES costs no more than ODE from P = " in text


def test_harsh_problems_of_all_loads_are_counted_together(short: StudyOptions, made_up: "MakeOutcome") -> None:
    outcomes = {}
    for name, ratios in (("e", [1.0, 2.0]), ("e@2", [9.0])):
        for solver in LABELS:
            columns = {"lowest": [10.0] * len(ratios), "guess": [500.0] * len(ratios)}
            for k in (2, 4, 6, 8):
                columns |= {f"count_{k}": [float(k)] * len(ratios), f"after_{k}": [10.0 * ratio for ratio in ratios]}
            outcomes[harsh_request(draw_of(name, 1, short), solver)] = made_up(columns)
    text = harsh_table(short, outcomes)
    assert text.startswith("**Harsh problems**: 3 problems of 2 hours")
    assert "| interior point | 2 (9) [2] | 2 (9) [4] | 2 (9) [6] | 2 (9) [8] |" in text
    values = harsh_values({"ode": {2: np.array([1.0, 2.0, 9.0])}})
    assert values == {
        "J over the lowest of harsh problems, median: ODE, in the time of 2 interior-point iterations": [2.0],
        "J over the lowest of harsh problems, worst: ODE, in the time of 2 interior-point iterations": [9.0],
        "number of harsh problems": [3.0],
    }


@pytest.mark.usefixtures("compiles")
def test_a_short_study_from_requests_to_report() -> None:
    study, options = STUDIES["solver-comparison"], StudyOptions(loads=("e",), ticks=600, quick=True)
    outcomes = {request: Outcome.from_json(perform(request)) for request in study.requests(options)}
    result = study.evaluate(options, outcomes)
    assert set(result.figures) == {"indicators", "paired open loop"}
    assert {row[0] for row in result.rows} == {"paired", "closed"}
    assert all(row[-1] >= 1 - 1e-9 for row in result.rows if row[0] == "paired")
    assert len(result.values["crossing in total cost"]) == len(result.values["crossing in J_BF"]) == 1
    assert [remark.splitlines()[0][:9] for remark in result.remarks] == ["**Paired,", "**Harsh p"]


@pytest.mark.usefixtures("compiles")
def test_under_a_load_that_never_steps_nothing_is_compared_and_nothing_fails(tmp_path: "Path") -> None:
    (tmp_path / "quiet.csv").write_text("time_s,load_w\n0,384.74\n")
    study, options = STUDIES["solver-comparison"], StudyOptions(loads=(f"{tmp_path}/quiet.csv",), ticks=240, quick=True)
    outcomes = {request: Outcome.from_json(perform(request)) for request in study.requests(options)}
    result = study.evaluate(options, outcomes)
    assert result.values["number of harsh problems"] == [0.0]
    assert result.remarks[1] == "No problem was harsh."
    assert "At no power does qpOASES cost as little as ODE" in result.remarks[0]


def test_draws_are_the_studys_own_unless_the_command_says() -> None:
    usual, asked, quick = StudyOptions(), StudyOptions(seeds=2), StudyOptions(quick=True)
    assert [len(options.drawn(10)) for options in (usual, asked, quick)] == [10, 2, 1]
    assert [len(options.draws) for options in (usual, asked, replace(asked, quick=True))] == [3, 2, 1]
