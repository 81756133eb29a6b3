"""A plant with a bath by other names, in another order, is the cold box: same laws; and one line for what is wrong."""

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from coldloop.errors import ColdloopError
from coldloop.process.cold_box import COLD_BOX, L1, T5
from coldloop.process.lti_model import load
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.making import made_from
from tests.harness.process_files import TANK
from tests.harness.processes import Processes
from tests.process.bath_laws import answers
from tests.process.runs import run, started
from tests.process.test_processes import ROOT

INPUTS: Final = [one.name for one in COLD_BOX.inputs]
OUTPUTS: Final = [one.name for one in COLD_BOX.outputs]
STATES: Final = [one.name for one in COLD_BOX.states]
UNIT_W: Final = 10.0
"""Of the load, in the other process."""
MODEL: Final = load(DEFAULT_MODEL_FILE)
DISTURBED: Final = ("CV155", "CV156", "T5")
PROGRAM: Final = "optimizer_plc.program."
SETTINGS: Final = (f"{PROGRAM}design.target=load", f"{PROGRAM}cold_end.approach_k=0.3")


class Order(NamedTuple):
    """Which of the cold box's signals stands in each place of another process."""

    inputs: Sequence[int]
    outputs: Sequence[int]
    states: Sequence[int]

    @property
    def names(self) -> dict[str, str]:
        """What each signal and state of the cold box is called there; P1, which is both, as the state."""
        kinds = (("in", INPUTS, self.inputs), ("out", OUTPUTS, self.outputs), ("x", STATES, self.states))
        return {known[one]: f"{kind}{place}" for kind, known, order in kinds for place, one in enumerate(order, 1)}


def shuffled() -> Order:
    """Return one at random, and without P10, for which a disturbance beside the load leaves no room."""
    random = np.random.default_rng(0)
    inputs, outputs, states = (random.permutation(len(names)).tolist() for names in (INPUTS, OUTPUTS, STATES))
    assert all(place != one for place, one in enumerate(inputs))
    assert outputs.index(T5) < outputs.index(L1)
    return Order(inputs, [one for one in outputs if OUTPUTS[one] != "P10"], states)


SAME: Final = Order(range(len(INPUTS)), range(len(OUTPUTS)), range(len(STATES)))
OTHER: Final = shuffled()


def toml(keys: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value)}" for key, value in keys.items()]


def bath_section() -> dict[str, Any]:
    """Return the cold box's bath by the names and in the unit of load of `OTHER`."""
    assert COLD_BOX.bath is not None
    section = COLD_BOX.bath.model_dump()
    for key, value in section.items():
        if isinstance(value, str):
            section[key] = OTHER.names[value]
        elif isinstance(value, float):
            section[key] = value / UNIT_W
        else:
            section[key] = [OTHER.names[each] if isinstance(each, str) else each / UNIT_W for each in value]
    return section


def signals() -> Iterable[str]:
    """Return the lines of inputs and outputs in the order of `OTHER`."""
    for place in OTHER.inputs:
        one = COLD_BOX.inputs[place]
        yield "[[inputs]]"
        yield from toml({"name": OTHER.names[one.name], "unit": one.unit, "at": MODEL.u0[place]})
        yield from toml({"low": one.low, "high": one.high, "rate": one.rate})
    for place in OTHER.outputs:
        output = COLD_BOX.outputs[place]
        yield "[[outputs]]"
        yield from toml({"name": OTHER.names[output.name], "unit": output.unit, "at": MODEL.y0[place]})
        yield from toml({"range": [-1e3, 1e4], "noise": 0.01})
        if output.loop is not None:
            loop = output.loop.model_dump() | {"input": OTHER.names[output.loop.input]}
            yield from toml({"band": output.band, "penalty": output.penalty})
            yield f"loop = {{ {', '.join(toml({key: loop[key] for key in ('input', 'gain', 'integral_time_s')}))} }}"


