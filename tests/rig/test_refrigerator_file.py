"""`coldloop model` and `exergy` of a whole refrigerator's plant file: it runs by it, or one line says why not."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import COLD_BOX, T5_BAND
from coldloop.process.lti_model import load
from coldloop.process.settings import ModelSettings
from coldloop_plant.kinds import own_header
from coldloop_plant.load import find_load
from coldloop_plant.settings import PlantSection
from coldloop_rig import simulate as run_in_process
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from tests.conftest import Coldloop
    from tests.rig.conftest import OnTheBus, Simulate

pytestmark = pytest.mark.usefixtures("compiles")

EXAMPLE = Path(__file__).parents[2] / "examples" / "efficient_refrigerator.toml"
USAGE = 2


@pytest.fixture
def made(coldloop: "Coldloop", tmp_path: Path) -> Path:
    file = tmp_path / "efficient.json"
    outcome = coldloop("model", "--plant", EXAMPLE, "--out", file)
    assert (outcome.code, outcome.complaints) == (0, [])
    assert "outside " not in outcome.out
    assert re.search(r"75\.9 g/s, 250\.6 kW, 491 W/W\n", outcome.out)
    return file


def test_a_refrigerator_runs_by_its_file_alone(made: Path, coldloop: "Coldloop", tmp_path: Path) -> None:
    model = load(made)
    assert own_header(made).plant_rest["x0"][:28] == model.x0[:28].tolist()
    run = run_in_process(load="a", duration_s="10min", model={"file": str(made)}, plant={"kind": "refrigerator"})
    columns = run.trace.to_dict()
    assert min(columns["T5"]) > T5_BAND[0]
    assert columns["T10"][0] == pytest.approx(76.97, abs=0.01)
    assert 15.9 < min(columns["P9"]) < max(columns["P9"]) < 16.1
    refused = coldloop("run", "--in-process", "--set", f"model.file={made}", "--out", tmp_path / "run")
    assert (refused.code, len(refused.complaints)) == (1, 1)
    assert "a model of the refrigerator; set plant.kind to that" in refused.complaints[0]


async def test_over_the_bus_it_is_the_same_refrigerator(
    made: Path, on_the_bus: "OnTheBus", simulate: "Simulate"
) -> None:
    model, plant = ModelSettings(file=made), PlantSection.model_validate({"kind": "refrigerator"})
    scenario = Scenario(ticks=80, load=find_load("a", load(made).w0, COLD_BOX), updating_period_s=0.0, seed=1)
    async with on_the_bus(Settings(model=model, plant=plant)) as bus:
        networked = await bus.record(scenario)
    assert networked.trace_sha256 == simulate(scenario, model=model, plant=plant).trace_sha256


def test_gains_are_those_of_the_weights_that_are_configured(coldloop: "Coldloop", made: Path, tmp_path: Path) -> None:
    other, weights = tmp_path / "other.json", "plant.station.weights.lp_bar=0.02"
    assert coldloop("model", "--plant", EXAMPLE, "--set", weights, "--out", other).code == 0
    gains = [load(file).plant_rest["gains"] for file in (made, other)]
    assert gains[0] != gains[1]
    plant = ("--set", "plant.kind=refrigerator", "--set", f"model.file={other}")
    run = ("run", "--in-process", "--duration", "10s", *plant)
    refused = coldloop(*run, "--out", tmp_path / "a")
    assert (refused.code, len(refused.complaints)) == (USAGE, 1)
    assert "plant.station.weights" in refused.complaints[0]
    assert coldloop(*run, "--set", weights, "--out", tmp_path / "b").code == 0


def test_pressures_at_rest_that_are_not_the_set_points_are_said(coldloop: "Coldloop", tmp_path: Path) -> None:
    file = tmp_path / "lower.toml"
    file.write_text("[boundaries]\np_hp_bar = 15.5\n[station]\nbuffer_bar = 5")
    outcome = coldloop("model", "--plant", file)
    assert (outcome.code, outcome.complaints) == (0, [])
    assert "--set plant.station.hp_bar=15.5 --set plant.station.lp_bar=1.05\n" in outcome.out
    assert "P9 15.5000 bar" in outcome.out


def test_the_exergy_of_the_example_sums_to_what_is_put_in(coldloop: "Coldloop") -> None:
    outcome = coldloop("exergy", "--plant", EXAMPLE)
    assert (outcome.code, outcome.complaints) == (0, [])
    assert "specific power 491 W/W of electricity" in outcome.out
    found = re.findall(r"^(\S.*?) +(-?[\d.]+) +-?[\d.]+$", outcome.out, re.MULTILINE)
    rows = {name: float(value) for name, value in found}
    lost = [value for name, value in rows.items() if name not in {"electricity", "liquid nitrogen", "sum"}]
    assert len(lost) == 16
    assert sum(lost) == pytest.approx(rows["electricity"] + rows["liquid nitrogen"], abs=0.01)
    assert rows["sum"] == pytest.approx(rows["electricity"] + rows["liquid nitrogen"], abs=0.002)


WRONG_VALUES = {
    "nef6.ua_w_per_k": ["0"], "nef6.volume_l": ["0"], "nef6.aluminium_kg": ["-150"], "nef5.ua_w_per_k": ["0"],
    "nef5.volume_l": ["-30"], "nef5.wet_level_pct": ["120"], "nef5.capacity_kj_per_k": ["0"],
    "nef5.cv167_area_mm2": ["1.3e-6"], "nef5.cv167_lag_s": ["0.1"], "nef5.cv167_fastest_pct_per_s": ["-1"],
    "nc1.displacement_l_per_s": ["0", "0.038", "1e9", "inf", "true"], "nc1.filling": ["1.2"], "nc2.slip": ["0.5"],
    "nc2.isothermal_efficiency": ["55"], "nc2.built_in_ratio": ["1"], "nc1.mismatch": ["-0.05"],
    "nc2.motor_efficiency": ["95"], "station.hp_volume_m3": ["1e6"], "station.lp_volume_m3": ["-1.5"],
    "station.buffer_volume_m3": ["nan"], "station.buffer_bar": ["600"], "station.cv956_area_mm2": ["3.4e-5"],
    "station.cv952_area_mm2": ["-20"], "station.cv953_area_mm2": ["inf"], "station.valve_lag_s": ["0"],
    "station.cooler_approach_k": ["300"], "station.run_up_s": ["0"], "station.run_down_s": ["0.01"],
    "hp_relief.pressure_bar": ["18e5"], "lp_relief.span_bar": ["0"], "buffer_relief.area_mm2": ["-1"],
    "boundaries.p_hp_bar": ["25"],
}  # fmt: skip
"""Each key is refused at an end of its range; how else a number may be wrong is tried on one of them."""
WITHOUT_SEARCH = [
    *(
        ("[{}]\n{} = {}\n[nc1]".format(*key.split("."), value) if not key.startswith("nc1.") else
         "[nc1]\n{} = {}".format(key.split(".")[1], value), f": {key}: ")
        for key, values in WRONG_VALUES.items() for value in values
    ),
    ("[nc3]\nfilling = 0.9", "nc3: no such key; did you mean nc"),
    ("[nc1]\ndisplacement_m3_per_s = 0.38", "did you mean nc1.displacement_l_per_s?"),
    ("[nef6]\ncells = 12", "nef6.cells: no such key"),
    ("[station]\nhp_volume_m3 = 2\n[station]\n", "not TOML"),
    ("[boundaries]\np_lp_bar = 17\n[station]", "boundaries.p_lp_bar: "),
    ("[station]\nbuffer_bar = 17", "buffer_relief: opens at 13 bar"),
    ("[station]\nbuffer_bar = 17\n[buffer_relief]\npressure_bar = 20", "station.buffer_bar: 17 bar is not between"),
    ("[hp_relief]\npressure_bar = 15", "hp_relief: opens at 15 bar, and the line is to be at 16 bar"),
    ("[boundaries]\np_hp_bar = 18.5\n[station]", "hp_relief: opens at 18 bar"),
    ("[lp_relief]\npressure_bar = 1.04", "lp_relief: opens at 1.04 bar"),
    ("[boundaries]\np_lp_bar = 1.6\n[station]", "lp_relief: opens at 1.5 bar"),
]  # fmt: skip
SEARCHED = [
    ("[nc1]\ndisplacement_l_per_s = 200\n[nc2]\ndisplacement_l_per_s = 200", "nc1, nc2: deliver 56.2 g/s"),
    ("[nc1]\nslip = 0.1\n[nc2]\nslip = 0.1", "nc1, nc2: deliver 0.0 g/s"),
    ("[turbine]\nnozzle_g_sqrt_k_per_s_bar = 30\ncv156_area_mm2 = 40\n[nc1]", "nc1, nc2: deliver 106.8 g/s"),
    ("[station]\ncv956_area_mm2 = 2", "station.cv956_area_mm2: the bypass would be"),
    ("[nef5]\ncv167_area_mm2 = 0.1", "nef5.cv167_area_mm2: the nitrogen feed would be"),
    ("[nef6]\nua_w_per_k = 10", "nef"),
    ("[nef6]\nvolume_l = 0.1\naluminium_kg = 0.1", "nef6: follows within"),
    ("[nef5]\ncapacity_kj_per_k = 0.1", "nef5: follows within"),
    ("[station]\nlp_volume_m3 = 0.05", "station: follows within"),
    ("[return_line]\ncold_drop_bar = 1\n[station]", "bath: its pressure"),
    ("[turbine]\nefficiency = 0.3\n[station]", "operating_point.ncr22_a_w"),
]


@pytest.mark.parametrize(("text", "part"), WITHOUT_SEARCH + SEARCHED)
def test_an_absurd_refrigerator_is_refused_in_one_line_that_names_the_place(
    text: str, part: str, coldloop: "Coldloop", tmp_path: Path
) -> None:
    file, out = tmp_path / "plant.toml", tmp_path / "plant.json"
    file.write_text(text)
    outcome = coldloop("model", "--plant", file, "--out", out)
    assert (outcome.code, outcome.out, len(outcome.complaints)) == (USAGE, "", 1), outcome
    assert f"{file}: " in outcome.complaints[0]
    assert part in outcome.complaints[0]
    assert not out.exists()
