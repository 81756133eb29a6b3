"""A process file: what it is made into, against closed forms, and what it refuses, in one line each."""

import json
from dataclasses import replace
from math import sqrt
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy import signal

from coldloop.errors import ColdloopError
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.declaration import Process
from coldloop.process.model_file import read_header
from coldloop.process.sections import Lag
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.linear_model import lag_model, realised
from coldloop_rig.process_file.making import Made, made_from
from tests.harness.installed import installed
from tests.harness.unstable_plants import pendulum, stirred_tank

if TYPE_CHECKING:
    from tests.conftest import Coldloop

EXAMPLES = Path(__file__).parents[2] / "examples" / "processes"
ONE_BY_ONE = """
name = "heater"
[plant]
python = "heater.py:Heater"
[[inputs]]
name = "power"
unit = "W"
at = 50.0
low = 0.0
high = 100.0
rate = 10.0
[[outputs]]
name = "temperature"
unit = "K"
range = [200.0, 500.0]
noise = 0.1
band = [320.0, 330.0]
"""
HEATER = """
class Heater:
    states = {"T": "K"}
    guess = [300.0]
    def derivatives(self, x, u, w):
        return [(u[0] - 2.0 * (x[0] - 300.0)) / 100.0]
    def outputs(self, x, u, w):
        return [x[0]]
"""


def made(folder: Path, text: str = ONE_BY_ONE, plant: str = HEATER) -> Made:
    """Return what is made from a process file and a plant beside it."""
    (folder / "process.toml").write_text(text, encoding="utf-8")
    (folder / "heater.py").write_text(plant, encoding="utf-8")
    return made_from(folder / "process.toml")


def test_the_cold_box_is_a_process_like_others_and_survives_a_journey_as_data() -> None:
    assert Process.model_validate(COLD_BOX.model_dump(mode="json")) == COLD_BOX


def test_a_heater_by_hand(tmp_path: Path) -> None:
    """100 J/K that lose 2 W/K to 300 K: with 50 W 325 K, a time constant of 50 s, 0.5 K for each W."""
    model = made(tmp_path).model
    assert model.x0 == pytest.approx([325.0])
    assert pytest.approx(np.array([[-0.02]]), rel=1e-6) == model.A
    assert model.A_tick == pytest.approx(np.array([[np.exp(-0.02 * 0.25)]]), rel=1e-9)
    assert (model.C @ model.discretised(1e4).B)[0, 0] == pytest.approx(0.5, rel=1e-6)


def test_the_quadruple_tank_has_the_time_constants_that_its_author_gives() -> None:
    """T_i = A_i / a_i sqrt(2 h_i / g): a mode each (Johansson 2000, equation 7)."""
    model = made_from(EXAMPLES / "quadruple_tank.toml").model
    assert model.x0 == pytest.approx([12.26, 12.78, 1.63, 1.41], abs=0.01)
    area, outlet = (28.0, 32.0, 28.0, 32.0), (0.071, 0.057, 0.071, 0.057)
    constants = [A / a * sqrt(2 * h / 981.0) for A, a, h in zip(area, outlet, model.x0, strict=True)]
    assert sorted(-1 / np.linalg.eigvals(model.A).real) == pytest.approx(sorted(constants), rel=1e-6)


def test_a_dead_time_has_the_phase_of_a_dead_time_well_below_its_reciprocal() -> None:
    lag = Lag(output="y", source="u", gain=2.0, time_constant_s=100.0, delay_s=30.0)
    a, b, c = lag_model(lag)
    for w in (1e-4, 1e-3, 1e-2, 1 / 30.0):
        found = c @ np.linalg.solve(1j * w * np.eye(len(a)) - a, b)
        assert found == pytest.approx(2.0 * np.exp(-30j * w) / (1 + 100j * w), rel=2e-3)
    assert c @ np.linalg.solve(-a, b) == pytest.approx(2.0)


BY_MATRICES = ONE_BY_ONE.replace("noise = 0.1", "noise = 0.1\nat = 325.0").replace(
    'python = "heater.py:Heater"', 'matrices = "GIVEN"'
)
LOAD = '[load]\nname = "sun"\nat = 0.0\nspan = [-20.0, 20.0]\n'


