"""`simulate`: the loop from Python."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from coldloop.errors import UsageError
from coldloop.process.cold_box import COLD_BOX
from coldloop_rig import Simulation, simulate
from coldloop_rig.results.columns import TRACE, files_of
from tests.harness.process_files import COLUMN, TANK


@pytest.fixture(scope="module")
def minute() -> Simulation:
    return simulate(load="e", solver="ode", updating_period="adaptive", duration_s=60)


@pytest.mark.usefixtures("undrawn")
def test_a_simulation_has_the_trace_of_the_command(minute: Simulation, tmp_path: Path) -> None:
    from coldloop_rig import cli  # noqa: PLC0415
    from coldloop_rig.results.run_folder import RunFolder  # noqa: PLC0415

    out = tmp_path / "run"
    assert cli.main(["run", "--in-process", "--load", "e", "--duration", "60s", "--out", str(out)]) == 0
    recorded = RunFolder(out)
    told = {name: value for name, value in recorded.summary.items() if name not in ("wall_seconds", "realtime_factor")}
    assert {name: minute.summary[name] for name in told} == told
    assert recorded.file("trace.parquet").read().equals(minute.trace.arrow)
    assert recorded.file("updates.parquet").read().equals(minute.updates.arrow)
    events = recorded.file("events.parquet").read()
    assert events.drop(["utc"]).equals(minute.events.arrow.drop(["utc"])), "the time of day is another one"


def test_the_trace_is_a_data_frame_that_knows_its_units(minute: Simulation) -> None:
    frame = minute.trace.to_pandas()
    assert list(frame.columns) == [column.name for column in files_of(COLD_BOX)[TRACE].columns]
    assert frame["time_s"].iloc[-1] == 59.75
    assert frame.attrs["units"]["T5"] == "K"


def test_a_simulation_draws_itself(minute: Simulation, tmp_path: Path) -> None:
    figure = minute.plot(tmp_path / "run.svg")
    assert "<svg" in (tmp_path / "run.svg").read_text()
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert {"L1 (%)", "T5 (K)", "tau_u (s)"} <= set(labels)


def test_every_curve_is_in_a_legend_and_every_axis_has_a_unit(minute: Simulation) -> None:
    for axes in minute.plot().axes[:8]:
        assert axes.get_ylabel().endswith(")")
        named = {text.get_text() for text in axes.get_legend().get_texts()}
        assert {line.get_label() for line in axes.lines if not str(line.get_label()).startswith("_")} <= named


def test_settings_are_sections_of_the_configuration() -> None:
    noisy = simulate(load="e", duration_s=5, seed=3, plant={"sensors": {"level": 0.5}})
    assert noisy.configuration["plant.sensors.level"] == 0.5
    assert noisy.configuration["plant.seed"] == 3
    assert noisy.recording.y[:, 0].std() > 0.1


@pytest.mark.usefixtures("compiles")
def test_processes_in_one_interpreter_leave_the_traces_that_each_leaves_alone() -> None:
    """In turn, and in four threads: nothing of one is left for another."""

    def left(process: Path | None) -> tuple[str, list[str]]:
        run = simulate(process=process, duration_s="30s")
        return run.summary["trace_sha256"], run.trace.arrow.column_names

    processes = [None, TANK, COLUMN]
    in_turn = [left(process) for process in processes]
    own = ["CV155", "v1", "reflux"]
    assert [[name for name in own if name in names] for _, names in in_turn] == [[name] for name in own]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(left, processes * 3)) == in_turn * 3


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"solver": "simplex"}, "simplex"),
        ({"updating_period": 0.6}, "multiple of 0.25"),
        ({"duration_s": 0.1}, "duration_s"),
        ({"load": "nowhere"}, "nowhere"),
        ({"boiler": {"level": 1}}, "boiler"),
    ],
)
def test_an_argument_that_cannot_be_used_is_named(arguments: dict[str, object], part: str) -> None:
    with pytest.raises(UsageError, match=part):
        simulate(**arguments)  # type: ignore[arg-type]
