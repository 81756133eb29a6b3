"""What is the same run is done once, and what is not is done."""

from typing import TYPE_CHECKING

import pytest

import coldloop_studies.execution
from coldloop_studies.execution import (
    Store,
    Workers,
    families,
    iteration_limit,
    never_cut_off,
    perform_all,
    same_run,
)
from coldloop_studies.request import Outcome, RunRequest, perform
from coldloop_studies.solver_comparison import throttled
from coldloop_studies.study import Load, StudyOptions, draw_of

if TYPE_CHECKING:
    from distributed import Client


@pytest.fixture
def load() -> Load:
    """Two and a half minutes with harsh steps."""
    return draw_of("e", 1, StudyOptions(ticks=1000))


@pytest.mark.usefixtures("compiles")
def test_a_solver_that_ends_by_itself_does_the_same_run_with_more_power(load: Load) -> None:
    """The claim that everything here rests on, for the solver that the study of powers runs from P = 7 on again."""
    at_7, at_25 = throttled(load, "qpoases", 7.0), throttled(load, "qpoases", 25.0)
    assert (iteration_limit(at_7), iteration_limit(at_25)) == (73, 263)
    more = Outcome.from_json(perform(at_25))
    assert 1 < max(more.updates["iterations"]) < 73
    assert same_run(at_7, [at_25], {at_25: more}) == at_25
    assert perform(at_7) == perform(at_25)


@pytest.mark.usefixtures("compiles")
def test_a_solver_that_is_cut_off_does_another_run(load: Load) -> None:
    at_1, at_25 = throttled(load, "qpoases", 1.0), throttled(load, "qpoases", 25.0)
    more = Outcome.from_json(perform(at_25))
    assert same_run(at_1, [at_25], {at_25: more}) is None
    assert perform(at_1) != perform(at_25)


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(
    ("iterations", "limit", "expected"),
    [([3.0, 9.0, 4.0], 10, "ended"), ([3.0, 10.0], 10, "cut off"), ([10.0], 11, "ended"), ([], 10, "cut off")],
)
def test_a_solve_that_took_all_it_had_may_have_been_cut_off(
    iterations: list[float], limit: int, expected: str, load: Load
) -> None:
    outcome = Outcome.from_json(perform(throttled(load, "daqp", 1.0)))
    outcome.updates["iterations"] = iterations
    assert never_cut_off(outcome, limit) is (expected == "ended")


def test_families_differ_by_power_alone(load: Load) -> None:
    powers = [throttled(load, solver, power) for solver in ("ode", "qpoases") for power in (1.0, 25.0, 7.0)]
    adaptive = load.request(0.0, "optimizer_plc.program.budget.power=2")
    on_the_bus = load.request(5.0, networked=True)
    interrupted = load.request(5.0, "optimizer_plc.program.interrupting_load_step_w=10")
    found = families([*powers, adaptive, on_the_bus, interrupted])
    assert found == [
        [powers[1], powers[2], powers[0]], [powers[4], powers[5], powers[3]], [adaptive], [on_the_bus], [interrupted],
    ]  # fmt: skip


def test_the_same_run_in_other_words_has_the_same_name(load: Load) -> None:
    asked = load.request(5.0)
    assert load.request(5.0, "optimizer_plc.program.solver=ode").digest == asked.digest
    assert RunRequest("other name", asked.times, asked.watts, asked.ticks, 5.0).digest == asked.digest
    assert load.request(5.0, "optimizer_plc.program.solver=osqp").digest != asked.digest


@pytest.mark.usefixtures("realtime")
def test_identical_runs_are_done_once(
    load: Load, client: "Client", store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    powers = (25.0, 1.0, 15.0, 7.0)
    asked = [throttled(load, "qpoases", power) for power in powers]
    begun: list[RunRequest] = []
    do = coldloop_studies.execution._done  # noqa: SLF001 what goes to the workers

    def watched(*arguments: object) -> object:
        for request in do(*arguments):  # type: ignore[arg-type]
            begun.append(request)
            yield request

    monkeypatch.setattr(coldloop_studies.execution, "_done", watched)
    outcomes = perform_all(asked, store, Workers(1, scheduler=client.scheduler.address), "test")
    assert begun == [asked[0], asked[1]]
    assert [outcomes[request].to_json() for request in asked] == [perform(request) for request in asked]
