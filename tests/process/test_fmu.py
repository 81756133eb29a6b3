"""A plant that is an FMU: of other people, of pythonfmu and pythonfmu3, and of C, against closed forms."""

import gc
import importlib.metadata
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from coldloop.errors import ColdloopError
from coldloop_plant.fmu import Fmu, FmuSimulation, Wiring
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.making import Made, made_from
from tests.harness.process_files import EXAMPLES, fmu
from tests.harness.processes import PROGRAM_S, Processes
from tests.process.runs import run

fmpy = pytest.importorskip("fmpy")

HERE: Final = Path(__file__).parent
TANKS: Final = """
name = "tanks"
[plant]
fmu = "two_tanks.fmu"
[[inputs]]
name = "feed"
variable = "u"
at = 1.0
low = 0.0
high = 2.0
rate = 0.5
[[outputs]]
name = "y"
range = [0.0, 20.0]
noise = 0.01
band = [5.0, 8.0]
[load]
name = "w"
at = 0.1
span = [-1.0, 1.0]
"""
OSCILLATOR: Final = """
name = "oscillator"
tick_s = 0.1
ticks_per_sample = 5
[plant]
fmu = "HarmonicOscillator6D.fmu"
start = { "c[0]" = 1.0 }
[[inputs]]
name = "force"
variable = "f[0]"
unit = "N"
at = 1.0
low = -3.0
high = 3.0
rate = 1.0
[[outputs]]
name = "x"
variable = "x[0]"
range = [-10.0, 10.0]
noise = 0.001
band = [0.9, 1.1]
"""


def written(folder: Path, text: str) -> Path:
    """Write a process file."""
    (folder / "process.toml").write_text(text, encoding="utf-8")
    return folder / "process.toml"


def made(folder: Path, text: str) -> Made:
    """Return what is made from a process file beside an FMU."""
    return made_from(written(folder, text))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory, programs: None) -> Path:  # noqa: ARG001 a mark
    """Compile the FMU in C, once."""
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    folder = tmp_path_factory.mktemp("compiled")
    headers, library = Path(fmpy.__file__).parent / "c-code", folder / "two_tanks.so"
    command = ["gcc", "-shared", "-fPIC", f"-I{headers}", "-o", str(library), str(HERE / "two_tanks.c")]
    subprocess.run(command, check=True)
    return library


def tanks(folder: Path, library: Path, description: str | None = None, *, platform: str = fmpy.platform) -> Path:
    """Pack the FMU in C, with its description, or another."""
    with zipfile.ZipFile(folder / "two_tanks.fmu", "w") as packed:
        packed.writestr("modelDescription.xml", description or (HERE / "two_tanks.xml").read_text(encoding="utf-8"))
        packed.write(library, f"binaries/{platform}/two_tanks{'.so' if platform == fmpy.platform else '.dll'}")
    return folder / "two_tanks.fmu"


def foreign(folder: Path) -> None:
    """Put an FMU beside a process file that other people have made: it is in the package py-crane, under MIT."""
    files = importlib.metadata.files("py-crane") or []
    oscillator = next(file for file in files if file.name == "HarmonicOscillator6D.fmu")
    shutil.copy(str(oscillator.locate()), folder)


@pytest.fixture(autouse=True)
def unpacked_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let FMUs of this test be unpacked where those of no other are."""
    folder = tmp_path / "unpacked"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", str(folder))


def left_behind() -> list[str]:
    """Return the folders of unpacked FMUs."""
    gc.collect()
    return [path.name for path in Path(tempfile.gettempdir()).glob("coldloop-fmu-*")]


# -- the linear model -------------------------------------------------------------------------------------------------


def test_an_oscillator_of_other_people_has_the_poles_of_its_equation(tmp_path: Path) -> None:
    """m x'' + c x' + k x = f with m = k = c = 1: poles -1/2 +- i sqrt(3)/2, and 1 m for 1 N."""
    foreign(tmp_path)
    found = made(tmp_path, OSCILLATOR)
    model = found.model
    assert sorted(np.linalg.eigvals(model.A), key=lambda pole: pole.imag) == pytest.approx(
        [-0.5 - 0.75**0.5 * 1j, -0.5 + 0.75**0.5 * 1j], rel=1e-4
    )
    assert (model.C @ np.linalg.solve(-model.A, model.B))[0, 0] == pytest.approx(1.0, rel=1e-4)
    assert model.y0 == pytest.approx([1.0], rel=1e-5)
    assert model.output_units == ("meter",)
    assert "identified with 2 states" in described(found)


