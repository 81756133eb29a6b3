"""Stationary Kalman gains of plants of any kind, also of those that do not stay where they are."""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.process.cold_box import SAMPLING_PERIOD_S, TICK_S, TICKS_PER_SAMPLE
from coldloop_optimizer_plc.estimator import gains_after, is_stationary

Array = NDArray[np.float64]

LONGEST = 2000
ONE = np.ones(1)
INTEGRATING = np.zeros((1, 1))
unstable = st.floats(0.01, 1.5).map(lambda rate: np.array([[rate]]))
stiff = st.floats(-1.0, 1.5).map(lambda power: np.array([[-(10.0**power)]]))


@st.composite
def oscillating(draw: st.DrawFn) -> Array:
    """Draw a mode that is hardly damped, or well."""
    frequency, damping = draw(st.floats(0.1, 3.0)), 10.0 ** draw(st.floats(-3.0, 0.0))
    return frequency * np.array([[-damping, 1.0], [-1.0, -damping]])


class Plant(NamedTuple):
    """A plant with a load, whose states have sizes from 1e-3 to 1e3; rates are per sampling period."""

    A: Array
    """States and load after a sampling period, (n + 1, n + 1)."""
    C: Array
    drift: Array
    sensors: Array

    def gains(self) -> tuple[Array, Array]:
        """Return gain and inverse covariance in units of drift and sensors."""
        n = len(self.A)
        step = (np.ascontiguousarray(self.A[:-1, :-1]), self.A[:-1, -1])
        found = gains_after(
            {TICKS_PER_SAMPLE: step}, self.C, self.drift, self.sensors, of_time=False, periods=LONGEST,
            tick_s=TICK_S, sampling_period_s=SAMPLING_PERIOD_S,
        )[0]  # fmt: skip
        return (found[:, :n] / self.drift).T * self.sensors, found[:, n:] * np.outer(self.sensors, self.sensors)

    def scaled(self) -> tuple[Array, Array]:
        """Return A and C in the same units."""
        return self.A * self.drift / self.drift[:, None], self.C * self.drift / self.sensors[:, None]


@st.composite
def plants(draw: st.DrawFn) -> Plant:
    """Draw one to three modes of any kind, seen by one to three sensors."""
    modes = st.one_of(unstable, st.just(INTEGRATING), stiff, oscillating())
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rates = scipy.linalg.block_diag(*draw(st.lists(modes, min_size=1, max_size=3)))
    n, sensors = len(rates), draw(st.integers(1, 3))
    mixed = np.linalg.qr(rng.normal(size=(n, n)))[0] * 10.0 ** rng.uniform(-0.5, 0.5, n)
    of_time = np.block([[mixed @ rates @ np.linalg.inv(mixed), rng.normal(size=(n, 1))], [np.zeros((1, n + 1))]])
    sizes = np.append(10.0 ** rng.uniform(-3.0, 3.0, n), 1.0)
    return Plant(
        scipy.linalg.expm(of_time) * sizes[:, None] / sizes, rng.normal(size=(sensors, n + 1)) / sizes,
        10.0 ** rng.uniform(-1.0, 1.0, n + 1) * sizes, 10.0 ** rng.uniform(-2.0, 1.0, sensors),
    )  # fmt: skip


def is_detectable(A: Array, C: Array) -> bool:
    """Return whether the sensors show each mode that does not decay (Hautus' test)."""
    lasting = (mode for mode in np.linalg.eigvals(A) if abs(mode) > 1.0 - 1e-6)
    pencils = (np.vstack([A - mode * np.eye(len(A)), C]) for mode in lasting)
    return all(np.linalg.svd(pencil, compute_uv=False)[-1] > 1e-3 for pencil in pencils)


