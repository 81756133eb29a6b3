"""`coldloop model --plant`: another cold box is simulated with its own model, or one line says why it cannot be."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

from coldloop.errors import ModelFileError
from coldloop.process.cold_box import COLD_BOX, L1, T5, T5_BAND
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.settings import DEFAULT_MODEL_FILE, ModelSettings
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_plant.cold_box.plant_file import PlantFile
from coldloop_plant.load import find_load
from coldloop_plant.numeric import RealArray
from coldloop_refrigerator.plant_file import read_plant_file
from coldloop_rig import Simulation
from coldloop_rig import simulate as run_in_process
from coldloop_rig.cli.listings import describe_model
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from tests.conftest import Coldloop
    from tests.rig.conftest import OnTheBus, Simulate

EXAMPLE = Path(__file__).parents[2] / "examples" / "smaller_turbine.toml"
USAGE = 2


class Made(NamedTuple):
    """The example's model file, and ten minutes with it."""

    file: Path
    model: LtiModel
    run: Simulation


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    file, settings = tmp_path_factory.mktemp("made") / "my_box.json", Settings()
    plant = read_plant_file(EXAMPLE, settings.limits)
    model, *_ = describe_model(DEFAULT_MODEL_FILE, plant, settings.optimizer_plc.program.design)
    model.save(file)
    return Made(file, model, run_in_process(load="a", duration_s="10min", model={"file": str(file)}))


@pytest.mark.usefixtures("compiles")
def test_the_example_rests_and_stays_within_its_bands(made: Made) -> None:
    assert made.model.y0[L1] == pytest.approx(60.0)
    assert T5_BAND[0] < made.model.y0[T5] < T5_BAND[1]
    assert made.model.w0 > 200.0
    assert made.run.summary["L1_outside_band_pct"] == made.run.summary["T5_outside_band_pct"] == 0.0


@pytest.mark.usefixtures("compiles")
def test_a_refrigerator_refuses_the_model_of_another_cold_box(made: Made) -> None:
    with pytest.raises(ModelFileError, match=r"model\.file: of another cold box .* set plant\.kind to cold-box"):
        run_in_process(load="a", duration_s=60, model={"file": str(made.file)}, plant={"kind": "refrigerator"})


@pytest.mark.usefixtures("compiles")
def test_it_is_another_plant_whose_model_predicts_it_better(made: Made) -> None:
    columns = {name: np.array(values) for name, values in made.run.trace.to_dict().items()}
    shipped = load(DEFAULT_MODEL_FILE)
    usual = run_in_process(load="a", duration_s="10min").trace.to_dict()
    assert abs(columns["T10"][0] - usual["T10"][0]) > 0.1
    u = np.stack([columns[name] for name in made.model.input_names], axis=1)
    y = np.stack([columns[made.model.output_names[k]] for k in (L1, T5)], axis=1)
    errors = [predicted(model, made.model, u, columns["load_w"]) - y for model in (made.model, shipped)]
    own, other = (np.sqrt(np.mean(np.square(error), axis=0)) for error in errors)
    assert np.all(own < 0.7 * other)


def predicted(model: LtiModel, at: LtiModel, u: RealArray, w: RealArray) -> RealArray:
    """Return L1 and T5 of a model in each tick, about the operating point of another."""
    x, rows = np.zeros(len(model.x0)), []
    for inputs, load_w in zip(u - at.u0, w - at.w0, strict=True):
        rows.append((at.y0 + model.C @ x + model.D @ inputs + model.G * load_w)[[L1, T5]])
        x = model.A_tick @ x + model.B_tick @ inputs + model.F_tick * load_w
    return np.array(rows)


@pytest.mark.usefixtures("compiles")
async def test_over_the_bus_it_is_the_same_plant(made: Made, on_the_bus: "OnTheBus", simulate: "Simulate") -> None:
    model = ModelSettings(file=made.file)
    scenario = Scenario(ticks=80, load=find_load("a", made.model.w0, COLD_BOX), updating_period_s=0.0, seed=1)
    async with on_the_bus(Settings(model=model)) as bus:
        networked = await bus.record(scenario)
    assert networked.trace_sha256 == simulate(scenario, model=model).trace_sha256


@pytest.mark.usefixtures("compiles")
def test_the_command_prints_the_model_and_writes_it(made: Made, coldloop: "Coldloop", tmp_path: Path) -> None:
    file = tmp_path / "box.json"
    outcome = coldloop("model", "--plant", EXAMPLE, "--out", file)
    assert (outcome.code, outcome.complaints) == (0, [])
    assert f"sha256 {made.model.digest}\n" in outcome.out
    assert "outside " not in outcome.out
    assert "kink " not in outcome.out
    assert re.search(r"holdable_load_w=\[\d+,[4-7]\d\d\]\n", outcome.out)
    assert file.read_bytes() == made.file.read_bytes()
    again = coldloop("model", "--plant", EXAMPLE, "--out", EXAMPLE)
    assert (again.code, len(again.complaints)) == (USAGE, 1)