def test_derivatives_of_an_fmu_are_taken_where_it_has_them(compiled: Path, tmp_path: Path) -> None:
    """At rest x1 = 5 u = 5, x2 = (0.05 x1 + w) / 0.2 = 1.75."""
    tanks(tmp_path, compiled)
    found = made(tmp_path, TANKS)
    model = found.model
    assert np.array_equal(model.A, [[-0.1, 0.0], [0.05, -0.2]])
    assert np.array_equal(model.B, [[0.5], [0.0]])
    assert np.array_equal(model.F, [0.0, 1.0])
    assert np.array_equal(model.C, [[0.0, 1.0]])
    assert not model.D.any()
    assert model.x0 == pytest.approx([5.0, 1.75], rel=1e-4)
    assert (model.state_names, model.state_units) == (("tank_x_1", "tank_x_2"), ("m", "m"))
    assert (model.input_units, model.output_units) == (("m3/s",), ("m",))
    assert "directional derivatives" in described(found)


def test_an_fmu_without_them_is_differentiated_by_its_start_values(compiled: Path, tmp_path: Path) -> None:
    text = (HERE / "two_tanks.xml").read_text(encoding="utf-8")
    tanks(tmp_path, compiled, text.replace('providesDirectionalDerivative="true"', ""))
    found = made(tmp_path, TANKS)
    model = found.model
    assert np.array([[-0.1, 0.0], [0.05, -0.2]]) == pytest.approx(model.A, abs=1e-8)
    assert np.array([0.0, 1.0]) == pytest.approx(model.F, abs=1e-8)
    assert "differences of start values" in described(found)


@pytest.mark.usefixtures("programs")
def test_an_fmu_that_hides_its_states_is_identified_and_has_the_gains_of_its_equations(tmp_path: Path) -> None:
    hidden = made_from(fmu(tmp_path)).model
    known = made_from(EXAMPLES / "quadruple_tank.toml").model
    assert hidden.y0 == pytest.approx(known.y0, abs=1e-3)
    gains = [model.C @ model.discretised(300.0).B for model in (hidden, known)]
    assert gains[0] == pytest.approx(gains[1], rel=0.01)
    loads = [model.C @ model.discretised(300.0).F for model in (hidden, known)]
    assert loads[0] == pytest.approx(loads[1], rel=0.02, abs=0.01)


@pytest.mark.usefixtures("programs")
def test_an_fmu_of_fmi_3(tmp_path: Path) -> None:
    """dx/dt = (u - x) / 20: by Euler's method with 0.25 s a pole of 0.9875 a step, a gain of 1."""
    (tmp_path / "lag.py").write_text(LAG, encoding="utf-8")
    command = [sys.executable, "-m", "pythonfmu3", "build", "-f", "lag.py"]
    subprocess.run(command, check=True, cwd=tmp_path, capture_output=True)
    text = TANKS.replace("two_tanks.fmu", "Lag.fmu").split("[load]")[0]
    model = made(tmp_path, text.replace("[5.0, 8.0]", "[0.5, 1.5]")).model
    assert np.linalg.eigvals(model.A) == pytest.approx([np.log(0.9875) / 0.25], rel=1e-4)
    assert (model.C @ np.linalg.solve(-model.A, model.B))[0, 0] == pytest.approx(1.0, rel=1e-4)


LAG: Final = """
from pythonfmu3 import Fmi3Causality, Fmi3Slave, Fmi3StepResult, Fmi3Status, Float64, Fmi3Variability

class Lag(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.u, self.y = 0.0, 0.0, 0.0
        continuous = Fmi3Variability.continuous
        self.register_variable(Float64("time", causality=Fmi3Causality.independent, variability=continuous))
        self.register_variable(Float64("u", causality=Fmi3Causality.input, variability=continuous, start=0.0))
        self.register_variable(Float64("y", causality=Fmi3Causality.output, variability=continuous))

    def do_step(self, current_time, step_size):
        self.y += step_size / 20.0 * (self.u - self.y)
        return Fmi3StepResult(status=Fmi3Status.ok)
"""


