"""Disturbances beside the load, and setpoints: in the model, on the simulated plant, over the link."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
import pytest

from coldloop.errors import ColdloopError, ModelFileError
from coldloop.process.settings import process_of
from coldloop_optimizer_plc.qp.prediction import PredictionModel, rest_map
from coldloop_plant.own_plants import Disturbances
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.making import Made, made_from
from tests.harness.processes import Processes
from tests.process.runs import run

POND: Final = '''
class Pond:
    """Two tanks in a row: a pump and rain fill the upper, a leak and what is drawn empty both; levels in cm."""

    states = {"upper_level": "cm", "lower_level": "cm"}
    guess = [8.0, 8.0]

    def derivatives(self, x, u, w):
        leak, rain, draw, ambient = w
        upper, lower = x
        return [
            0.1 * (u[0] + rain) - 0.1 * upper - 0.02 * leak,
            0.1 * upper - 0.1 * lower - 0.1 * draw + 0.002 * ambient,
        ]

    def outputs(self, x, u, w):
        return [x[1], x[0]]
'''
FILE: Final = """
name = "pond"
[plant]
python = "pond.py:Pond"
[[inputs]]
name = "pump"
unit = "l/s"
at = 10.0
low = 0.0
high = 20.0
rate = 1.0
[[outputs]]
name = "lower"
unit = "cm"
range = [0.0, 30.0]
noise = 0.02
setpoint = 10.5
tolerance = 0.1
alarm = [9.0, 12.0]
loop = { input = "pump", gain = 0.5, integral_time_s = 20.0 }
[[outputs]]
name = "upper"
unit = "cm"
range = [0.0, 30.0]
noise = 0.02
[load]
name = "leak"
at = 0.0
span = [-5.0, 5.0]
[[disturbances]]
name = "rain"
unit = "l/s"
at = 0.0
span = [0.0, 3.0]
noise = 0.01
course = "weather.csv"
[[disturbances]]
name = "draw"
unit = "l/s"
at = 0.0
span = [-3.0, 3.0]
course = "weather.csv"
[[disturbances]]
name = "ambient"
unit = "K"
at = 0.0
span = [-30.0, 30.0]
noise = 0.1
"""
WEATHER: Final = "time_s,rain,draw\n0,0,0\n300,1.5,0\n600,1.5,2.0\n"


def pond(folder: Path, text: str = FILE, weather: str = WEATHER) -> Path:
    """Write the process file, its plant and its weather."""
    (folder / "process.toml").write_text(text, encoding="utf-8")
    (folder / "pond.py").write_text(POND, encoding="utf-8")
    (folder / "weather.csv").write_text(weather, encoding="utf-8")
    return folder / "process.toml"


def made(folder: Path, text: str = FILE, weather: str = WEATHER) -> Made:
    """Return what is made from it."""
    return made_from(pond(folder, text, weather))


def test_disturbances_are_states_that_hold_and_outputs_where_they_are_measured(tmp_path: Path) -> None:
    """By hand: rain fills the upper tank, what is drawn empties the lower one."""
    found = made(tmp_path)
    m, process = found.model, found.process
    assert m.state_names == ("upper_level", "lower_level", "rain", "draw", "ambient")
    expected = np.zeros((5, 5))
    expected[:2] = [[-0.1, 0.0, 0.1, 0.0, 0.0], [0.1, -0.1, 0.0, -0.1, 0.002]]
    assert pytest.approx(expected, abs=1e-9) == m.A
    assert pytest.approx([-0.02, 0.0, 0.0, 0.0, 0.0], abs=1e-9) == m.F
    assert m.output_names == ("lower", "upper", "rain", "ambient")
    assert m.C[2:].tolist() == [[0, 0, 1, 0, 0], [0, 0, 0, 0, 1]]
    assert {one.name: one.walk for one in process.states}["draw"] == pytest.approx(0.06)
    assert not {"rain", "ambient"} & set(process.constants)
    text = described(found)
    assert "after 300 s of +1 l/s rain: lower 1 cm  upper 1 cm" in text
    assert "modes      -0.1  -0.1 /s" in text
    assert "warning" not in text


def test_only_disturbances_are_drawn_as_such_and_model_files_of_another_form_are_refused(tmp_path: Path) -> None:
    """Of two measured states one has the name of its output: it is no disturbance."""
    (tmp_path / "new").mkdir()
    text = FILE.replace('name = "upper"', 'name = "upper_level"')
    found = made(tmp_path / "new", text)
    model, process = found.model, found.process
    assert {"upper_level", "rain", "ambient"} < {one.name for one in process.outputs}
    assert [one.name for one in process.measured_disturbances] == ["rain", "ambient"]
    model.save(tmp_path / "new.json")
    assert process_of(tmp_path / "new.json") == process
    replace(model, process=model.process | {"decision_instants": [1]}).save(tmp_path / "old.json")
    with pytest.raises(ModelFileError, match=r"of version 0\.3 or earlier, .* make one with `coldloop process FILE"):
        process_of(tmp_path / "old.json")


IN_M3: Final = POND.replace("= w\n", "= w[0], 1e3 * w[1], 1e3 * w[2], w[3]\n")
"""The same pond with rain and what is drawn in m3/s, of which 1 is much in a tick."""


@pytest.mark.parametrize("text", [POND, IN_M3], ids=["l/s", "m3/s"])
def test_a_session_begins_without_disturbances_however_far_the_inputs_are_from_the_operating_point(
    text: str, tmp_path: Path
) -> None:
    """One more l/s of the pump fills both tanks of the pond by 1 cm."""
    file = pond(tmp_path)
    (tmp_path / "pond.py").write_text(text, encoding="utf-8")
    prediction = PredictionModel(made_from(file).model)
    assert rest_map(prediction)[:5, 0].tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0, 0.0], abs=1e-9)


def test_a_setpoint_is_the_middle_of_its_tolerance_and_what_the_fallback_goes_to(tmp_path: Path) -> None:
    (band,) = made(tmp_path).process.bands
    assert (band.low, band.high, band.margin) == pytest.approx((10.4, 10.6, 0.1))
    assert band.alarm == (9.0, 12.0)
    assert band.setpoint_offset == pytest.approx(0.5)


def test_a_course_is_held_from_step_to_step() -> None:
    weather = Disturbances.of([
        {"ticks": [0, 4], "values": [1.0, 2.0], "measured": True}, {"ticks": [0], "values": [7.0], "measured": False},
    ])  # fmt: skip
    assert [weather.at(tick).tolist() for tick in (0, 3, 4, 99)] == [[1, 7], [1, 7], [2, 7], [2, 7]]
    assert weather.shown(4).tolist() == [2.0]


@pytest.mark.parametrize(
    "plant",
    [
        "matrices",
        pytest.param("python", marks=pytest.mark.night),
        pytest.param("transfer functions", marks=pytest.mark.night),
    ],
)
def test_the_setpoint_is_kept_over_the_link_as_in_one_process(plant: str, processes: Processes, tmp_path: Path) -> None:
    """Rain, which is measured, and what is drawn, which is estimated, leave no offset."""
    text = FILE
    if plant != "python":
        text = text.replace("noise = 0.02\n", "noise = 0.02\nat = 10.0\n")
    if plant == "matrices":
        A, B = np.array([[-0.1, 0.0], [0.1, -0.1]]), np.array([[0.1], [0.0]])
        F = np.array([[-0.02, 0.1, 0.0, 0.0], [0.0, 0.0, -0.1, 0.002]])
        np.savez(tmp_path / "pond.npz", A=A, B=B, C=np.array([[0.0, 1.0], [1.0, 0.0]]), F=F)
        text = text.replace('python = "pond.py:Pond"', 'matrices = "pond.npz"')
    if plant == "transfer functions":
        lags = [("pump", 1.0), ("leak", -0.2), ("rain", 1.0), ("draw", -1.0), ("ambient", 0.02)]
        entries = [
            f'{{ output = "{output}", source = "{source}", gain = {gain}, time_constant_s = {time_s}, delay_s = 1.0 }}'
            for source, gain in lags
            for output, time_s in (("lower", 20.0), ("upper", 10.0))
        ]
        text = text.replace('python = "pond.py:Pond"', f"transfer_functions = [{', '.join(entries)}]")
    file, options = pond(tmp_path, text), ("--load", "a", "--duration", "18min")
    here = run(processes, file, tmp_path / "here", "--in-process", *options)
    there = run(processes, file, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"]
    trace = pd.read_parquet(tmp_path / "here" / "trace.parquet")
    for end_s, rain in ((300, 0.0), (600, 1.5), (1080, 1.5)):
        before = trace[(trace.time_s >= end_s - 30) & (trace.time_s < end_s)]
        assert before.lower.to_numpy() == pytest.approx(10.5, abs=0.05)
        assert before.rain.to_numpy() == pytest.approx(rain, abs=1e-6)


@pytest.mark.parametrize(
    "known", ["rain", pytest.param("draw", marks=pytest.mark.night), pytest.param("leak", marks=pytest.mark.night)]
)
def test_a_step_that_is_forecast_costs_less_than_one_that_is_not(
    known: str, processes: Processes, tmp_path: Path
) -> None:
    """Of a disturbance that is measured, of one that is estimated, of the load; the pump is slow, 0.1 l/s in 5 s."""
    header, load = "time_s,rain,draw,leak", known == "leak"
    weather = f"{header}\n0,0,0,0\n240,{1.5 * (known == 'rain')},{1.0 * (known == 'draw')},{5.0 * load}\n"
    (tmp_path / "leak.csv").write_text(f"time_s,load\n0,0\n240,{5.0 * load}\n", encoding="utf-8")
    text = FILE.replace("setpoint = 10.5", "setpoint = 10.0").replace("rate = 1.0", "rate = 0.1")
    options = ("--in-process", "--load", str(tmp_path / "leak.csv"), "--duration", "8min", *ELAPSED)
    unknown = run(processes, pond(tmp_path, text, weather), tmp_path / "unknown", *options)
    text = text.replace(f'name = "{known}"', f'name = "{known}"\nforecast = "weather.csv"')
    expected = run(processes, pond(tmp_path, text, weather), tmp_path / "expected", *options)
    assert expected["J_BF"] < 0.5 * unknown["J_BF"]
    assert expected["lower_outside_band_pct"] < unknown["lower_outside_band_pct"]


def test_a_forecast_that_never_comes_leaves_no_offset(processes: Processes, tmp_path: Path) -> None:
    (tmp_path / "promised.csv").write_text("time_s,rain\n0,0\n200,3\n400,0\n", encoding="utf-8")
    text = FILE.replace('name = "rain"', 'name = "rain"\nforecast = "promised.csv"').replace(
        'noise = 0.01\ncourse = "weather.csv"', "noise = 0.01"
    )
    weather = "time_s,rain,draw\n0,0,0\n"
    file, options = pond(tmp_path, text, weather), ("--load", "a", "--duration", "10min")
    here = run(processes, file, tmp_path / "here", "--in-process", *options)
    there = run(processes, file, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"]
    trace = pd.read_parquet(tmp_path / "here" / "trace.parquet")
    assert trace[trace.time_s > 570].lower.to_numpy() == pytest.approx(10.5, abs=0.05)


ELAPSED: Final = ("--set", "limits.rate_reference=elapsed")
"""Else short periods allow more than the prediction counts with."""

BAD: Final = {
    "a setpoint and a band": (FILE.replace("tolerance = 0.1", "band = [10.0, 11.0]"), "give a band or a setpoint"),
    "a setpoint outside": (FILE.replace("setpoint = 10.5", "setpoint = 31.0"), "outside its range"),
    "a tolerance of nothing": (FILE.replace("setpoint = 10.5\n", "band = [10.0, 11.0]\n"), "needs a setpoint"),
    "an alarm inside": (FILE.replace("[9.0, 12.0]", "[10.45, 12.0]"), "alarm begins inside"),
    "an alarm of nothing": (FILE.replace("[9.0, 12.0]", "[12.0, 9.0]"), "alarm: give the lower end first"),
    "an alarm of what is only measured": (FILE.replace('"upper"', '"upper"\nalarm = [1.0, 2.0]'), "upper: a loop"),
    "a name twice": (FILE.replace('"rain"', '"draw"'), "two signals have this name"),
    "outside its span": (FILE.replace("span = [0.0, 3.0]", "span = [1.0, 3.0]"), "rain: at = 0"),
    "no such column": (FILE.replace('"ambient"\n', '"ambient"\ncourse = "weather.csv"\n'), "no column ambient"),
    "no such forecast": (FILE.replace('"draw"\n', '"draw"\nforecast = "hopes.csv"\n'), "hopes.csv"),
    "no such file": (FILE.replace("weather.csv", "whether.csv"), "whether.csv"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_gets_one_line(case: str, tmp_path: Path) -> None:
    text, why = BAD[case]
    with pytest.raises(ColdloopError) as refused:
        made(tmp_path, text)
    assert "\n" not in str(refused.value)
    assert why in str(refused.value)


@pytest.mark.parametrize(
    ("weather", "why"),
    [
        ("time_s,rain,draw\n5,0,0\n", "begins at 0"),
        ("time_s,rain,draw\n0,0,0\n60,1,0\n60,2,0\n", "time_s = 60: it rises by at least a tick"),
        ("time_s;rayn;draw\n0;0;0\n", "no column rain; its header is 'time_s,rayn,draw', and should name time_s,rain"),
        ("time_s,rain,draw,rain\n0,0,0,1\n", "two columns are named rain"),
        ("time_s,rain,draw\n0,4,0\n", "rain = 4 is outside its span"),
        ("time_s,rain,draw\n0,wet,0\n", "'wet' is no finite number"),
        ("time_s,rain,draw\n", "no line of numbers"),
    ],
)
def test_a_course_that_cannot_be_played_gets_one_line(weather: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(ColdloopError) as refused:
        made(tmp_path, weather=weather)
    assert "\n" not in str(refused.value)
    assert why in str(refused.value)