@pytest.mark.usefixtures("compiles")
def test_an_output_that_rests_outside_its_band_and_a_kink_are_said() -> None:
    changes = {
        "turbine": {"efficiency": 0.78},
        "nef34": {"ua_w_per_k": 15_000.0},
        "operating_point": {"level_pct": 50.0},
    }
    _, text, _ = describe_model(DEFAULT_MODEL_FILE, PlantFile.model_validate(changes), ControlDesign())
    assert "L1 rests at 50.00 %, its band is 59 to 61 %: set optimizer_plc.program.design.output_low" in text
    assert "kink       derivatives differ on both sides" in text


WRONG_VALUES = {
    "bath.volume_m3": ["0", "nan", "1e9", '"0.2"', "[0.2]", "2024-01-01"],
    "bath.wall_kg": ["-1"], "bath.relief_pressure_bar": ["2.5"], "bath.relief_span_bar": ["0"],
    "bath.relief_area_mm2": ["0"], "cv155.area_mm2": ["0"], "turbine.cv156_area_mm2": ["2.6e-5"],
    "turbine.nozzle_g_sqrt_k_per_s_bar": ["2.2e-7"], "turbine.efficiency": ["1.0"],
    "turbine.speed_hz_per_sqrt_j_per_kg": ["0"], "turbine.windage_g_per_s": ["-1"],
    "nef1.ua_w_per_k": ["1e9"], "nef2.ua_w_per_k": ["-2500"], "nef2.volume_l": ["0"], "nef34.aluminium_kg": ["0"],
    "return_line.cold_flow_g_per_s": ["0"], "return_line.warm_drop_bar": ["5"], "return_line.cold_drop_bar": ["-0.05"],
    "boundaries.p_hp_bar": ["1.05", "16e5"], "boundaries.p_lp_bar": ["17"], "boundaries.t_in_k": ["4"],
    "operating_point.level_pct": ["100"], "operating_point.ncr22_a_w": ["200"], "operating_point.cv155_pct": ["61"],
    "operating_point.cv156_pct": ["19.9"],
}  # fmt: skip
WITHOUT_SEARCH = [
    *(
        (f"[{key.partition('.')[0]}]\n{key.partition('.')[2]} = {value}", f": {key}: ")
        for key, values in WRONG_VALUES.items() for value in values
    ),
    ("[bath]\nvolum_m3 = 0.2", "did you mean bath.volume_m3?"),
    ("[baths]\nvolume_m3 = 0.2", "baths: no such key; did you mean bath?"),
    ("[cv155]\narea_m2 = 3.9e-6", "did you mean cv155.area_mm2?"),
    ("[nef1]\nua = 1400", "did you mean nef1.ua_w_per_k?"),
    ("[nef1]\ncells = 20", "nef1.cells: no such key"),
    ("[precooler]\nua_w_per_k = 1", "precooler: no such key"),
    ('kind = "refrigerator"', "kind: no such key"),
    ("[bath]\nvolume_m3 = 0.2\n[bath]\nwall_kg = 50", "not TOML"),
    ("[bath]\nvolume_m3 = 0.2\nvolume_m3 = 0.3", "not TOML"),
    ("bath", "not TOML"),
    ("a = " + "[" * 5000, "not TOML"),
    ("bath = 0.2", "bath: "),
    ("[[bath]]\nvolume_m3 = 0.2", "bath: "),
]  # fmt: skip
SEARCHED = [
    ("[boundaries]\nt_in_k = 300", "operating_point.ncr22_a_w"),
    ("[turbine]\nnozzle_g_sqrt_k_per_s_bar = 200", "turbine: its nozzle"),
    ("[return_line]\ncold_drop_bar = 1", "bath: its pressure"),
    ("[nef1]\nvolume_l = 0.1\naluminium_kg = 0.1", "more nef1.aluminium_kg or less flow would help"),
    ("[boundaries]\nt_in_k = 30", "turbine: its exhaust would be wet"),
    ("[nef1]\nua_w_per_k = 200000", "nef1: finds no rest"),
]


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(("text", "part"), WITHOUT_SEARCH + SEARCHED)
def test_an_absurd_plant_is_refused_in_one_line_that_names_the_place(
    text: str, part: str, coldloop: "Coldloop", tmp_path: Path
) -> None:
    file, out = tmp_path / "box.toml", tmp_path / "box.json"
    file.write_text(text)
    outcome = coldloop("model", "--plant", file, "--out", out)
    assert (outcome.code, outcome.out, len(outcome.complaints)) == (USAGE, "", 1), outcome
    assert f"{file}: " in outcome.complaints[0]
    assert part in outcome.complaints[0]
    assert not out.exists()


@pytest.mark.parametrize("content", [None, b"\xff\xff", b"#" * 2_000_000], ids=["missing", "binary", "endless"])
def test_a_plant_file_that_cannot_be_read_is_said(content: bytes | None, coldloop: "Coldloop", tmp_path: Path) -> None:
    file = tmp_path / "box.toml"
    if content is not None:
        file.write_bytes(content)
    outcome = coldloop("model", "--plant", file)
    assert (outcome.code, len(outcome.complaints)) == (USAGE, 1)
    assert str(file) in outcome.complaints[0]
    assert "--config" not in outcome.complaints[0]