@pytest.mark.usefixtures("programs")
def test_elements_of_arrays_and_whole_numbers_are_inputs(tmp_path: Path) -> None:
    """dx/dt = (u[2] + n - x) / 20 where the pump is on: a gain of 1 of both."""
    text = LAG.replace("Lag", "Pumped").replace("import", "import Boolean, Dimension, Int32,", 1)
    text = text.replace('Float64("u", causality=Fmi3Causality.input, variability=continuous, start=0.0)',
                        'Float64("u", causality=Fmi3Causality.input, variability=continuous, start=[0.0, 0.0], '
                        'dimensions=[Dimension(start="2")], getter=lambda: self.u, '
                        'setter=lambda given: self.u.__setitem__(slice(2), given))')  # fmt: skip
    discrete = "causality=Fmi3Causality.input, variability=Fmi3Variability.discrete"
    more = f'        self.register_variable(Int32("n", {discrete}, start=0))\n'
    more += f'        self.register_variable(Boolean("on", {discrete}, start=False))\n'
    text = text.replace(
        "self.u, self.y = 0.0, 0.0, 0.0", "self.u, self.n, self.on, self.y = 0.0, [0.0, 0.0], 0, False, 0.0"
    )
    text = text.replace("(self.u - self.y)", "(self.on * (self.u[1] + self.n) - self.y)")
    text = text.replace("\n    def do_step", f"{more}\n    def do_step")
    (tmp_path / "pumped.py").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pythonfmu3", "build", "-f", "pumped.py"]
    subprocess.run(command, check=True, cwd=tmp_path, capture_output=True)
    toml = TANKS.replace("two_tanks.fmu", "Pumped.fmu").split("[load]")[0].replace("[5.0, 8.0]", "[3.5, 4.5]")
    toml = toml.replace('"u"', '"u[2]"').replace("[[outputs]]", NUMBER_OF_PUMPS + "[[outputs]]")
    found = made(tmp_path, toml.replace("[[inputs", "start = { on = 1.0 }\n[[inputs", 1))
    model = found.model
    assert (model.C @ np.linalg.solve(-model.A, model.B))[0] == pytest.approx([1.0, 1.0], rel=1e-3)
    assert model.y0 == pytest.approx([4.0], rel=1e-4)
    assert "n is of type Int32: what it is given is rounded" in described(found)
    with pytest.raises(ColdloopError, match=r"u\[3\] is no single number: elements are u\[1\] to u\[2\]"):
        made(tmp_path, toml.replace("u[2]", "u[3]"))


NUMBER_OF_PUMPS: Final = """
[[inputs]]
name = "n"
at = 3.0
low = 0.0
high = 6.0
rate = 1.0
"""


# -- the simulated plant ----------------------------------------------------------------------------------------------


def test_instances_do_not_know_of_one_another_and_return_to_their_states(compiled: Path, tmp_path: Path) -> None:
    fmu = Fmu(tanks(tmp_path, compiled))
    wiring = Wiring(["u"], ["y"], "w", [], ["tank.x[1]", "tank.x[2]"], {"tank.x[1]": 2.0}, 1)
    one, other = (FmuSimulation(fmu, wiring, 0.25) for _ in range(2))
    one.put(np.array([1.0]), np.array([0.1]))
    for _ in range(40):
        one.tick()
    assert other.read(other.states).tolist() == [2.0, 0.0]
    saved = one.saved()
    other.return_to(saved)
    other.put(np.array([1.0]), np.array([0.1]))
    for each in (one, other):
        each.tick()
    assert one.read(one.states).tolist() == other.read(other.states).tolist() != saved
    assert fmu.keeps_state


def test_no_unpacked_folder_is_left_behind(compiled: Path, tmp_path: Path) -> None:
    fmu = Fmu(tanks(tmp_path, compiled))
    simulation = FmuSimulation(fmu, Wiring(["u"], ["y"], "w", [], [], {}, 1), 0.25)
    assert len(left_behind()) == 1
    del fmu, simulation
    assert not left_behind()