def renamed(folder: Path, **changes: object) -> Path:
    """Write the cold box's linear model as a process of matrices, with a leak of heat into one of its exchangers.

    Keys of its bath are changed, or left out (None).
    """
    u, y, x = map(np.array, OTHER)
    leak = 1e-3 * (x == STATES.index("T_nef34_6"))
    np.savez(
        folder / "matrices.npz", A=MODEL.A[np.ix_(x, x)], B=MODEL.B[np.ix_(x, u)], C=MODEL.C[np.ix_(y, x)],
        D=MODEL.D[np.ix_(y, u)], F=np.column_stack([UNIT_W * MODEL.F[x], leak]),
        G=np.column_stack([UNIT_W * MODEL.G[y], 0.0 * y]),
    )  # fmt: skip
    bath = {key: value for key, value in (bath_section() | changes).items() if value is not None}
    w0, step = MODEL.w0 / UNIT_W, 60.0 / UNIT_W
    heat = {"name": "boiling", "unit": "daW", "at": w0, "span": [w0 - step, w0 + step], "walk": 3.0 / UNIT_W}
    instants = {key: getattr(COLD_BOX, key) for key in ("decision_instants", "constraint_instants")}
    lines = ['name = "renamed"', "[plant]", 'matrices = "matrices.npz"', "[bath]", *toml(bath), "[load]", *toml(heat)]
    lines += ["[[disturbances]]", *toml({"name": "leak", "at": 0.0, "span": [-1.0, 1.0]})]
    lines += [*signals(), "[prediction]", *toml(instants)]
    (folder / "process.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "process.toml"


# -- the same laws -----------------------------------------------------------------------------------------------------


def situations() -> list[dict[str, Any]]:
    """Return deviations, constants and loads at random, by the cold box's names and in its order; some not held."""
    random = np.random.default_rng(7)
    return [
        {
            "states": random.normal(scale=0.1, size=len(STATES)).tolist(),
            "constants": dict(zip(DISTURBED, random.normal(size=3), strict=True)),
            "u": dict(zip(INPUTS, random.normal(scale=(3.0, 10.0, 3.0)), strict=True)),
            "y": {"L1": random.normal(), "T1": random.normal(scale=0.1), "T2": random.normal(scale=0.1)},
            "w": random.uniform(-330.0, 200.0), "mismatch": random.normal(),
        }
        for _ in range(40)
    ]  # fmt: skip


def courses() -> list[dict[str, float]]:
    """Return what a cool-down measures, to its end, with the turbine's wheel standing in some of it."""
    warm = dict.fromkeys(OUTPUTS, 0.0) | {"T1": 250.0, "T5": 200.0, "P5": 1.1, "P6": 1.2}
    cold = warm | {"T5": 10.0, "P6": 12.0}
    return [warm, cold, *(cold | {"L1": level} for level in (2.0, 59.5, 60.0, 60.0))]


def laws(order: Order, model: Path | None) -> dict[str, Any]:
    """Return what a process makes of the situations."""
    names = order.names if model else {name: name for name in (*INPUTS, *OUTPUTS)}
    unit_w = UNIT_W if model else 1.0
    cold_box = {
        "input_scale": [one.scale for one in COLD_BOX.inputs],
        "input_weight": [one.weight for one in COLD_BOX.inputs],
    }
    by_name = {key: [values[place] for place in order.inputs] for key, values in cold_box.items()}
    given = {
        "settings": {
            "design": by_name | {"target": "load", "band_margin": [0.1, 0.1]},
            "cold_end": {"approach_k": 0.3, "opening_from": 30.0},
            "estimator": {"disturbances": [names[name] for name in DISTURBED]},
            "preset": "paper",
        },
        "situations": [
            {
                "states": [*(each["states"][place] for place in order.states), *([0.0] if model else [])],
                "w": each["w"] / unit_w,
                "mismatch": each["mismatch"] / unit_w,
                **{key: {names[name]: value for name, value in each[key].items()} for key in ("constants", "u", "y")},
            }
            for each in situations()
        ],
        "courses": [{names[name]: value for name, value in y.items() if name in names} for y in courses()],
        "by loops": [(50.0, 20.0, 30.0)[place] for place in order.inputs],
    }
    return answers(model or DEFAULT_MODEL_FILE, given)


def test_names_and_order_of_its_signals_do_not_matter_to_the_laws_of_a_bath(
    processes: Processes, tmp_path: Path
) -> None:
    model = tmp_path / "model.json"
    assert started(processes, "process", renamed(tmp_path), "--out", model).code == 0
    own, other = laws(SAME, None), laws(OTHER, model)
    u, x = list(OTHER.inputs), list(OTHER.states)
    assert np.count_nonzero(own["weights"]) == len(STATES)
    assert other["weights"] == pytest.approx([*np.array(own["weights"])[x], 0.0])
    mine, theirs = (
        {key: np.array([each[key] for each in found["situations"]]) for key in found["situations"][0]}
        for found in (own, other)
    )
    assert min(np.ptp(mine[key], axis=0).min() for key in ("limit", "loads")) > 0.1
    by_input = mine["by input"].reshape(40, -1, len(u))[:, :, u].reshape(40, -1)
    assert theirs["by input"] == pytest.approx(by_input, abs=1e-6)
    assert theirs["loads"] * UNIT_W == pytest.approx(mine["loads"], rel=1e-6, abs=1e-5)
    assert theirs["limit"] == pytest.approx(mine["limit"])
    assert theirs["rest"] == pytest.approx(np.column_stack([mine["rest"][:, x], np.zeros(40)]), rel=1e-6, abs=1e-6)
    for my, their in zip(own["cool down"], other["cool down"], strict=True):
        assert their == [my[0], *(my[1:][place] for place in u)]
    assert len({step for step, *_ in own["cool down"]}) == 5
    assert own["may stand"] == [["V1"], [], [], [], [], []]
    assert other["may stand"] == [[OTHER.names[name] for name in names] for names in own["may stand"]]


@pytest.mark.night
def test_it_runs_with_the_targets_and_the_limit_of_its_feed(processes: Processes, tmp_path: Path) -> None:
    file, options = renamed(tmp_path), ["--load", "a", "--duration", "30min"]
    unlimited = run(processes, file, tmp_path / "unlimited", "--in-process", *options)
    for assignment in (*SETTINGS, f"{PROGRAM}cold_end.opening_from=43"):
        options += ["--set", assignment]
    here = run(processes, file, tmp_path / "here", "--in-process", *options)
    there = run(processes, file, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"] != unlimited["trace_sha256"]
    for name in (OTHER.names["L1"], OTHER.names["T5"]):
        assert here[f"{name}_outside_band_pct"] == 0.0
    assert "alarm raised" not in set(pd.read_parquet(tmp_path / "there" / "events.parquet")["kind"])


def test_the_section_that_the_documentation_shows_is_the_cold_boxs() -> None:
    page = (ROOT / "docs" / "your-plant.md").read_text(encoding="utf-8")
    shown = tomllib.loads(page[page.index("[bath]") :].partition("```")[0])["bath"]
    assert COLD_BOX.bath is not None
    known = COLD_BOX.bath.model_dump()
    assert {
        key: list(value) if isinstance(value, tuple) else value for key, value in known.items() if key in shown
    } == shown


# -- what is wrong -----------------------------------------------------------------------------------------------------


BAD_BATHS: Final[dict[str, tuple[dict[str, object], str]]] = {
    "no level": ({"level": None}, "bath.level: is missing"),
    "a key that is none": ({"depth": "out1"}, "bath.depth"),
    "an output that there is not": ({"temperature": "T99"}, "bath: T99 is no output"),
    "an input as an output": ({"temperature": "in1"}, "bath: in1 is no output"),
    "a level without a band": ({"level": OTHER.names["P9"]}, f"bath: {OTHER.names['P9']} is no output with a band"),
    "one output for two": ({"temperature": OTHER.names["T5"]}, f"bath: {OTHER.names['T5']} is named twice"),
    "one input for two": ({"feed": OTHER.names["CV156"]}, "bath: its inputs are feed, heater and turbine_valve"),
    "a state that there is not": ({"level_state": "V_l"}, "bath: V_l is no state"),
    "a state twice": ({"pressure_state": OTHER.names["V_l"]}, "is named twice"),
    "a speed without pressures": ({"turbine_pressures": None}, "two turbine_pressures"),
    "pressures without a speed": ({"turbine_speed": None}, "two turbine_pressures"),
    "a level that does not show its state": ({"level_state": OTHER.names["T_nef1_3"], "temperature_states": []},
                                             "name the state that is its level"),
    "an empty name": ({"level": ""}, "bath: an empty name is no output"),
    "a reserve that is no number": ({"load_reserve": "much"}, "bath.load_reserve"),
    "a disturbance as a state": ({"temperature_states": ["x1", "leak"], "level_state": None, "pressure_state": None},
                                 "bath: leak is a disturbance"),
    "loads without the one that is held": ({"holdable_load": [50.0, 90.0]}, "is without the operating point"),
    "no text": ({"feed": 3}, "bath.feed"),
    "loads the wrong way round": ({"holdable_load": [55.0, 12.0]}, "holdable_load: give the least load"),
    "a reserve below nothing": ({"load_reserve": -1.0}, "load_reserve and least_load_error are 0 or more"),
    "a load that is none": ({"holdable_load": [12.0, "much"]}, "bath.holdable_load"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_BATHS)
def test_a_wrong_bath_gets_one_line(case: str, tmp_path: Path) -> None:
    changes, place = BAD_BATHS[case]
    with pytest.raises(ColdloopError) as refused:
        made_from(renamed(tmp_path, **changes))
    assert "\n" not in str(refused.value)
    assert place in str(refused.value)


def unit(signal: str, before: str, after: str) -> tuple[str, str]:
    """Return lines with a signal's unit, and with another one."""
    return f'name = "{OTHER.names[signal]}"\nunit = "{before}"', f'name = "{OTHER.names[signal]}"\nunit = "{after}"'


BAD_SIGNALS: Final = {
    "a valve in parts of 1": (*unit("CV155", "%", "1"), "has to be in %, not in '1'"),
    "a level in parts of 1": (*unit("L1", "%", "1"), "has to be in %, not in '1'"),
    "degrees": (*unit("T2", "K", "degC"), "has to be in K, not in 'degC'"),
    "a level by its feed": (
        f'loop = {{ input = "{OTHER.names["NCR22_A"]}"', f'loop = {{ input = "{OTHER.names["CV155"]}"',
        f"a cool-down needs it on {OTHER.names['NCR22_A']}",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_SIGNALS)
def test_signals_that_do_not_suit_a_bath_get_one_line(case: str, tmp_path: Path) -> None:
    before, after, place = BAD_SIGNALS[case]
    file = renamed(tmp_path)
    text = file.read_text(encoding="utf-8")
    assert before in text
    file.write_text(text.replace(before, after), encoding="utf-8")
    with pytest.raises(ColdloopError) as refused:
        made_from(file)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith(f"{file}: ")
    assert place in str(refused.value)


def test_a_bath_that_nothing_boils_is_refused(tmp_path: Path) -> None:
    file = renamed(tmp_path)
    text = file.read_text(encoding="utf-8")
    begin, end = text.index("[load]"), text.index("[[disturbances]]")
    file.write_text(text[:begin] + text[end:], encoding="utf-8")
    with pytest.raises(ColdloopError, match="bath: declare the load that boils it off"):
        made_from(file)


def with_matrices(folder: Path, **matrices: NDArray[np.float64]) -> Path:
    """Write the process with other matrices."""
    file = renamed(folder)
    with np.load(folder / "matrices.npz") as known:
        np.savez(folder / "matrices.npz", **{**known, **matrices})
    return file


def test_a_level_that_no_load_lets_rest_is_refused_when_the_model_is_made(tmp_path: Path) -> None:
    nothing = np.zeros((len(STATES), 2))
    with pytest.raises(ColdloopError, match="no load lets the states and"):
        made_from(with_matrices(tmp_path, F=nothing, G=np.zeros((len(OTHER.outputs), 2))))


def test_a_level_that_does_not_integrate_is_named(tmp_path: Path) -> None:
    assert "bath:" not in described(made_from(renamed(tmp_path)))
    x = np.array(OTHER.states)
    leaking = MODEL.A[np.ix_(x, x)] - 0.01 * np.eye(len(x))
    assert "bath: no mode integrates as a level does" in described(made_from(with_matrices(tmp_path, A=leaking)))


@pytest.mark.parametrize(
    "assignment", [SETTINGS[0], *(pytest.param(each, marks=pytest.mark.night) for each in SETTINGS[1:])]
)
def test_what_only_a_bath_has_is_refused_elsewhere(assignment: str, processes: Processes, tmp_path: Path) -> None:
    options = ("run", "--in-process", "--set", assignment, "--out", tmp_path / "run")
    code, _, complaints = started(processes, "--process", TANK, *options)
    assert code != 0
    assert len(complaints.splitlines()) == 1
    assert "bath" in complaints
    assert not (tmp_path / "run").exists()
