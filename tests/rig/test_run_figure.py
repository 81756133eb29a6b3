"""What the figure of a run shows, and that its legends name what can be seen and nothing else."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Text

from coldloop.process.cold_box import COLD_BOX, INPUT_NAMES
from coldloop_rig.figures.plot import RunCurves, curves_of, draw_run, label_marks, labels_of
from coldloop_rig.results.run_folder import RunFolder, _in_force
from coldloop_studies.drawing import _updates
from coldloop_studies.request import Outcome
from tests.conftest import Coldloop

TICKS = 4000


def curves(level: float = 60.0, **pressures: tuple[float, float]) -> RunCurves:
    series = {name: np.ones(TICKS) for name in (*labels_of(COLD_BOX), *pressures)}
    series |= {"time_s": np.arange(TICKS) * 0.25, "L1": np.full(TICKS, level), "T5": np.full(TICKS, 10.0)}
    edges = {"L1": (59.0, 61.0), "T5": (9.0, 16.0)} | dict.fromkeys(INPUT_NAMES, (0.0, 100.0))
    events = [
        {"time_s": 0.0, "kind": "mode", "subject": "hold"},
        {"time_s": 0.25, "kind": "mode", "subject": "mpc"},
        {"time_s": 500.0, "kind": "mode", "subject": "classical"},
    ]
    return RunCurves(COLD_BOX, series, events, edges, "", "", pressures)


def legends(figure: Figure) -> list[list[str]]:
    found = []
    for axes in figure.axes:
        legend = axes.get_legend()
        found.append([text.get_text() for text in legend.get_texts()] if legend else [])
    return found


def test_a_mode_that_is_too_short_to_be_seen_has_no_entry() -> None:
    assert legends(draw_run(curves()))[-1] == ["mpc", "classical"]


@pytest.mark.parametrize(("level", "is_seen"), [(60.0, True), (59.05, True), (20.0, False), (90.0, False)])
def test_a_band_has_an_entry_where_it_can_be_seen(level: float, *, is_seen: bool) -> None:
    entries = legends(draw_run(curves(level)))[1]
    assert any(entry.startswith("band 59 to 61 %") for entry in entries) is is_seen


def test_a_refrigerator_has_its_pressures_between_inputs_and_updating_period() -> None:
    figure = draw_run(curves(P12=(14.5, 16.8), P11=(0.97, 1.15)))
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels[6:9] == ["P12 (bar)", "P11 (bar)", "tau_u (s)"]


@pytest.mark.usefixtures("compiles", "programs")
def test_the_run_of_a_refrigerator_is_drawn_with_what_its_station_recorded(tmp_path: Path, coldloop: Coldloop) -> None:
    folder = tmp_path / "run"
    outcome = coldloop(
        "run", "--in-process", "--load", "a", "--duration", "15s", "--set", "plant.kind=refrigerator",
        "--figures", "png", "--out", str(folder),
    )  # fmt: skip
    assert outcome.code == 0
    found = curves_of(RunFolder(folder))
    assert found.pressures == {"P12": (14.5, 16.8), "P11": (0.97, 1.15)}
    assert found.series["P12"] == pytest.approx(np.full(60, 16.0), abs=0.1)
    assert (folder / "run.png").is_file()


def test_the_updating_period_is_drawn_only_while_it_was_in_force() -> None:
    modes = ["mpc", "manual", None, "mpc", "rest"]
    batch = pa.record_batch({"time_s": [0.0, 0.25, 0.5, 0.75, 1.0], "tau_u_s": [1.0] * 5, "mode": modes})
    drawn = _in_force(batch, ["time_s", "tau_u_s"])
    assert list(np.isfinite(drawn["tau_u_s"])) == [True, False, True, True, False]
    assert "mode" not in drawn


def test_studies_draw_periods_and_iterations_while_they_were_in_force() -> None:
    """From tick 6 on another mode drove, until the update at tick 9."""
    updates = {"tick": [0.0, 4.0, 9.0], "tau_u": [4.0, 2.0, 4.0], "iterations": [3.0, 1.0, 3.0]}
    run = Outcome("", None, "", 0, updates, {})  # type: ignore[arg-type]
    place = dict(zip(("iterations", "tau_u"), Figure().subplots(2), strict=True))
    _updates(place, "run", run, "black")
    for name, scale in (("iterations", 1.0), ("tau_u", 0.25)):
        drawn = np.asarray(place[name].lines[0].get_ydata()) / scale
        expected = [updates[name][0]] * 4 + [updates[name][1]] * 2 + [np.nan] * 3 + [updates[name][2]]
        assert drawn == pytest.approx(expected, nan_ok=True)


@given(low=st.floats(-1e9, 1e9), mantissa=st.floats(1, 10), power=st.integers(-2, 9))
@example(low=150_000.0, mantissa=8.0, power=0)
def test_marks_of_any_linear_axis_differ_and_parse_back(low: float, mantissa: float, power: int) -> None:
    span = mantissa * 10.0**power
    figure = Figure()
    axes = figure.subplots()
    axes.plot([low, low + span], [low + span, low])
    label_marks(figure)
    figure.canvas.draw()
    for axis in (axes.xaxis, axes.yaxis):
        marks, labels = axis.get_majorticklocs(), [label.get_text() for label in axis.get_ticklabels()]
        assert len(set(labels)) == len(labels) > 2
        step = float(np.diff(marks).min())
        assert [float(label) for label in labels] == pytest.approx(list(marks), abs=0.01 * step, rel=0)
        assert not axis.get_offset_text().get_text()


def test_figures_that_threads_draw_have_one_style() -> None:
    with ThreadPoolExecutor(4) as pool:
        sizes = list(pool.map(lambda _: [text.get_size() for text in draw_run(curves()).findobj(Text)], range(6)))
    assert sizes == sizes[:1] * 6
