"""Updates whose results are not finite, from gains that are wrong on purpose: no sequence, the ladder, and a word."""

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pyarrow.parquet
import pytest

import coldloop_optimizer_plc.program
from coldloop.registers.control_plc import Update, Verdict
from coldloop_optimizer_plc.estimator import Estimator
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_rig import cli, simulate
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import MemorySink, Recorder
from coldloop_rig.runs.running import make_scenario
from coldloop_rig.settings import Settings
from coldloop_studies.study import StudyResult
from tests.conftest import Coldloop
from tests.harness.records import as_transmitted

Break = Callable[[float], None]
OVERFLOW = 1e300
"""Gains that are so many times too large: the first innovation leads beyond all numbers."""
DIVERGING = 4.0
"""With these the estimate oscillates, and grows for some minutes."""


@pytest.fixture
def gains_times(monkeypatch: pytest.MonkeyPatch) -> Break:
    """Let the gains of all estimators be wrong by a factor."""
    right = coldloop_optimizer_plc.program.estimator_of

    def of(factor: float) -> None:
        def wrong(*arguments: object) -> Estimator:
            c = right(*arguments)  # type: ignore[arg-type]
            return c._replace(stationary=c.stationary._replace(gains=c.stationary.gains * factor))

        monkeypatch.setattr(coldloop_optimizer_plc.program, "estimator_of", wrong)

    return of


@pytest.mark.usefixtures("programs", "undrawn")
def test_a_run_without_answers_goes_down_the_ladder_and_says_so(
    coldloop: Coldloop, gains_times: Break, tmp_path: Path
) -> None:
    gains_times(OVERFLOW)
    done = coldloop("run", "--in-process", "--load", "a", "--duration", "5min", "--out", tmp_path / "run")
    assert done.code == 3, done.complaints
    summary = json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    failed = summary["failed_updates"]
    assert failed > 10
    assert f"{failed} of {failed + summary['updates']} updates have no answer" in done.complaints[-1]
    assert summary["complete"]
    updates, events = (
        pyarrow.parquet.read_table(tmp_path / "run" / f"{name}.parquet").to_pydict() for name in ("updates", "events")
    )
    assert updates["verdict"].count(Verdict.NO_ANSWER) == failed
    happened = set(zip(events["kind"], events["subject"], events["cause"], strict=True))
    assert ("alarm raised", "sequence rejected", "no answer") in happened
    assert ("mode", "classical", "hold expired") in happened


def test_after_an_update_without_an_answer_the_next_one_has_one(optimizer: OptimizerProgram) -> None:
    m = optimizer.constants.estimator
    at = tuple(m.u0.tolist())
    first = Update(1, 0, 0, 0, m.w0, at, at, tuple(m.y0.tolist()), tuple(m.x0[:28].tolist()))
    plan = optimizer.plan(first)
    optimizer.state.belief.x[5] = float("nan")
    failed = optimizer.solve()
    assert (failed.header.length, failed.rows) == (0, [])
    report = as_transmitted(optimizer.report(Verdict.NO_ANSWER))
    assert report.j_delivered != report.j_delivered
    plan = optimizer.plan(first._replace(update=1, tick=plan.next_update_tick))
    sequence = optimizer.solve()
    assert sequence.header.number > failed.header.number
    assert len(sequence.rows) == sequence.header.length > 0
    assert optimizer.report(Verdict.ACCEPTED).j_delivered < 2.0


@pytest.mark.usefixtures("compiles")
def test_the_next_sequence_begins_where_the_rest_of_the_one_before_has_led(gains_times: Break) -> None:
    """After 15 ticks its next sampling period is still to come, amid the period without an answer."""
    gains_times(DIVERGING)
    updates = simulate("e", updating_period=3.75, duration_s=1800).recording.updates
    verdicts = [update.verdict for update in updates]
    after = [later for before, later in pairwise(verdicts) if before == Verdict.NO_ANSWER]
    assert len(after) > 5
    assert set(after) == {Verdict.ACCEPTED}


@pytest.fixture
def optimizer() -> OptimizerProgram:
    settings = Settings()
    rig = OneProcessRig(settings, compiled=False)
    rig.optimizer.restart(0.0)
    return rig.optimizer


@pytest.mark.usefixtures("compiles")
def test_a_compiled_stretch_ends_where_there_is_no_answer(gains_times: Break) -> None:
    gains_times(DIVERGING)
    settings, found = Settings(), []
    scenario: Scenario = make_scenario(settings, 2400)
    for compiled in (True, False):
        sink = MemorySink()
        recorder = Recorder(scenario.ticks, [sink])
        OneProcessRig(settings, compiled=compiled).run(scenario, recorder)
        recorder.close()
        recording = sink.recording(recorder.link)
        found.append((recording.trace_sha256, [*map(repr, recording.updates)]))
        assert any(update.verdict == Verdict.NO_ANSWER for update in recording.updates)
    assert found[0] == found[1]


def test_a_study_with_such_runs_ends_with_three(
    coldloop: Coldloop, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("coldloop_studies.execution.conduct", lambda *_: StudyResult((), [], {}, failed_runs=2))
    done = coldloop("study", "periods", "--quick", "--out", tmp_path)
    assert done.code == 3
    assert done.complaints == ["coldloop: in 2 runs updates have no answer: what the optimiser computed is not finite"]
    assert "3 not finite" in str(cli.main.__doc__)