def test_matrices_of_a_file_are_the_model(tmp_path: Path) -> None:
    A, B, C = np.array([[-0.1, 0.0], [0.05, -0.2]]), np.array([[1.0], [0.0]]), np.array([[0.0, 1.0]])
    np.savez(tmp_path / "matrices.npz", A=A, B=B, C=C)
    (tmp_path / "matrices.json").write_text(
        json.dumps({"A": A.tolist(), "B": B.tolist(), "C": C.tolist(), "note": "of ours"}), encoding="utf-8"
    )
    for given in ("matrices.npz", "matrices.json"):
        model = made(tmp_path, BY_MATRICES.replace("GIVEN", given)).model
        assert np.array_equal(model.A, A)
        assert np.array_equal(model.C, C)
        assert not model.F.any()


def test_a_state_space_is_the_model_with_the_load_behind_the_inputs(tmp_path: Path) -> None:
    space = "from scipy.signal import StateSpace\nplant = StateSpace([[-0.02]], BS, [[1.0]], DS)\n"
    text = BY_MATRICES.replace("GIVEN", "space.py:plant")
    (tmp_path / "space.py").write_text(
        space.replace("BS", "[[0.01, 0.03]]").replace("DS", "[[0.0, 0.5]]"), encoding="utf-8"
    )
    model = made(tmp_path, text + LOAD).model
    assert (model.A, model.B, model.F, model.C, model.D, model.G) == (-0.02, 0.01, 0.03, 1.0, 0.0, 0.5)
    assert model.plant == "linear", "nothing of the file is executed by the services"
    with pytest.raises(ColdloopError, match=r"space\.py:plant: has 2 inputs, not 1: 1 inputs, then load"):
        made(tmp_path, text)
    disturbed = LOAD.replace("[load]", "[[disturbances]]")
    model = made(tmp_path, text + disturbed).model
    assert model.A.tolist() == [[-0.02, 0.03], [0.0, 0.0]], "a disturbance is a state"
    assert not model.F.any(), "there is no load"


def test_a_plant_may_be_of_a_package_that_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = tmp_path / "site"
    installed(site, {"heating.py": HEATER}, {"coldloop.plants": {"heater": "heating:Heater", "gone": "nowhere:Heater"}})
    monkeypatch.syspath_prepend(site)
    text = ONE_BY_ONE.replace("python =", "installed =").replace("heater.py:Heater", "heater")
    there, here = made(tmp_path, text).model, made(tmp_path).model
    assert np.array_equal(there.A, here.A)
    assert there.plant_parameters["source"] == HEATER, "the services need no package"
    for name, said in (("other", "no plant 'other' among the entry points coldloop.plants: gone, heater"),
                       ("gone", "gone, nowhere:Heater, has no source: ImportError: no module nowhere")):  # fmt: skip
        with pytest.raises(ColdloopError, match=said):
            made(tmp_path, text.replace('"heater"\n[[', f'"{name}"\n[['))


def test_what_is_wrong_with_a_process_is_said_in_words(tmp_path: Path) -> None:
    unstable = HEATER.replace("- 2.0 * (x[0] - 300.0)", "- 50.0 + 2.0 * (x[0] - 325.0)")
    assert "unstable: a mode grows" in described(made(tmp_path, plant=unstable))
    assert "band: temperature rests at" in described(made(tmp_path, ONE_BY_ONE.replace("320.0, 330.0", "340.0, 350.0")))
    far = ONE_BY_ONE.replace("[200.0, 500.0]", "[200.0, 2e6]")
    assert "single precision: temperature has steps of 0.12 K, too coarse for the noise of its sensor" in (
        described(made(tmp_path, far))
    )
    kink = HEATER.replace("(u[0] -", "(abs(u[0] - 50.0) + 50.0 -")
    assert "kink" in described(made(tmp_path, plant=kink)) or "controllability" in described(made(tmp_path, plant=kink))


def test_an_unstable_plant_without_loops_is_held_by_nothing_but_mpc(tmp_path: Path) -> None:
    warning = "fail-safe: nothing holds this plant when MPC has no answer"
    assert warning in described(made_from(pendulum(tmp_path)))
    assert warning not in described(made_from(stirred_tank(tmp_path)))


def test_an_integrator_that_grows_or_shrinks_by_rounding_alone_is_neither_unstable_nor_slow(tmp_path: Path) -> None:
    found = made(tmp_path)
    for mode in (1.73e-18, -1.73e-18):
        text = described(replace(found, linear=found.linear._replace(A=np.array([[mode]]))))
        assert "modes      0 /s" in text
        assert "unstable" not in text
        assert "horizon:" not in text


def changed(before: str, after: str) -> str:
    """Return the file with a line changed."""
    assert before in ONE_BY_ONE
    return ONE_BY_ONE.replace(before, after)


