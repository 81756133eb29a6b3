"""What studies make of outcomes, each value computed by hand from outcomes that no run has given."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from coldloop.process.cold_box import STATION_SIGNAL_NAMES
from coldloop.registers.common import AlarmKind, EventKind
from coldloop.registers.control_plc import Mode
from coldloop_studies.reference_plc import SLOW_DOWN, SPEED
from coldloop_studies.refrigerator import PLANTS
from coldloop_studies.reproduction import STUDIES
from coldloop_studies.request import Happening
from coldloop_studies.solver_comparison import measures
from coldloop_studies.study import Load, Outcomes, StudyOptions, StudyResult
from coldloop_studies.trajectories import (
    furthest_outside,
    iterations_by_event,
    load_steps,
    share_falling,
    won_and_lost,
)

if TYPE_CHECKING:
    from coldloop_studies.request import Outcome
    from tests.studies.conftest import MakeOutcome

TICKS = 8


def courses(**changed: list[float]) -> dict[str, list[float]]:
    """Return time courses of 2 s with everything at rest."""
    rest = {
        "load": 385.0,
        "L1": 60.0,
        "T5": 12.0,
        "T9": 80.0,
        "CV155": 43.0,
        "NCR22_A": 75.0,
        "CV156": 36.0,
        "cost": 1.0,
    }
    return {"time_s": [0.25 * k for k in range(TICKS)], **{k: [v] * TICKS for k, v in rest.items()}, **changed}


def evaluated(name: str, options: StudyOptions, outcomes: "list[Outcome]") -> StudyResult:
    """Return what a study makes of outcomes, which are those of its requests in their order."""
    study = STUDIES[name]
    asked = list(dict.fromkeys(study.requests(options)))
    given: Outcomes = dict(zip(asked, outcomes, strict=True))
    return study.evaluate(options, given)


# -- events -----------------------------------------------------------------------------------------------------------


def test_a_load_step_is_where_the_load_changes(stepped: Load) -> None:
    assert load_steps(stepped).tolist() == [-math.inf, 400, 1600]


def test_iterations_after_a_step_are_those_of_30_s_and_in_quiet_those_after_2_min(
    stepped: Load, made_up: "MakeOutcome"
) -> None:
    ticks = [0, 399, 400, 519, 520, 879, 880, 1599, 1600]
    done = [1, 3, 10, 20, 900, 900, 5, 7, 60]
    after, quiet = iterations_by_event(made_up({"tick": ticks, "iterations": done}), stepped)
    assert after == (10 + 20 + 60) / 3
    assert quiet == (1 + 3 + 5 + 7) / 4


def test_furthest_outside_is_the_largest_miss_of_any_band(made_up: "MakeOutcome") -> None:
    def furthest(level: list[float], temperature: list[float]) -> float:
        return furthest_outside(made_up(trace={"L1": level, "T5": temperature}))

    assert furthest([60.0, 58.2, 61.5], [8.7, 12.0, 16.2]) == pytest.approx(0.8)
    assert furthest([60.0, 59.5], [8.75, 18.5]) == pytest.approx(2.5)
    assert furthest([59.0, 61.0], [9.0, 16.0]) == 0.0


# -- trajectories -----------------------------------------------------------------------------------------------------


def test_unlimited_qpoases_is_judged_by_its_bands_and_its_iterations(
    under: StudyOptions, made_up: "MakeOutcome"
) -> None:
    run = made_up(
        {"tick": [0, 400, 420, 1000], "iterations": [1, 9, 3, 1], "tau_u": [20] * 4},
        courses(L1=[60.0] * 7 + [61.75]), outside_band_pct={"L1": 12.5, "T5": 4.0}, J_BF=3.0,
    )  # fmt: skip
    assert evaluated("unlimited", under, [run]).values == {
        "unlimited: furthest outside": [0.75],
        "unlimited: time outside": [12.5],
        "unlimited: iterations": [6.0],
    }


def test_limited_solvers_are_judged_against_the_unlimited_one(under: StudyOptions, made_up: "MakeOutcome") -> None:
    ode, limited, unlimited = (
        made_up({"tick": [0, 400], "iterations": [1, 1], "tau_u": [20, 20]}, courses(), J_BF=cost)
        for cost in (11.0, 15.0, 10.0)
    )
    assert evaluated("limited", under, [limited, unlimited]).values == {"limited: J_BF": [1.5]}
    assert evaluated("trajectories", under, [ode, limited, unlimited]).values == {
        "trajectories: J_BF": [1.1],
        "trajectories: J_BF of qpOASES over ODE": [pytest.approx(15 / 11)],
    }


# -- baselines --------------------------------------------------------------------------------------------------------


def test_the_classical_loops_are_compared_with_2_5_s(under: StudyOptions, made_up: "MakeOutcome") -> None:
    result = evaluated("classical", under, [made_up(J_BF=cost) for cost in (60.0, 4.0, 5.0)])
    assert result.values == {"J_BF of the classical loops over MPC at 2.5 s": [15.0]}


def test_single_precision_is_judged_by_its_cost_and_by_the_largest_difference_of_each_input(
    under: StudyOptions, made_up: "MakeOutcome"
) -> None:
    double = made_up(trace=courses(), J_BF=200.0)
    single = made_up(
        trace=courses(CV155=[43.0] * 7 + [42.5], NCR22_A=[75.0, 78.0] + [75.0] * 6, CV156=[36.0] * 8), J_BF=199.0
    )
    assert evaluated("single-precision", under, [double, single]).values == {
        "change of J_BF in single precision": [pytest.approx(-0.005)],
        "largest difference of CV155 (%) in single precision": [0.5],
        "largest difference of NCR22_A (W) in single precision": [3.0],
        "largest difference of CV156 (%) in single precision": [0.0],
    }


# -- winning and losing ----------------------------------------------------------------------------------------------


def test_what_a_period_wins_and_loses_counts_right_after_load_steps(
    under: StudyOptions, stepped: Load, made_up: "MakeOutcome"
) -> None:
    """E = J+ - J-hat and D = J+ - J; the steps are at ticks 400 and 1600, and other updates say nothing."""

    def run(delivered: tuple[float, float], effective: tuple[float, float]) -> "Outcome":
        return made_up({
            "tick": [0, 396, 400, 404, 1604], "j_hot_start": [9.0, 9.0, 100.0, 9.0, 50.0],
            "j_delivered": [0.0, 0.0, delivered[0], 0.0, delivered[1]],
            "j_effective": [0.0, 0.0, effective[0], 0.0, effective[1]],
        })  # fmt: skip

    falls, rises, mixed = (
        run((40.0, 10.0), (70.0, 30.0)),
        run((90.0, 45.0), (50.0, 20.0)),
        run((40.0, 45.0), (70.0, 20.0)),
    )
    assert won_and_lost(falls, stepped) == (50.0, 25.0), "E = 60 and 40, D = 30 and 20"
    assert [share_falling(one, stepped) for one in (falls, rises, mixed)] == [1.0, 0.0, 0.5]
    # ODE, qpOASES, fast gradient and OSQP at 1, 2.5 and 5 s
    result = evaluated("trade-off", under, [falls, rises, mixed, rises, rises, mixed, *[falls] * 6])
    assert result.values == {
        "share of load steps after which E > D at 1 s: ODE less qpOASES": [1.0],
        "share of load steps after which E > D at 5 s less that at 1 s: qpOASES": [0.5],
    }
    assert [row[-1] for row in result.rows[:6]] == [1.0, 0.0, 0.5, 0.0, 0.0, 0.5]


@pytest.mark.parametrize(("name", "runs"), [("single-precision", 2), ("trade-off", 20)])
def test_all_draws_are_taken(name: str, runs: int) -> None:
    asked = STUDIES[name].requests(StudyOptions(seeds=3))
    assert len(asked) == 3 * runs
    assert {request.draw for request in asked} == {1, 2, 3}


# -- the refrigerator -------------------------------------------------------------------------------------------------


def station(**changed: list[float]) -> dict[str, list[float]]:
    rest = dict.fromkeys((*STATION_SIGNAL_NAMES, "mode", "alarms"), [0.0] * TICKS)
    return {**courses(), **rest, **changed}


def test_each_refrigerator_is_compared_with_the_cold_box_alone(under: StudyOptions, made_up: "MakeOutcome") -> None:
    alone = made_up(trace=courses(), J_BF=4.0)
    moving = station(P12=[14.0, 16.25] * 4, E_NC=[700.0, 720.0] * 4, M_GN2=[20.0] * 8)
    others = [made_up(trace=moving, J_BF=cost) for cost in (6.0, 8.0, 5.0)]
    result = evaluated("coupling", under, [alone, *others])
    names = list(PLANTS)[1:]
    assert result.values == {
        f"J_BF on the {name}, over the cold box alone": [ratio]
        for name, ratio in zip(names, (1.5, 2.0, 1.25), strict=True)
    }
    assert [row[6] for row in result.rows] == ["-", *["14.00..16.25"] * 3]
    assert [row[9] for row in result.rows] == ["-", 710.0, 710.0, 710.0]


def test_what_happens_to_a_refrigerator_is_told_by_its_ranges_modes_and_alarms(
    under: StudyOptions, made_up: "MakeOutcome"
) -> None:
    run = made_up(trace=station(mode=[1.0] * 8, alarms=[0.0] * 7 + [1.0], lost=[0.0] * 7 + [0.125]), J_BF=7.0)
    happened = [
        ("control_plc", 0, EventKind.MODE, Mode.HOLD), ("control_plc", 8, EventKind.MODE, Mode.MPC),
        ("control_plc", 2400, EventKind.ALARM_RAISED, AlarmKind.CAPACITY),
        ("control_plc", 2500, EventKind.ALARM_RAISED, AlarmKind.FIRST_BAND),
        ("control_plc", 2600, EventKind.ALARM_RAISED, AlarmKind.CAPACITY),
        ("plant", 2600, EventKind.ALARM_RAISED, AlarmKind.SECOND_BAND),
    ]  # fmt: skip
    run = replace(run, events=[Happening(*event) for event in happened])
    asked = STUDIES["disturbances"].requests(under)
    result = STUDIES["disturbances"].evaluate(under, dict.fromkeys(asked, run))
    assert len(result.rows) == len(asked) == 56
    assert {row[3] for row in result.rows} == {7.0}
    assert {row[10] for row in result.rows} == {0.125}
    assert len({row[11] for row in result.rows}) == 1
    assert "none" not in {row[12] for row in result.rows}
    assert {row[13] for row in result.rows} == {"hold 0 s, mpc 2 s"}
    assert {row[14] for row in result.rows} == {"capacity, level band"}


# -- solvers against power --------------------------------------------------------------------------------------------


def test_the_measures_of_the_solver_comparison() -> None:
    powers = np.array([0.2, 0.6, 1.0, 10.0, 25.0])
    table = {
        "qpoases": {
            "J_total": np.array([800.0, 100.0, 40.0, 4.2, 4.0]), "J_BF": np.array([30.0, 12.0, 9.0, 5.0, 5.2]),
            "c1": np.array([9.0, 8.0, 7.0, 1.0, 0.0]), "c2": np.array([0.9, 0.8, 0.7, 0.1, 0.0]),
        },
        "ode": {
            "J_total": np.array([12.0, 5.0, 4.8, 4.6, 4.4]), "J_BF": np.array([9.0, 7.0, 6.0, 5.5, 5.3]),
            "c1": np.array([6.0, 5.0, 4.0, 3.0, 2.0]), "c2": np.array([0.6, 0.5, 0.4, 0.3, 0.2]),
        },
    }  # fmt: skip
    found = measures(powers, table)
    expected = {
        "qpOASES over converged at P = 1": 10.0,
        "qpOASES over converged at P = 0.2": 200.0,
        "qpOASES from P = 10 on, largest distance from converged": 0.05,
        "qpOASES, largest rise of total cost with P": 4.0 / 4.2 - 1,
        "ODE over converged, largest from P = 0.6 on": 1.25,
        "qpOASES over ODE in total cost at P = 1": 40 / 4.8,
        "qpOASES over ODE in J_BF at P = 1": 1.5,
        "c1 of qpOASES at P = 1": 7.0,
        "c2 of qpOASES at P = 1": 0.7,
        "c1 of ODE at P = 1": 4.0,
        "c2 of ODE at P = 1": 0.4,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    # between P = 1 and 10 the logarithm of the ratio falls from ln(40 / 4.8) to ln(4.2 / 4.6): a straight line in ln P
    fall = math.log(40 / 4.8) / (math.log(40 / 4.8) - math.log(4.2 / 4.6))
    assert found["crossing in total cost"] == pytest.approx(10**fall)
    fall = math.log(1.5) / (math.log(1.5) - math.log(5.0 / 5.5))
    assert found["crossing in J_BF"] == pytest.approx(10**fall)


# -- the reference PLC ------------------------------------------------------------------------------------------------


def test_the_speed_of_the_plc_by_hand() -> None:
    """A factorisation of size 100 has 338,450 operations and takes 3.38 n + 2.4 n^2 + 0.6 n^3 us = 0.624 s."""
    values = STUDIES["cholesky"].evaluate(StudyOptions(), {}).values
    assert values[SPEED] == pytest.approx([0.338450 / 0.624338], rel=0.01)
    assert 4000 < values[SLOW_DOWN][0] < 4400
    assert values["tau_1 of qpOASES by the paper's route (s)"] == pytest.approx([120e-6 * 4157], rel=1e-3)
    assert values["tau_1 of the ODE-based solver (s)"] == pytest.approx([115_964 / 0.529e6], rel=1e-3)
    # Phi of 700 variables in single precision is 1.96e6 of 2e6 bytes, and is not alone
    assert values["memory of the trivial problem over that of the PLC"][0] > 4 * 700**2 / 2e6 > 0.97
    assert values["memory of the reduced problem over that of the PLC"] == pytest.approx([237_268 / 2e6], rel=1e-3)