@pytest.mark.parametrize("disturbance", ["[load]", pytest.param("[[disturbances]]", marks=pytest.mark.night)])
def test_an_fmu_is_driven_through_the_rig_over_the_link_as_in_one_process(
    disturbance: str, compiled: Path, tmp_path: Path, processes: Processes
) -> None:
    tanks(tmp_path, compiled)
    file = written(tmp_path, TANKS.replace("[5.0, 8.0]", "[1.5, 2.5]").replace("[load]", disturbance))
    traces = []
    for place in (["--in-process"], []):
        out = tmp_path / f"run{len(traces)}"
        options = ["--load", "a", "--duration", "5min", "--out", out]
        started = processes.coldloop(
            "--process", file, "run", *place, *options, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        code, text, complaints = started.ended(PROGRAM_S)
        assert code == 0, complaints
        traces.append(next(line for line in text.splitlines() if line.startswith("trace ")))
    assert traces[0] == traces[1]
    assert not left_behind()


@pytest.mark.parametrize("disturbance", ["[load]", pytest.param("[[disturbances]]", marks=pytest.mark.night)])
def test_what_an_fmu_meets_may_be_forecast(
    disturbance: str, compiled: Path, tmp_path: Path, processes: Processes
) -> None:
    """More flows in from a tick on than the feed, 0.01 m3/s in 5 s, can make up for at once."""
    tanks(tmp_path, compiled)
    (tmp_path / "inflow.csv").write_text("time_s,w\n0,0.1\n200,0.3\n", encoding="utf-8")
    load = tmp_path / "load.csv"
    load.write_text("time_s,load\n0,0.1\n200,0.3\n", encoding="utf-8")
    text = TANKS.replace("[5.0, 8.0]", "[1.7, 1.8]").replace("rate = 0.5", "rate = 0.01")
    if disturbance != "[load]":
        text = text.replace("[load]", disturbance) + 'course = "inflow.csv"\n'
    options = ("--duration", "8min", "--set", "limits.rate_reference=elapsed")
    options += ("--load", str(load)) if disturbance == "[load]" else ()
    unknown = run(processes, written(tmp_path, text), tmp_path / "unknown", "--in-process", *options)
    file = written(tmp_path, text + 'forecast = "inflow.csv"\n')
    known = run(processes, file, tmp_path / "known", "--in-process", *options)
    assert known["J_BF"] < 0.5 * unknown["J_BF"]


# -- what breaks the standard, or fails -------------------------------------------------------------------------------


def test_what_breaks_the_standard_is_a_warning(compiled: Path, tmp_path: Path) -> None:
    """A unit that is not declared, and a parameter without start: both are refused by FMPy's validation."""
    text = (HERE / "two_tanks.xml").read_text(encoding="utf-8").replace('<Unit name="m3/s"/>', "")
    text = text.replace('causality="input" variability="continuous"><Real start="0"/>',
                        'causality="parameter" variability="tunable"><Real/>')  # fmt: skip
    tanks(tmp_path, compiled, text)
    found = made(tmp_path, TANKS)
    warnings = [line for line in described(found).splitlines() if line.startswith("warning    FMU: ")]
    assert any("m3/s" in line for line in warnings)
    assert any('"w"' in line for line in warnings)
    assert found.model.input_units == ("m3/s",)


def test_derivatives_that_fail_are_replaced_by_a_step_test(
    compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("not\nimplemented")

    monkeypatch.setattr(fmpy.fmi2.FMU2Slave, "getDirectionalDerivative", fail)
    tanks(tmp_path, compiled)
    found = made(tmp_path, TANKS)
    told = "directional derivatives fail: RuntimeError: not implemented; a step test of it makes the model instead"
    assert told in described(found)
    model = found.model
    assert (model.C @ np.linalg.solve(-model.A, model.B))[0] == pytest.approx([1.25], rel=1e-3)


def test_an_fmu_that_allows_one_instance_has_a_new_one_for_each_session(compiled: Path, tmp_path: Path) -> None:
    tanks(tmp_path, compiled, changed('canBeInstantiatedOnlyOncePerProcess="true"'))
    assert np.array_equal(made(tmp_path, TANKS).model.A, [[-0.1, 0.0], [0.05, -0.2]])
    fmu = Fmu(tmp_path / "two_tanks.fmu")
    wiring = Wiring(["u"], ["y"], "w", [], [], {"tank.x[1]": 2.0}, 1)
    first = FmuSimulation(fmu, wiring, 0.25)
    second = FmuSimulation(fmu, wiring, 0.25)
    second.tick()
    assert second.read(second.outputs)[0] == pytest.approx(0.025, rel=0.05)
    with pytest.raises(ColdloopError, match="allows one instance at a time"):
        first.tick()


@pytest.mark.parametrize("place", ["binaries", "modelDescription"])
def test_a_damaged_member_gets_one_line(place: str, compiled: Path, tmp_path: Path) -> None:
    file = tanks(tmp_path, compiled)
    with zipfile.ZipFile(file) as packed:
        first = next(one.header_offset for one in packed.infolist() if one.filename.startswith(place))
    content = bytearray(file.read_bytes())
    content[first + 200] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(ColdloopError, match="not a readable FMU: BadZipFile: Bad CRC-32"):
        made(tmp_path, TANKS)
    assert not left_behind()


def test_no_archive_is_unpacked_without_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its directory; where the directory lies, no more comes out, and the checksum is wrong."""
    monkeypatch.setattr("coldloop_plant.fmu.MOST_UNPACKED", 2 << 20)
    file = tmp_path / "two_tanks.fmu"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("zeros", bytes(3 << 20))
    with pytest.raises(ColdloopError, match="unpacks to more than 2 MiB"):
        Fmu(file)
    assert max(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()) < 1 << 20
    file.write_bytes(file.read_bytes().replace((3 << 20).to_bytes(4, "little"), (1 << 20).to_bytes(4, "little")))
    with pytest.raises(ColdloopError, match="not a readable FMU: BadZipFile: Bad CRC-32"):
        Fmu(file)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(ColdloopError, match=r"cannot be unpacked into .*nowhere: No such file.*; free space there"):
        Fmu(file)


# -- what is refused --------------------------------------------------------------------------------------------------

BAD: Final = {
    "another variable": (TANKS.replace('name = "y"', 'name = "z"'), "", "has no variable z"),
    "an output as an input": (TANKS.replace('variable = "u"', 'variable = "tank.x[1]"'), "", "is no input"),
    "a start value of nothing": (TANKS.replace("[[inputs", "start = { k = 1.0 }\n[[inputs"), "", "no variable k"),
    "no rest": (TANKS.replace("[[inputs", "rest_s = 20.0\n[[inputs") + "[prediction]\ndecision_instants = [1, 2, 4]\n"
                "constraint_instants = [1, 2]\n", "", "does not come to rest"),
    "another version": (TANKS, 'fmiVersion="1.0"', "FMU"),
    "a fixed step": (TANKS, 'canHandleVariableCommunicationStepSize="false"', "does steps of 0.1 s only"),
    "no co-simulation": (TANKS, "ModelExchange", "has no co-simulation"),
    "variable without an FMU": (TANKS.replace('fmu = "two_tanks.fmu"', 'matrices = "m.npz"'), "", "is for an FMU"),
    "a start without an FMU": (TANKS.replace('fmu = "two_tanks.fmu"', 'matrices = "m.npz"\nrest_s = 1.0'), "",
                                 "are for an FMU"),
}  # fmt: skip


def changed(change: str) -> str:
    """Return the FMU's description with a change."""
    text = (HERE / "two_tanks.xml").read_text(encoding="utf-8")
    if change.startswith("fmiVersion"):
        return text.replace('fmiVersion="2.0"', change)
    if change == "ModelExchange":
        return text.replace("<CoSimulation", "<ModelExchange").replace(
            'canHandleVariableCommunicationStepSize="true"', ""
        )
    if change.startswith("canHandle"):
        experiment = '<DefaultExperiment stepSize="0.1"/>'
        text = text.replace('canHandleVariableCommunicationStepSize="true"', "")
        return text.replace("<ModelVariables>", f"{experiment}<ModelVariables>")
    return text.replace("canGetAndSet", f"{change} canGetAndSet") if change else text


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_used_gets_one_line(case: str, compiled: Path, tmp_path: Path) -> None:
    text, change, why = BAD[case]
    tanks(tmp_path, compiled, changed(change))
    with pytest.raises(ColdloopError) as refused:
        made(tmp_path, text)
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)
    del refused
    assert not left_behind()


def test_an_fmu_of_another_platform_or_none_at_all_gets_one_line(compiled: Path, tmp_path: Path) -> None:
    tanks(tmp_path, compiled, platform="win64")
    with pytest.raises(ColdloopError, match=f"has no library for {fmpy.platform}, but for win64"):
        made(tmp_path, TANKS)
    (tmp_path / "two_tanks.fmu").write_text("nothing", encoding="utf-8")
    with pytest.raises(ColdloopError, match="not a readable FMU"):
        made(tmp_path, TANKS)
    (tmp_path / "two_tanks.fmu").unlink()
    with pytest.raises(ColdloopError, match=r"two_tanks\.fmu: no such file"):
        made(tmp_path, TANKS)


def test_an_fmu_that_does_not_start_says_why_in_its_own_words(tmp_path: Path, processes: Processes) -> None:
    """Its Python needs a module that is not there."""
    file = fmu(tmp_path)
    with zipfile.ZipFile(tmp_path / "QuadrupleTankFmu.fmu") as packed:
        content = {name: packed.read(name) for name in packed.namelist() if not name.endswith("/quadruple_tank.py")}
    with zipfile.ZipFile(tmp_path / "QuadrupleTankFmu.fmu", "w") as packed:
        for name, part in content.items():
            packed.writestr(name, part)
    (tmp_path / "quadruple_tank.py").unlink()
    started = processes.coldloop("process", file, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    code, _, complaints = started.ended(PROGRAM_S)
    assert code != 0
    assert len(complaints.splitlines()) == 1
    assert "cannot be started" in complaints
    assert "No module named" in complaints
    assert not list(Path(tempfile.gettempdir()).iterdir()), "nothing is left of it, unpacked or otherwise"