BAD_FILES = {
    "no table": ("name = 3 = 4", "process.toml"),
    "no inputs": (changed("[[inputs]]", "[[input]]"), "input"),
    "a name with spaces": (changed('name = "power"', 'name = "the power"'), "inputs"),
    "a name twice": (changed('name = "temperature"', 'name = "POWER"'), "toml: power: two signals"),
    "a name of registers": (changed('name = "power"', 'name = "session"'), "session"),
    "bounds the wrong way round": (changed("high = 100.0", "high = -1.0"), "power"),
    "an operating point outside": (changed("at = 50.0", "at = 150.0"), "power"),
    "no rate": (changed("rate = 10.0", "rate = 0.0"), "rate"),
    "a bound that is infinite": (changed("high = 100.0", "high = inf"), "high"),
    "a band the wrong way round": (changed("[320.0, 330.0]", "[330.0, 320.0]"), "band"),
    "no band at all": (changed("band = [320.0, 330.0]", ""), "band"),
    "noise below nothing": (changed("noise = 0.1", "noise = -0.1"), "noise"),
    "a loop to nowhere": (
        changed("band = [320.0, 330.0]",
                'band = [320.0, 330.0]\nloop = { input = "valve", gain = 1.0, integral_time_s = 1.0 }'),
        "valve",
    ),
    "an unknown key": (changed("rate = 10.0", "rate = 10.0\nspeed = 1.0"), "speed"),
    "a class that is not there": (changed("heater.py:Heater", "heater.py:Cooler"), "Cooler"),
    "a file that is not there": (changed("heater.py:Heater", "cooler.py:Heater"), "cooler.py"),
    "no class named": (changed("heater.py:Heater", "heater.py"), "python"),
    "two plants": (changed("[plant]", '[plant]\nmatrices = "x.npz"'), "plant"),
    "no plant": (changed('python = "heater.py:Heater"', ""), "plant"),
    "a tick of no time": ("tick_s = 0.0\n" + ONE_BY_ONE, "tick_s"),
    "instants that fall": (ONE_BY_ONE + "[prediction]\ndecision_instants = [4, 2]\n", "decision_instants"),
    "constraints behind the horizon": (ONE_BY_ONE + "[prediction]\ndecision_instants = [1, 2]\n", "constraint"),
    "a state that is none": (ONE_BY_ONE + '[[states]]\nname = "pressure"\nwalk = 1.0\n', "pressure"),
    "an output outside its sensor's range": (changed("range = [200.0, 500.0]", "range = [0.0, 10.0]"), "temperature"),
    "an input that weighs nothing": (changed('name = "power"', 'name = "power"\nweight = 1e-12'), "power: weight"),
    "a penalty without end": (changed("range = [200.0, 500.0]", "range = [200.0, 500.0]\npenalty = 1e12"), "penalty"),
    "a keyword of Python": (changed('name = "power"', 'name = "in"'), "in"),
    "a column of the trace": (changed('name = "temperature"', 'name = "tau_u_s"'), "tau_u_s"),
    "a load outside its span": (ONE_BY_ONE + '[load]\nname = "d"\nat = 5.0\nspan = [0.0, 1.0]\n', "d"),
}  # fmt: skip
BAD_PLANTS = {
    "does not run": ("this is no Python", "SyntaxError"),
    "no guess": (HEATER.replace("guess", "gues"), "guess"),
    "too short a guess": (HEATER.replace("[300.0]", "[]"), "guess"),
    "raises": (HEATER.replace("return [(u[0]", "return [(u[7]"), "IndexError"),
    "divides by zero": (HEATER.replace("return [(u[0]", "1 / 0\n        return [(u[0]"), "ZeroDivisionError"),
    "never rests": (HEATER.replace("- 2.0 * (x[0] - 300.0)", "+ 1.0"), "T keeps moving"),
    "states without units": (HEATER.replace('{"T": "K"}', '["T1"]'), "dict of names and units"),
    "a state's name with spaces": (HEATER.replace('"T": "K"', '"the T": "K"'), "dict of names and units"),
    "steps of no time": (HEATER.replace("guess =", "steps_per_tick = 0\n    guess ="), "steps_per_tick"),
    "outputs that raise": (HEATER.replace("return [x[0]]", "return [x[9]]"), "outputs() fails: IndexError"),
    "too many outputs": (HEATER.replace("return [x[0]]", "return [x[0], x[0]]"), "outputs()"),
    "an output that is no number": (HEATER.replace("return [x[0]]", "return [x[0] * float('nan')]"), "not finite"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_file_gets_one_line_that_names_the_place(case: str, tmp_path: Path) -> None:
    text, place = BAD_FILES[case]
    with pytest.raises(ColdloopError) as refused:
        made(tmp_path, text)
    assert "\n" not in str(refused.value)
    assert place in str(refused.value)


@pytest.mark.parametrize("case", BAD_PLANTS)
def test_a_bad_plant_gets_one_line_that_says_why(case: str, tmp_path: Path) -> None:
    plant, why = BAD_PLANTS[case]
    with pytest.raises(ColdloopError) as refused:
        made(tmp_path, plant=plant)
    assert "\n" not in str(refused.value)
    assert why in str(refused.value)


def test_more_signals_than_a_request_carries_are_refused(tmp_path: Path) -> None:
    n = 60
    np.savez(tmp_path / "matrices.npz", A=-np.eye(n), B=np.ones((n, 1)), C=np.eye(1, n))
    with pytest.raises(ColdloopError, match="60 states are too many: the rack's measurement is"):
        made(tmp_path, BY_MATRICES.replace("GIVEN", "matrices.npz"))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("m.json", '{"A": [[-1.0]], "B": [[1.0]]}', "no C; it needs A, B and C"),
        ("m.json", '{"A": [[-1.0], [1.0, 2.0]], "B": [[1.0]], "C": [[1.0]]}', "not a readable NPZ or JSON file"),
        ("m.json", "[" * 100_000, "not a readable NPZ or JSON file"),
        ("m.json", '{"A":' + "[" * 5000 + "]" * 5000 + "}", "nested too deeply"),
        ("m.json", '{"A": [["x"]], "B": [[1.0]], "C": [[1.0]]}', "not a readable NPZ or JSON file"),
        ("m.json", '{"A": [[-1.0]], "B": [[1.0, 2.0]], "C": [[1.0]]}', r"B has shape (1, 2), and not (1, 1)"),
        ("m.json", '{"A": [[NaN]], "B": [[1.0]], "C": [[1.0]]}', "A holds a number that is not finite"),
        ("m.json", "7", "not a readable NPZ or JSON file"),
        ("m.npz", "PK nothing", "not a readable NPZ or JSON file"),
        ("m.py:plant", "plant = 3", "no state space with A, B, C and D"),
        ("m.py:plant", "plan = 3", "plant cannot be made: AttributeError"),
        ("m.py:plant", "raise OSError('no\\nplant')", "plant cannot be made: OSError: no plant"),
        ("m.py:plant", "class plant: A = B = C = D = [[1.0]]; dt = 0.1", "has a sampling time of 0.1 s"),
        ("m.py:plant", "class plant: A = B = C = D = [[1.0]]; dt = True", "has a sampling time"),
    ],
)
def test_matrices_that_are_none_get_one_line(name: str, content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / name.partition(":")[0]).write_text(content, encoding="utf-8")
    with pytest.raises(ColdloopError) as refused:
        made(tmp_path, BY_MATRICES.replace("GIVEN", name))
    assert "\n" not in str(refused.value)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("content", "A", "C"),
    [
        ('{"A": -0.02, "B": 0.01, "C": 1, "F": 0.5, "D": 0, "G": [0]}', [[-0.02]], [[1.0]]),
        ('{"A": [[-0.02, 0], [1, -1]], "B": [0.01, 0], "C": [0, 1]}', [[-0.02, 0.0], [1.0, -1.0]], [[0.0, 1.0]]),
    ],
)
def test_a_number_is_a_matrix_of_one_and_a_list_a_row_or_a_column(
    content: str, A: list[list[float]], C: list[list[float]], tmp_path: Path
) -> None:
    (tmp_path / "m.json").write_text(content, encoding="utf-8")
    model = made(tmp_path, BY_MATRICES.replace("GIVEN", "m.json")).model
    assert (model.A.tolist(), model.C.tolist()) == (A, C)
    assert model.B.tolist() == [[0.01], [0.0]][: len(A)]