def compare(plant: Plant) -> None:
    """Compare with the solution of scipy, where errors of the estimate decay within hundreds of periods."""
    A, C = plant.scaled()
    assume(is_detectable(A, C))
    gain, inverse = plant.gains()
    left = A - A @ gain @ C
    assert np.abs(np.linalg.eigvals(left)).max() <= 1.0 + 1e-6
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, np.eye(len(A)), np.eye(len(C)))
    except (np.linalg.LinAlgError, ValueError):
        return
    expected_inverse = np.linalg.inv(C @ P @ C.T + np.eye(len(C)))
    expected = P @ C.T @ expected_inverse
    if np.abs(np.linalg.eigvals(A - A @ expected @ C)).max() < 0.99:
        assert (np.abs(gain - expected).max(axis=1) <= 1e-4 * np.abs(expected).max(axis=1)).all()
        assert np.abs(inverse - expected_inverse).max() <= 1e-5


@given(plants())
def test_gains_of_unstable_integrating_stiff_and_oscillating_plants(plant: Plant) -> None:
    compare(plant)


@pytest.mark.night
@settings(max_examples=3000)
@given(plants())
def test_gains_of_thousands_of_plants(plant: Plant) -> None:
    compare(plant)


def test_a_scalar_by_hand() -> None:
    """P = 4 P / (P + 1) + 1 has the solution 2 + sqrt(5)."""
    of_state = Plant(np.diag([2.0, 1.0]), np.array([[1.0, 0.0]]), np.ones(2), ONE)
    gain, inverse = of_state.gains()
    root = np.sqrt(5.0)
    assert gain[:, 0] == pytest.approx([(2.0 + root) / (3.0 + root), 0.0], abs=1e-10)
    assert inverse[0, 0] == pytest.approx(1.0 / (3.0 + root), rel=1e-10)


GROWING = np.array([[0.6, 0.5, 0.2], [0.0, -0.4, 0.3], [0.1, 0.0, -0.1]])
"""Per s: a stirred tank at the middle one of its three states, with 0.63, -0.44 and -0.09."""


def test_every_period_of_an_unstable_plant_has_its_own_solution() -> None:
    """Rounding that is not symmetric grew with the plant's mode from one period to the next, up to NaN."""
    of_ticks = {ticks: scipy.linalg.expm(GROWING * ticks * TICK_S) for ticks in range(1, TICKS_PER_SAMPLE + 1)}
    steps = {ticks: (A, A[:, 0] - np.eye(3)[:, 0]) for ticks, A in of_ticks.items()}
    C, drift, sensors = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([0.1, 0.2, 0.1, 0.05]), np.array([0.1])
    found = gains_after(steps, C, drift, sensors, of_time=False, periods=LONGEST, tick_s=TICK_S, sampling_period_s=5.0)
    for ticks, (step, load) in steps.items():
        A = np.eye(4)
        A[:3, :3], A[:3, 3] = step, load
        share = ticks * TICK_S / SAMPLING_PERIOD_S
        P = scipy.linalg.solve_discrete_are(A.T, C.T, np.diag(drift**2 * share), np.diag(sensors**2))
        inverse = np.linalg.inv(C @ P @ C.T + np.diag(sensors**2))
        gain, found_inverse = found[ticks - 1][:, :4].T, found[ticks - 1][:, 4:]
        assert gain == pytest.approx(P @ C.T @ inverse, rel=1e-5)
        assert found_inverse == pytest.approx(inverse, rel=1e-6)


def test_no_gain_where_the_recursion_diverges() -> None:
    """The second mode grows, and no sensor shows it but by rounding."""
    hidden = Plant(
        np.array([[0.5, 0.0, 0.0], [0.3, 3.0, 0.0], [0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 1.0]]), np.ones(3), ONE
    )
    with pytest.raises(
        ConfigurationError, match=r"^optimizer_plc.program.estimator: no stationary Kalman filter .* 5 s"
    ):
        hidden.gains()


def test_what_is_no_solution_is_recognised() -> None:
    A, C = np.diag([2.0, 0.5]), np.ones((1, 2))
    solution = scipy.linalg.solve_discrete_are(A.T, C.T, np.eye(2), np.eye(1))
    after = solution - solution @ C.T @ C @ solution / (C @ solution @ C.T + 1.0)
    twisted = np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert is_stationary(A, C, np.ones(2), ONE, after)
    for wrong in (2.0 * after, after + 1e6 * twisted, np.full((2, 2), np.nan)):
        assert not is_stationary(A, C, np.ones(2), ONE, wrong)
