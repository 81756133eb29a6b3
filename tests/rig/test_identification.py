"""Gains of the prediction model that are estimated from a record."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from coldloop.process.cold_box import INPUT_NAMES, L1, OUTPUT_NAMES, TICK_S, TICKS_PER_SAMPLE
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.model_file import read_header
from coldloop.process.settings import SHIPPED_MODELS
from coldloop_plant.cold_box.model import build_model
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.components.expansion import Valve
from coldloop_rig import cli
from coldloop_rig.results.run_folder import RunFolder
from coldloop_rig.runs.identification import (
    LEAST_S,
    Factor,
    Identification,
    Record,
    identify,
    read_record,
    responses,
    scaled,
)
from tests.conftest import draw_nothing

if TYPE_CHECKING:
    from tests.conftest import Coldloop, Outcome

Array = NDArray[np.float64]

TICKS: Final = round(LEAST_S / TICK_S)
HELD: Final = 400
"""Ticks between two moves."""
SIZES: Final = np.array([3.0, 40.0, 1.5, 40.0])
RATES: Final = np.array([0.01, 1.0, 0.005, np.inf])
TRUE: Final = np.array([0.85, 1.1, 0.93, 1.05])
SENSORS: Final = np.array([0.01, 1.0, *[0.02] * 10, *[1e-3] * 10])
NAMES: Final = (*INPUT_NAMES, "NCR22_HL")

Feedback = Callable[[float], float]


@pytest.fixture(scope="module")
def model() -> LtiModel:
    return load(SHIPPED_MODELS["cold-box"])


def with_gains(model: LtiModel, factors: Array, note: str = "") -> LtiModel:
    return scaled(model, tuple(Factor("", "", value, 0, 0, 0, "") for value in factors), note)


def wanderings(seed: int, sizes: Array = SIZES) -> Array:
    """Return deviations of inputs and load that move at their rates between three values, shape (TICKS, 4)."""
    steps = np.random.default_rng(seed).choice([-1.0, 0.0, 1.0], (TICKS // HELD, len(sizes))) * sizes
    moves, now = np.empty((TICKS, len(sizes))), np.zeros(len(sizes))
    for tick in range(TICKS):
        now = now + np.clip(steps[tick // HELD] - now, -RATES, RATES)
        moves[tick] = now
    return moves


def measured(plant: LtiModel, moves: Array, seed: int, heater: Feedback = lambda _: 0.0) -> Record:
    """Simulate a linear plant that begins away from rest, with white and slow noise and constant errors of its sensors.

    `heater` is added to the heater's moves; it is given the measured deviation of the level.
    """
    noise = np.random.default_rng(seed)
    x = np.concatenate([[500.0, 0.001], np.full(26, 0.5)])
    slow, before, applied, y = np.zeros(len(SENSORS)), moves[0], moves.copy(), np.empty((TICKS, len(SENSORS)))
    for tick in range(TICKS):
        slow = 0.99 * slow + 0.14 * noise.standard_normal(len(SENSORS))
        y[tick] = plant.C @ x + plant.D @ before[:3] + plant.G * before[3]
        y[tick] += SENSORS * (1.0 + slow + noise.standard_normal(len(SENSORS)))
        applied[tick, 1] += heater(y[tick, L1])
        before = applied[tick]
        x = plant.A_tick @ x + plant.B_tick @ before[:3] + plant.F_tick * before[3]
    return Record(applied + np.append(plant.u0, plant.w0), y + plant.y0, SENSORS)


def reasons(found: Identification) -> dict[str, str]:
    return {factor.name: factor.reason for factor in found.factors}


# -- the estimate ------------------------------------------------------------------------------------------------------


def test_gains_of_a_linear_plant_are_found_and_their_intervals_cover_them(model: LtiModel) -> None:
    plant, moves = with_gains(model, TRUE), wanderings(1)
    factors = [identify(model, measured(plant, moves, seed)).factors for seed in range(20)]
    assert all(not factor.reason for found in factors for factor in found)
    values, low, high = (np.array([[getattr(factor, name) for factor in found] for found in factors])
                         for name in ("value", "low", "high"))  # fmt: skip
    assert np.abs(values.mean(axis=0) - TRUE).max() < 0.02
    assert (high - low).max() < 0.25
    covered = ((low < TRUE) & (high > TRUE)).mean()
    assert 0.88 < covered < 1.0


def test_a_controller_that_reacts_to_noise_does_not_change_the_factors(model: LtiModel) -> None:
    plant = with_gains(model, TRUE)
    record = measured(plant, wanderings(2), 5, heater=lambda level: 50.0 * level)
    found = identify(model, record)
    assert found.improved
    for factor, true in zip(found.factors, TRUE, strict=True):
        standard_error = (factor.high - factor.value) / 2.365
        assert abs(factor.value - true) < 3.0 * standard_error, factor


def test_where_nothing_moves_nothing_is_fitted(model: LtiModel) -> None:
    found = identify(model, measured(model, np.zeros((TICKS, 4)), 1))
    assert not found.fitted
    assert not found.improved
    assert set(reasons(found).values()) == {"too little to tell"}
    assert [factor.value for factor in found.factors] == [1.0] * 4


def test_an_input_that_hardly_moves_keeps_its_gain_and_the_others_are_fitted(model: LtiModel) -> None:
    moves = wanderings(1, np.array([0.05, 40.0, 1.5, 40.0]))
    found = identify(model, measured(with_gains(model, TRUE), moves, 1))
    assert {name for name, reason in reasons(found).items() if reason} == {"CV155"}
    assert found.factors[0].value == 1.0
    assert found.factors[0].moved == pytest.approx(0.1, abs=0.06)
    assert "too little to tell" in found.factors[0].reason
    assert found.factors[1].value == pytest.approx(TRUE[1], abs=0.1)


def test_inputs_that_always_move_together_are_not_told_apart(model: LtiModel) -> None:
    moves = wanderings(1)
    moves[:, 3] = -moves[:, 1]  # heater and load act at the same place
    found = identify(model, measured(with_gains(model, TRUE), moves, 1))
    assert [name for name, reason in reasons(found).items() if reason.startswith("standard error")]
    assert not reasons(found)["CV155"]


def test_a_move_in_one_block_alone_is_not_believed(model: LtiModel) -> None:
    moves = wanderings(1)
    moves[:, 0] = 0.0
    moves[2340:2380, 0] = 3.0
    record = measured(with_gains(model, TRUE), moves, 1)
    assert reasons(identify(model, record))["CV155"].startswith("standard error")


# -- the file ----------------------------------------------------------------------------------------------------------


def test_a_scaled_model_is_another_model_that_says_where_it_comes_from(model: LtiModel, tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    with_gains(model, TRUE, "from a record").save(file)
    again = load(file)
    assert again.note == "from a record"
    assert again.digest == read_header(file).digest != model.digest
    assert np.array_equal(again.B, model.B * TRUE[:3])
    assert np.array_equal(again.F_tick, model.F_tick * TRUE[3])
    assert np.allclose(again.discretised(TICK_S).B, again.B_tick, rtol=1e-6, atol=1e-12)


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two seconds."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        draw_nothing(monkeypatch)
        assert cli.main(["run", "--in-process", "--duration", "2s", "--out", str(folder)]) == 0
    return folder


RunOf = Callable[[Record], Path]


@pytest.fixture
def run_of(recorded: Path, tmp_path: Path) -> RunOf:
    """Make the folder of a run with another trace."""

    def make(record: Record) -> Path:
        folder = Path(shutil.copytree(recorded, tmp_path / "run"))
        columns = dict(zip((*INPUT_NAMES, "load_w", *OUTPUT_NAMES), [*record.inputs.T, *record.y.T], strict=True))
        table = pa.table(
            {"time_s": np.arange(len(record.y)) * TICK_S}
            | {name: pa.array(column, pa.float32()) for name, column in columns.items()}
        )
        pq.write_table(table, folder / "trace.parquet")
        manifest = json.loads((folder / "manifest.json").read_text())
        (folder / "manifest.json").write_text(json.dumps(manifest | {"recorded_ticks": len(table)}))
        return folder

    return make


@pytest.mark.usefixtures("compiles")
def test_the_command_writes_a_model_to_be_looked_at(
    model: LtiModel, run_of: RunOf, coldloop: "Coldloop", tmp_path: Path
) -> None:
    run, file = run_of(measured(with_gains(model, TRUE), wanderings(1), 1)), tmp_path / "scaled.json"
    shown = coldloop("identify", run)
    assert shown.code == 0
    for name in NAMES:
        assert any(line.startswith(name) and line.endswith("fitted") for line in shown.out.splitlines()), shown.out
    assert "less than before" in shown.out

    outcome = coldloop("identify", run, "--out", file)
    assert outcome.code == 0
    assert outcome.out.startswith(shown.out)
    assert "nothing uses it" in outcome.out
    assert f"model.file={file}" in outcome.out
    written = load(file)
    assert written.B[0] / model.B[0] == pytest.approx(TRUE[:3], abs=0.1)
    assert model.digest[:12] in written.note
    assert written.note in coldloop("model", "--set", f"model.file={file}").out

    again = coldloop("identify", run, "--out", file)
    assert again.code == 2
    assert "exists" in again.complaints[0]

    looked_at = coldloop("identify", run, "--model", file)
    assert any("1.0" in line for line in looked_at.out.splitlines() if line.startswith("CV155"))


def refused(outcome: "Outcome", *parts: str) -> None:
    assert outcome.code in (1, 2)
    assert len(outcome.complaints) == 1, outcome.complaints
    for part in parts:
        assert part in outcome.complaints[0]


def test_no_model_is_written_where_nothing_moved(
    model: LtiModel, run_of: RunOf, coldloop: "Coldloop", tmp_path: Path
) -> None:
    outcome = coldloop("identify", run_of(measured(model, np.zeros((TICKS, 4)), 1)), "--out", tmp_path / "model.json")
    refused(outcome, "not written", "no factor")
    assert "not fitted: too little to tell" in outcome.out
    assert not (tmp_path / "model.json").exists()


def test_no_model_is_written_that_does_not_predict_the_second_half_better(
    model: LtiModel, run_of: RunOf, coldloop: "Coldloop", tmp_path: Path
) -> None:
    moves = wanderings(1)
    first, second = (measured(with_gains(model, np.full(4, gain)), moves, 1) for gain in (1.2, 0.8))
    half = TICKS // 2 + 600
    changed = first._replace(y=np.vstack([first.y[:half], second.y[half:]]))
    outcome = coldloop("identify", run_of(changed), "--out", tmp_path / "model.json")
    refused(outcome, "not written", "no better")
    assert "not less than before" in outcome.out
    assert not (tmp_path / "model.json").exists()


def test_what_cannot_be_identified_from_is_told_in_a_line(
    model: LtiModel, recorded: Path, run_of: RunOf, coldloop: "Coldloop", tmp_path: Path
) -> None:
    refused(coldloop("identify", tmp_path / "nowhere"), "nowhere")
    refused(coldloop("identify", recorded), "too short", "1800 s")
    refused(coldloop("identify", recorded, "--model", tmp_path / "no.json"), "no such model file")
    record = measured(model, wanderings(1), 1)
    record.y[5000, 3] = np.nan
    run = run_of(record)
    refused(coldloop("identify", run), "1 ticks", "not known")
    (run / "trace.parquet").unlink()
    refused(coldloop("identify", run), "trace.parquet")


def test_a_model_of_other_signals_is_refused(
    model: LtiModel, recorded: Path, coldloop: "Coldloop", tmp_path: Path
) -> None:
    fewer = replace(
        model, B=model.B[:, :2], D=model.D[:, :2], B_tick=model.B_tick[:, :2], u0=model.u0[:2],
        input_names=model.input_names[:2], input_units=model.input_units[:2],
    )  # fmt: skip
    fewer.save(tmp_path / "fewer.json")
    refused(coldloop("identify", recorded, "--model", tmp_path / "fewer.json"), "2 inputs", "--model")


@pytest.mark.night
@pytest.mark.usefixtures("undrawn")
def test_valves_that_pass_less_are_found_in_an_hour_of_control(
    model: LtiModel, coldloop: "Coldloop", tmp_path: Path
) -> None:
    """The controller keeps the openings, so the factor of CV155 is that of this plant linearised there, below 0.9."""
    run, file = tmp_path / "run", tmp_path / "scaled.json"
    valves = [word for name in ("jt_valve", "turbine_valve") for word in ("--set", f"plant.mismatch.{name}=0.9")]
    assert coldloop("run", "--in-process", "--load", "c", "--duration", "1h", *valves, "--out", run).code == 0
    outcome = coldloop("identify", run, "--out", file)
    assert outcome.code == 0, outcome.out
    rows = {line.split()[0]: line.split() for line in outcome.out.splitlines() if line}
    for output in ("L1", "T5"):
        before, after = map(float, rows[output][2:])
        assert after < 0.7 * before, outcome.out

    record = read_record(RunFolder(run), model)
    plant = build_model(
        REFERENCE._replace(
            jt_valve=Valve(0.9 * REFERENCE.jt_valve.flow_area),
            turbine=REFERENCE.turbine._replace(inlet_valve=Valve(0.9 * REFERENCE.turbine.inlet_valve.flow_area)),
        )
    )
    linear = responses(plant, record.inputs).sum(axis=2).repeat(TICKS_PER_SAMPLE, axis=0)
    cv155 = identify(model, record).factors[0]
    assert cv155.low < identify(model, record._replace(y=linear)).factors[0].value < cv155.high < 0.95
    assert load(file).B[0, 0] == pytest.approx(cv155.value * model.B[0, 0])

    again = coldloop("run", "--in-process", "--duration", "2s", "--set", f"model.file={file}", "--out", tmp_path / "b")
    assert again.code == 0