def test_transfer_functions_of_other_tools_are_realised() -> None:
    """As SciPy has them, and as python-control has them, at a complex frequency."""
    at = 0.3 + 0.7j
    whole = SimpleNamespace(
        num=[[[1.0], [2.0, 1.0], [3.0]], [[0.0], [3.0, 0.0, 1.0], [1.0]]],
        den=[[[1.0, 1.0], [2.0, 2.0], [1.0, 4.0]], [[1.0], [1.0, 3.0, 2.0], [0.0, 1.0, 0.5]]],
    )
    for given in (whole, signal.TransferFunction([[1.0, 0.0], [0.0, 3.0]], [2.0, 2.0, 1.0])):
        M = realised(given)
        value = M["C"] @ np.linalg.solve(at * np.eye(len(M["A"])) - M["A"], M["B"]) + M["D"]
        for i, row in enumerate(value):
            for j, found in enumerate(row):
                num, den = (given.num[i], given.den) if given is not whole else (given.num[i][j], given.den[i][j])
                assert found == pytest.approx(np.polyval(num, at) / np.polyval(den, at), rel=1e-12)
    assert len(realised(whole)["A"]) == 1 + 1 + 2 + 1  # the first two inputs of the first output share a state
    with pytest.raises(ValueError, match="output 1 by input 1 is not proper"):
        realised(SimpleNamespace(num=[[[1.0, 0.0, 0.0]]], den=[[[1.0, 1.0]]]))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("from scipy.signal import TransferFunction\nplant = TransferFunction([0.5], [50.0, 1.0])", ""),
        ("from scipy.signal import ZerosPolesGain\nplant = ZerosPolesGain([], [-0.02], 0.01)", ""),
        ("from scipy.signal import TransferFunction\nplant = TransferFunction([1, 0, 0], [1.0, 1.0])", "is not proper"),
        ("from scipy.signal import TransferFunction\nplant = TransferFunction([2.0], [4.0])", "it has no states"),
    ],
)
def test_objects_with_transfer_functions_are_plants(content: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "m.py").write_text(content, encoding="utf-8")
    text = BY_MATRICES.replace("GIVEN", "m.py:plant")
    if said:
        with pytest.raises(ColdloopError, match=said):
            made(tmp_path, text)
        return
    model = made(tmp_path, text).model
    assert model.A[0, 0] == pytest.approx(-0.02)
    assert (model.C @ model.B)[0, 0] == pytest.approx(0.01)


