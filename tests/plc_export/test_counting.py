"""Operations of an export, counted by executing it: those of the formulas of `coldloop budget`, and of its manifest."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.config import load_configuration
from coldloop_export.counting import CountedProgram, Counter, counted_iterations, counted_updates, counter_of
from coldloop_export.golden import ITERATIONS, SINGLE, GoldenVectors, OdeProgram
from coldloop_optimizer_plc.computing_settings import OdeSettings
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.ode import ode_solver
from coldloop_rig.plc_sizing import operations
from coldloop_rig.plc_sizing.budget import problem_of
from coldloop_rig.plc_sizing.operations import Operations, dense_sizes
from coldloop_rig.plc_sizing.plc import PlcProfile, cost_text, find_profile, misfits, read_cost
from coldloop_rig.settings import Settings
from tests.plc_export.recorded_optimizers import recorded_updates, recorder

if TYPE_CHECKING:
    from tests.conftest import Coldloop

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's of overflow: the kernels have none


@pytest.fixture(scope="module")
def counter(recorded: GoldenVectors) -> Counter:
    return Counter(recorded.method, recorded.vectors[0].problem)


@pytest.mark.usefixtures("compiles")
def test_what_is_counted_has_the_bits_of_the_kernels(recorded: GoldenVectors) -> None:
    vector = recorded.vectors[0]
    program = OdeProgram(recorded.method, vector.problem, np.arange(1, ITERATIONS + 1))
    points = np.zeros_like(vector.answer.points)
    costs, done = np.zeros_like(vector.answer.costs), np.zeros_like(vector.answer.iterations)
    counted = CountedProgram(program.functions)
    none = np.float32(np.inf), np.float32(np.inf)
    (guessed,) = counted[program.entry.name](
        recorded.method, vector.problem, vector.guess, program.counts, none, points, costs, done
    )
    assert guessed == vector.answer.guessed
    assert points.tobytes() == vector.answer.points.tobytes()
    assert costs.tobytes() == vector.answer.costs.tobytes()
    assert done.tolist() == vector.answer.iterations.tolist()


@pytest.mark.parametrize(("n", "m"), [(3, 5), (6, 9), (12, 20)])
def test_without_zeros_it_is_what_the_formulas_say_with_masks_and_products_of_constants(n: int, m: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.uniform(0.1, 1.0, (n, n))
    Phi, Gamma = ((root @ root.T + n * np.eye(n)).astype(np.float32), rng.uniform(0.1, 1.0, (m, n)).astype(np.float32))
    zero = np.zeros(n, np.float32)
    qp = QuadraticProblem(Phi, zero, Gamma, np.zeros(m, np.float32), zero, zero, 0.0)
    counter, sizes = Counter(ode_solver(OdeSettings()).method(qp), qp), dense_sizes(n, m, n)
    known = operations.product(sizes.Gamma).flops  # of the cost: that of the velocity before
    masks, products = n * (n + 1) // 2 + 2 * n, 2 * n  # of variables held; of two constants for each element
    beside = masks + products - known
    assert counter.unconstrained() == operations.ode(sizes, 0).flops + beside
    again = operations.gradient(sizes, m).plus(Operations(n)).flops  # at the point that a bound has moved
    assert counter.worst() == operations.ode(sizes, m).flops + beside + again


@pytest.mark.usefixtures("compiles")
@settings(deadline=None, max_examples=20)
@given(data=st.data())
def test_no_iteration_takes_more_than_the_worst(recorded: GoldenVectors, counter: Counter, data: st.DataObject) -> None:
    vector = data.draw(st.sampled_from(recorded.vectors))
    n, m = len(vector.guess), len(vector.problem.gamma)
    seed, tight, wide = data.draw(st.integers(0, 2**32)), data.draw(st.floats(0, 1)), data.draw(st.floats(1e-6, 1e3))
    rng = np.random.default_rng(seed)
    gamma = np.where(rng.random(m) < tight, -1e3, 1e3).astype(np.float32)
    guess = rng.normal(size=n).astype(np.float32)
    low, high = (np.float32(wide) * sign * rng.random(n).astype(np.float32) for sign in (-1, 1))
    found = counter.iterations(vector.problem._replace(gamma=gamma, low=low, high=high), guess)
    assert max(found) <= counter.worst()


@pytest.mark.usefixtures("compiles")
def test_the_count_of_the_budget_is_that_of_the_export(recorded: GoldenVectors) -> None:
    configured = load_configuration(Settings, environment={}, assignments=SINGLE).settings
    budget = counter_of(problem_of(configured)[0], configured.optimizer_plc.program)
    count = counted_iterations(recorded.method, recorded.vectors)
    assert (budget.unconstrained(), budget.worst()) == (count.unconstrained, count.worst) == (23_620, 152_711)
    assert count.recorded.least < count.unconstrained < count.recorded.mean < count.recorded.most < count.worst
    assert count.total == round(count.recorded.mean * len(recorded.vectors) * ITERATIONS)


@pytest.mark.usefixtures("compiles")
def test_updates_are_counted() -> None:
    found = counted_updates(recorder().optimizer, recorded_updates(60, "e"))
    assert set(found) == {"plan", "start", "finish"}
    assert all(0 < each.least <= each.mean <= each.most for each in found.values())


# -- manifest, budget, profile -----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(
    ("target", "call", "remedy"),
    [("st", "call", "give a call less work"), ("c", "call (iteration)", "set that higher")],
)
def test_an_export_says_what_does_not_fit_a_plc_and_the_budget_says_the_same(
    coldloop: "Coldloop", tmp_path: Path, target: str, call: str, remedy: str
) -> None:
    small = tmp_path / "small.toml"
    small.write_text('name = "small"\nsource = "a test"\nmemory_bytes = 9000\noperation_ns = 1e5\ncycle_s = 0.5\n')
    out = tmp_path / target
    assert coldloop("export", "plc", "--target", target, "--out", out, "--ticks", 600, "--plc", small).code == 0
    for folder in (out, out / "optimizer"):
        outcome = coldloop("budget", "--export", folder, "--plc", small)
        lines = [line for line in outcome.out.splitlines() if line.startswith("small: ")]
        assert sum("memory: it takes " in line for line in lines) == 1
        assert sum(f"a {call} takes up to " in line and line.endswith(remedy) for line in lines) == 1
        assert sum("the longest updating period is 5 s" in line for line in lines) == 1
        assert outcome.out in (folder / "README.md").read_text()
    found = json.loads((out / "manifest.json").read_text())["operations"]["iteration"]
    assert f"{found['worst']:,.0f}" in coldloop("budget").out


@pytest.mark.usefixtures("compiles")
def test_what_fits_is_said(recorded: GoldenVectors, tmp_path: Path) -> None:
    count = counted_iterations(recorded.method, recorded.vectors[:1]).recorded.model_dump(exclude_none=True)
    (tmp_path / "manifest.json").write_text(
        json.dumps({"variables": 49, "operations": {"iteration": count}, "bytes": {"constants": 5, "self-test": 10**9}})
    )
    cost, profile = read_cost(tmp_path), find_profile("schneider-tsx-p574634m")
    assert misfits(cost, profile) == []
    assert "it fits, in memory and time" in cost_text(cost, profile)


def test_the_times_of_a_self_test_are_the_profile_of_that_plc(coldloop: "Coldloop", tmp_path: Path) -> None:
    manifest = {"variables": 49, "operations": {}, "bytes": {"constants": 1000},
                "self_test": {"iterations": 160, "operations": 6_000_000}}  # fmt: skip
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    outcome = coldloop("budget", "--export", tmp_path, "--took", 12_000_000)
    profile = tmp_path / "our.toml"
    profile.write_text(outcome.out)
    found: PlcProfile = find_profile(str(profile))
    assert found.operation_ns == pytest.approx(2000)
    assert found.flops_per_s(49) == pytest.approx(6_000_000 / 12)
    assert "160 iterations" in found.source
    assert coldloop("budget", "--plc", profile).code == 0


def test_a_profile_needs_a_self_test_of_the_solver(coldloop: "Coldloop", tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"variables": 49, "operations": {}, "bytes": {}}')
    for arguments, complaint in (
        (("--export", tmp_path, "--took", 5), "has no self-test of the solver alone"),
        (("--export", tmp_path / "none"), "has no manifest of an export"),
        (("--took", 5), "--took: is of an export's self-test"),
    ):
        outcome = coldloop("budget", *arguments)
        assert outcome.code == 2
        assert complaint in outcome.complaints[0]
