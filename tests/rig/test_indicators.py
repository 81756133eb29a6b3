"""The indicators of a run, computed by hand: costs of what was reached, of what was predicted, bands and periods."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.process.cold_box import L1, STATE_NAMES, T5
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.settings import SHIPPED_MODELS
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import Optimization
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.results.recording import Indicators, RunEvaluation, SampleBlock, StageCost

DESIGN = ControlDesign()
PRESSURE, VOLUME, FIRST_TEMPERATURE = 0, 1, 2


@pytest.fixture(scope="module")
def model() -> LtiModel:
    return load(SHIPPED_MODELS["cold-box"])


def at_rest(model: LtiModel, ticks: int) -> SampleBlock:
    """Return ticks at the operating point, the level at 60 % and T5 in its band."""

    def rows(value: NDArray[np.float64]) -> NDArray[np.float32]:
        return np.tile(value.astype(np.float32), (ticks, 1))

    block = SampleBlock(0, np.full(ticks, model.w0, np.float32), rows(model.u0), rows(model.y0), rows(model.x0))
    block.y[:, L1], block.y[:, T5] = 60.0, 12.0
    return block


def update(tick: int, tau_u: int, j_dev: float, j_cst: float = 0.0, violation: float = 0.0) -> Optimization:
    """Return an update of which only what indicators read has a meaning; it did 5 iterations."""
    costs = dict.fromkeys(
        ("j_effective", "j_hot_start", "j_delivered", "efficiency", "mismatch", "contraction", "gamma"), math.nan
    )
    return Optimization(
        update=tick, tick=tick, tau_u=tau_u, q=5, iterations=5, verdict=Verdict.ACCEPTED, j_dev=j_dev, j_cst=j_cst,
        violation=violation, load_mismatch=0.0, **costs,
    )  # fmt: skip


def evaluated(model: LtiModel, block: SampleBlock, *updates: Optimization) -> Indicators:
    evaluation = RunEvaluation(model, DESIGN)
    evaluation.block(block)
    for each in updates:
        evaluation.update(each)
    return evaluation.indicators


# -- what was reached -------------------------------------------------------------------------------------------------


def test_at_the_operating_point_nothing_costs_anything(model: LtiModel) -> None:
    assert StageCost(model, DESIGN).of(at_rest(model, 3)) == pytest.approx([0.0] * 3, abs=1e-9)


def test_deviations_cost_what_their_weights_say(model: LtiModel) -> None:
    block = at_rest(model, 8)
    block.x[0, PRESSURE] += 2000.0  # one unit of pressure: Q = 0.1
    block.x[1, VOLUME] += 1.0 / model.C[L1, VOLUME]  # as much liquid as 1 % of level: 0.1
    block.x[2, FIRST_TEMPERATURE] += 1.0  # one of the 26 temperatures: 0.1 / 26
    block.x[3, FIRST_TEMPERATURE:] += 2.0  # all of them by 2 K: 0.1 * 2^2
    block.u[4, 0] += 10.0  # CV155: 10^2 / 10^2
    block.u[5, 1] -= 50.0  # the heater: 50^2 / 50^2
    block.u[6, 2] += 5.0  # CV156: 5^2 / 10^2
    cost = StageCost(model, DESIGN).of(block)
    assert len(STATE_NAMES) == 28
    assert cost == pytest.approx([0.1, 0.1, 0.1 / 26, 0.4, 1.0, 1.0, 0.25, 0.0], rel=1e-4, abs=1e-9)


def test_outside_its_band_an_output_costs_a_hundred_times_the_square_of_the_distance(model: LtiModel) -> None:
    block = at_rest(model, 6)
    block.y[:, L1] = [58.5, 59.0, 60.0, 61.0, 61.25, 60.0]  # below by 0.5 %, above by 0.25 %
    block.y[5, T5] = 8.0  # below by 1 K
    cost = StageCost(model, DESIGN).of(block)
    assert cost == pytest.approx([25.0, 0.0, 0.0, 0.0, 6.25, 100.0], abs=1e-4)


def test_j_bf_sums_over_sampling_periods_and_bands_count_ticks(model: LtiModel) -> None:
    block = at_rest(model, 40)  # 10 s: two sampling periods
    block.y[:10, L1] = 61.5  # 2.5 s at a cost of 25
    block.y[36:, T5] = 18.0  # 1 s at a cost of 400
    found = evaluated(model, block)
    assert pytest.approx((10 * 25.0 + 4 * 400.0) / 20) == found.J_BF
    assert found.outside_band_pct == {"L1": 25.0, "T5": 10.0}


def test_on_the_edge_of_a_band_is_inside(model: LtiModel) -> None:
    block = at_rest(model, 4)
    block.y[:, L1] = [59.0, 61.0, 58.999, 61.001]
    block.y[:, T5] = [9.0, 16.0, 9.0, 16.001]
    found = evaluated(model, block)
    assert found.outside_band_pct == {"L1": 50.0, "T5": 25.0}


def test_ticks_of_which_nothing_is_known_count_neither_as_inside_nor_as_outside(model: LtiModel) -> None:
    block = at_rest(model, 8)
    block.y[0, L1] = 62.0
    for series in (block.load, block.u, block.y, block.x):
        series[4:] = np.nan
    found = evaluated(model, block)
    assert pytest.approx(100.0 / 20) == found.J_BF
    assert found.outside_band_pct["L1"] == 25.0, "one of the four that are known"
    assert found.outside_band_pct["T5"] == 0.0


# -- what was predicted -----------------------------------------------------------------------------------------------


def test_sums_run_over_the_problems_and_the_mean_over_time(model: LtiModel) -> None:
    """Three problems, delivered after 4, 10 and 20 ticks: they weigh as 4, 6 and 10."""
    found = evaluated(model, at_rest(model, 20), update(0, 4, 10.0, 1.0), update(4, 6, 20.0), update(10, 10, 5.0, 5.0))
    assert (found.J_dev, found.J_cst) == (35.0, 6.0)
    assert found.J_open_mean == pytest.approx((11.0 * 4 + 20.0 * 6 + 10.0 * 10) / 20)
    assert found.iterations_total == 15


def test_a_problem_after_an_interruption_weighs_by_the_time_lost_too(model: LtiModel) -> None:
    """The update at tick 4 was cut off at tick 7 and left no row: the one from there was delivered at tick 11."""
    found = evaluated(model, at_rest(model, 11), update(0, 4, 10.0), update(7, 4, 30.0))
    assert found.J_open_mean == pytest.approx((10.0 * 4 + 30.0 * 7) / 11)


def test_c1_is_the_largest_violation_and_c2_the_mean_over_the_problems(model: LtiModel) -> None:
    found = evaluated(
        model, at_rest(model, 12), update(0, 4, 1.0, violation=0.5), update(4, 4, 1.0, violation=3.0),
        update(8, 4, 1.0, violation=0.1),
    )  # fmt: skip
    assert found.c1 == 3.0
    assert found.c2 == pytest.approx(3.6 / 3)


def test_the_mean_period_is_that_over_time_and_the_one_per_update_is_beside_it(model: LtiModel) -> None:
    """A period of 5 s and five of 1 s: half of the time has the one, five of six updates the other."""
    updates = [update(0, 20, 1.0), *(update(20 + 4 * k, 4, 1.0) for k in range(5))]
    found = evaluated(model, at_rest(model, 40), *updates)
    assert found.tau_u_mean == 3.0
    assert found.tau_u_mean_per_update == pytest.approx(10 / 6)


@pytest.mark.parametrize("verdict", [Verdict.NO_ANSWER, Verdict.LATE, Verdict.NOT_INVITED, Verdict.NONE])
def test_an_update_without_an_answer_is_counted_and_adds_nothing_whatever_it_was_rejected_for(
    model: LtiModel, verdict: Verdict
) -> None:
    evaluation = RunEvaluation(model, DESIGN)
    for each in (update(0, 4, 10.0), update(4, 4, math.nan)._replace(verdict=verdict), update(8, 4, 5.0)):
        evaluation.update(each)
    assert (evaluation.updates, evaluation.failed_updates, evaluation.indicators.J_dev) == (2, 1, 15.0)


def test_what_does_not_exist_is_not_a_number(model: LtiModel) -> None:
    found = evaluated(model, at_rest(model, 4))
    of_updates = (found.J_dev, found.J_open_mean, found.c2, found.tau_u_mean, found.tau_u_mean_per_update)
    assert all(map(math.isnan, of_updates))
    nothing = RunEvaluation(model, DESIGN).indicators
    assert all(map(math.isnan, (nothing.J_BF, *nothing.outside_band_pct.values())))


def test_an_excess_within_the_dead_band_is_no_time_outside(model: LtiModel) -> None:
    block = at_rest(model, 8)
    block.y[:, L1] = [60.0, 61.0, np.nextafter(np.float32(61.0), np.float32(62.0)), 61.03, 61.5, 58.97, 58.5, np.nan]
    evaluation = RunEvaluation(model, DESIGN)
    evaluation.block(block)
    found = evaluation.excesses
    assert evaluation.indicators.outside_band_pct["L1"] == pytest.approx(100.0 * 5 / 8)
    assert found["L1_outside_dead_band_pct"] == pytest.approx(100.0 * 2 / 8)
    assert found["L1_largest_excess"] == pytest.approx(0.5)
    assert found["L1_excess_integral"] == pytest.approx(0.25 * (0.03 + 0.5 + 0.03 + 0.5), abs=1e-4)
    assert [found[name] for name in found if name.startswith("T5")] == [0.0, 0.0, 0.0]


def test_without_a_known_tick_there_is_no_excess(model: LtiModel) -> None:
    block = at_rest(model, 2)
    block.load[:] = np.nan
    evaluation = RunEvaluation(model, DESIGN)
    evaluation.block(block)
    assert all(math.isnan(value) for value in evaluation.excesses.values())