def test_an_inverse_response_is_said_with_its_numbers(tmp_path: Path) -> None:
    """Of (1 - 20 s) / (10 s + 1)^2: 1 - (1 + 3 T) exp(-T) with T = t / 10 s is -0.54 at 6.7 s and 0 at 19 s."""
    (tmp_path / "m.json").write_text('{"A": [[-0.1, 0], [0.1, -0.1]], "B": [0.3, -0.2], "C": [0, 1]}', encoding="utf-8")
    text = described(made(tmp_path, BY_MATRICES.replace("GIVEN", "m.json")))
    assert "power temperature first moves the other way, by 0.54 of its change in the end, until 20 s" in text
    (tmp_path / "m.json").write_text('{"A": [[-0.1, 0], [0.1, -0.1]], "B": [0.1, 0], "C": [0, 1]}', encoding="utf-8")
    assert "inverse response" not in described(made(tmp_path, BY_MATRICES.replace("GIVEN", "m.json")))
    assert "inverse response" not in described(made_from(EXAMPLES / "wood_berry.toml"))


@pytest.mark.usefixtures("programs")
def test_the_command_prints_it_and_writes_nothing_that_is_half_made(tmp_path: Path, coldloop: "Coldloop") -> None:
    made(tmp_path)
    done = coldloop("process", tmp_path / "process.toml", "--out", tmp_path / "model.json")
    assert done.code == 0, done.complaints
    assert "heater: 1 input, 1 output, 1 state; " in done.out
    assert Process.model_validate(made(tmp_path).model.process).inputs[0].name == "power"
    (tmp_path / "process.toml").write_text("name = 3", encoding="utf-8")
    failed = coldloop("process", tmp_path / "process.toml", "--out", tmp_path / "other.json")
    assert failed.code != 0
    assert len(failed.complaints) == 1
    assert not (tmp_path / "other.json").exists()


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize(
    ("begins", "said"),
    [
        ("while True: pass", "has not come to an end within 1 s"),
        ("import os; os.kill(os.getpid(), 9)", "has ended the process that it ran in (SIGKILL)"),
        ("import sys; sys.exit(0)", "Heater cannot be made: SystemExit: 0"),
    ],
)
def test_a_plant_that_does_not_return_gets_one_line(
    begins: str, said: str, tmp_path: Path, coldloop: "Coldloop"
) -> None:
    (tmp_path / "process.toml").write_text(ONE_BY_ONE, encoding="utf-8")
    (tmp_path / "heater.py").write_text(f"{begins}\n{HEATER}", encoding="utf-8")
    failed = coldloop("process", tmp_path / "process.toml", "--limit", "1")
    assert failed.code != 0
    assert len(failed.complaints) == 1
    assert said in failed.complaints[0]


def test_an_integrator_and_a_load_leave_out_the_constants_that_nothing_tells_from_them(tmp_path: Path) -> None:
    """The level of a tank is the integral of what flows in: its gauge's error is no other thing than level."""
    tank = HEATER.replace("(u[0] - 2.0 * (x[0] - 300.0)) / 100.0", "(u[0] - 50.0) / 100.0")
    assert made(tmp_path, plant=tank.replace("300.0", "325.0")).process.constants == ()
    assert made(tmp_path).process.constants == ("temperature",)
    load = '[load]\nname = "sun"\nat = 0.0\nspan = [-1.0, 1.0]\n'
    assert made(tmp_path, ONE_BY_ONE + load, HEATER.replace("u[0] -", "u[0] + w -")).process.constants == ()
    two = made_from(EXAMPLES / "quadruple_tank.toml").process.constants
    assert len(two) == 1


def test_what_the_load_does_is_left_out_of_the_model_where_none_is_declared(tmp_path: Path) -> None:
    assert not made(tmp_path, plant=HEATER.replace("u[0] -", "u[0] + w -")).model.F.any()


def test_a_small_state_rests_and_is_linearised_as_a_large_one(tmp_path: Path) -> None:
    """In MK: all numbers of the state a million times smaller."""
    small = HEATER.replace("x[0] - 300.0", "1e6 * x[0] - 300.0").replace("/ 100.0", "/ 100.0e6")
    small = small.replace("return [x[0]]", "return [1e6 * x[0]]").replace("[300.0]", "[300.0e-6]")
    model = made(tmp_path, plant=small).model
    assert model.x0 == pytest.approx([325.0e-6])
    assert pytest.approx(np.array([[-0.02]]), rel=1e-6) == model.A


def test_loops_and_dead_times_are_looked_at(tmp_path: Path) -> None:
    loop = 'loop = { input = "power", gain = -5.0, integral_time_s = 60.0 }\n'
    assert "wrong sign" in described(made(tmp_path, ONE_BY_ONE + loop))
    assert "wrong sign" not in described(made(tmp_path, ONE_BY_ONE + loop.replace("-5.0", "5.0")))
    column = (EXAMPLES / "wood_berry.toml").read_text(encoding="utf-8").replace("delay_s = 60.0", "delay_s = 61.0")
    assert "xD after reflux, 61 s, is simulated as 60 s" in described(made(tmp_path, column))


def test_what_is_wrong_with_a_file_as_a_whole_is_said_of_this_file_and_without_its_content(tmp_path: Path) -> None:
    made(tmp_path)
    file = next(tmp_path.glob("*.toml"))
    text = file.read_text(encoding="utf-8")
    for wrong, why in (
        (text.replace('name = "power"', 'name = "temperature"'), "temperature: two signals have this name"),
        (text.replace("rate =", "# rate ="), "inputs.0.rate: is missing"),
        (text.replace("low = 0.0", "low = 900.0"), "inputs.0: power: low, high: give the lower end first"),
    ):
        file.write_text(wrong, encoding="utf-8")
        with pytest.raises(ColdloopError) as refused:
            made_from(file)
        assert str(refused.value).startswith(f"{file}: {why}")
        assert "{" not in str(refused.value)
    file.write_text(text, encoding="utf-8-sig")
    assert made_from(file).process.name == "heater"


def test_services_know_a_process_by_what_is_declared_and_not_by_the_last_bits_of_its_matrices(tmp_path: Path) -> None:
    model = made(tmp_path).model
    other = replace(model, F_tick=np.nextafter(model.F_tick, 1.0), A=np.nextafter(model.A, 1.0))
    other.save(tmp_path / "other.json")
    assert other.digest != model.digest
    assert read_header(tmp_path / "other.json").short_digest == other.short_digest == model.short_digest
    comment = made(tmp_path, "# the same\n" + ONE_BY_ONE).model
    assert comment.short_digest == model.short_digest
    for text, plant in ((ONE_BY_ONE.replace("10.0\n[[o", "11.0\n[[o"), HEATER), (ONE_BY_ONE, HEATER + "\n")):
        assert made(tmp_path, text, plant).model.short_digest != model.short_digest
