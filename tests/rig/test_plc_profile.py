"""A PLC as a profile: what `coldloop budget --plc` says of it, by hand, and what it refuses."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from coldloop.errors import ColdloopError
from coldloop_optimizer_plc.computing_settings import BudgetSettings, PlcBudget
from coldloop_rig import simulate
from coldloop_rig.plc_sizing.budget import Footprint, capacity, power_of
from coldloop_rig.plc_sizing.plc import find_profile, shipped_profiles

if TYPE_CHECKING:
    from tests.conftest import Coldloop

WHOLE = 'name = "A PLC"\nsource = "its data sheet"\nmemory_bytes = 1_000_000\noperation_ns = 400\noverhead = 5\n'


def written(folder: Path, text: str = WHOLE, times: str = "") -> str:
    """Write a profile, and a file of times beside it."""
    (folder / "plc.toml").write_text(text, encoding="utf-8")
    (folder / "times.csv").write_text(times, encoding="utf-8")
    return str(folder / "plc.toml")


def test_the_papers_plc_is_the_reference_and_every_shipped_one_has_its_source() -> None:
    assert power_of(find_profile("schneider-tsx-p574634m"), 49) == pytest.approx(1.0)
    profiles = [find_profile(name) for name in shipped_profiles()]
    assert len({profile.name for profile in profiles}) == len(profiles) >= 2
    assert all(len(profile.source) > 40 for profile in profiles)


def test_an_operation_takes_its_time_and_what_is_around_it(tmp_path: Path) -> None:
    assert find_profile(written(tmp_path)).flops_per_s(49) == pytest.approx(1e9 / (400 * 5))


def test_measured_factorisations_give_the_speed_in_loops_of_a_length(tmp_path: Path) -> None:
    """With a microsecond n^3, a factorisation of 10, 333.3 + 50 + 11.7 operations, takes a millisecond."""
    text = WHOLE.replace("operation_ns = 400\noverhead = 5", 'factorisations = "times.csv"')
    times = "# timed by hand\nsize,plc_ms\n" + "".join(f"{n},{n**3 * 1e-3}\n" for n in (5, 10, 20, 40))
    profile = find_profile(written(tmp_path, text, times))
    assert profile.flops_per_s(10) == pytest.approx(395.0 / 1e-3)
    assert profile.flops_per_s(1e4) == pytest.approx(1e6 / 3, rel=1e-3)


def test_what_gives_way_first_by_hand() -> None:
    """Twice the variables take four times the 10 kB of matrices; 5 s less a slot hold eight times 0.59375 s."""
    needed = Footprint(hessian=4000, problem=3000, shift=1000, solver=2000, estimator=50_000, sequence=10_000)
    budget = PlcBudget(BudgetSettings(power=1.0, preparation_slots=1), 0.59375)
    assert capacity(50, needed, 100_000, budget) == pytest.approx((100.0, 100.0))
    assert capacity(50, needed, 59_000, budget)[0] == 0.0
    assert capacity(50, needed, 100_000, PlcBudget(BudgetSettings(power=0.05), 0.25))[1] == 0.0


def test_a_plc_that_fits_is_said_so_with_what_it_does(coldloop: "Coldloop", tmp_path: Path) -> None:
    first = coldloop("budget", "--plc", written(tmp_path, WHOLE + "cycle_s = 0.1\n")).out.splitlines()[0]
    assert first.startswith("A PLC: the problem (49 variables, 94 rows) with ode fits, in 428 of 1,000 kB")
    power = 1e9 / (400 * 5) / find_profile("schneider-tsx-p574634m").flops_per_s(49)
    assert f"{math.floor((5 - 0.25 / power) / (0.25 / power))} iterations in 5 s" in first
    assert f"divide it over {math.ceil(0.25 / power / 0.1)} calls" in first


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("1_000_000", "300_000"), "does not fit: it takes 428,404 of 300,000 bytes."),
        (("overhead = 5", "overhead = 150"), "the slot of the preparation and an iteration take 15.9 s"),
    ],
)
def test_a_plc_that_does_not_fit_is_said_so_with_what_it_lacks(
    coldloop: "Coldloop", tmp_path: Path, change: tuple[str, str], says: str
) -> None:
    assert says in coldloop("budget", "--plc", written(tmp_path, WHOLE.replace(*change))).out.splitlines()[0]


@pytest.mark.usefixtures("compiles")
def test_whether_an_adaptive_period_pays_is_the_ratio_of_the_runs(coldloop: "Coldloop", tmp_path: Path) -> None:
    names = []
    for number, watts in enumerate((430, 480)):
        names.append(str(tmp_path / f"load{number}.csv"))
        Path(names[-1]).write_text(f"time_s,load_w\n0,340\n30,{watts}\n", encoding="utf-8")
    profile = written(tmp_path)
    said = coldloop("budget", "--plc", profile, "--updating-period", "5", "--load", *names).out.splitlines()[1]
    power = power_of(find_profile(profile), 49)
    program = {"budget": {"power": power}}
    J = [
        [simulate(load=Path(name), updating_period=period, optimizer_plc={"program": program}).summary["J_BF"]
         for name in names]
        for period in ("adaptive", 5.0)
    ]  # fmt: skip
    ratio = float(np.exp(np.log(np.array(J[0]) / np.array(J[1])).mean()))
    assert f"an adaptive period costs {ratio:.3f} [" in said
    assert "of a fixed 5 s: " in said


@pytest.mark.parametrize(
    ("text", "times", "says"),
    [
        ("name = ", "", "not TOML"),
        (WHOLE.replace('name = "A PLC"\n', ""), "", "plc.toml: name: is missing; `coldloop docs keys` lists the keys"),
        ("", "", "plc.toml: name: is missing"),
        (WHOLE.replace("A PLC", r"A\nPLC"), "", "write it on one line"),
        (WHOLE.replace("1_000_000", "-1"), "", "memory_bytes"),
        (WHOLE.replace("400", '"fast"'), "", "operation_ns"),
        (WHOLE.replace("400", "nan"), "", "operation_ns"),
        (WHOLE.replace("overhead = 5", "overhead = 0.5"), "", "overhead"),
        (WHOLE + "memory = 3\n", "", "did you mean memory_bytes?"),
        (WHOLE.replace("operation_ns = 400\n", ""), "", "give either factorisations or operation_ns"),
        (WHOLE + 'factorisations = "times.csv"\n', "", "give either factorisations or operation_ns"),
        (WHOLE.replace("operation_ns = 400", 'factorisations = "times.csv"'), "", "overhead belongs to operation_ns"),
        ("none.csv", "", "none.csv: No such file"),
        ("times.csv", "5,1\n", "no column size, plc_ms"),
        ("times.csv", "size,plc_ms\n5,1\n10,much\n", "line 3, plc_ms: 'much' is no finite number"),
        ("times.csv", "size,plc_ms\n5,1\n10\n", "line 3, plc_ms: '' is no finite number"),
        ("times.csv", "size,plc_ms\n5,1\n10,-3\n", "line 3: sizes are from 1 to 10000"),
        ("times.csv", "size,plc_ms\n5,1\n10,3\n", "2 sizes; the curve needs 3 or more"),
        ("times.csv", "size,plc_ms\n5,1\n10,3\n10,4\n", "line 4: the size 10 is there twice"),
        ("times.csv", "size,plc_ms\n5,1\n10,3\n20,2\n", "times have to rise"),
        ("/dev/zero", "", "not a regular file"),
        (WHOLE.replace("400", "1e-300"), "", "operation_ns"),
    ],
)
def test_a_profile_that_is_wrong_is_one_line_that_says_where(tmp_path: Path, text: str, times: str, says: str) -> None:
    if text.endswith((".csv", "zero")):
        text = WHOLE.replace("operation_ns = 400\noverhead = 5", f'factorisations = "{text}"')
    with pytest.raises(ColdloopError) as refused:
        find_profile(written(tmp_path, text, times)).flops_per_s(49)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--plc", "wago"), "neither a file nor one of schneider-tsx-p574634m, siemens-s7-1511-1-pn"),
        (("--plc", "siemens-s7-1511-1-pn", "--power", "2"), "not allowed with"),
        (("--load", "a"), "name one with --plc"),
        (("--plc", "x" * 300), "neither a file nor one of"),
        (("--plc", "siemens-s7-1511-1-pn", "--load", "a", "a"), "a load is named twice"),
        (("--plc", "siemens-s7-1511-1-pn", "--load", "z"), "load 'z'"),
        (("--plc", "siemens-s7-1511-1-pn", "--certify"), "leave out --power, --plc"),
    ],
)
def test_what_does_not_go_together_is_refused(coldloop: "Coldloop", arguments: tuple[str, ...], says: str) -> None:
    refused = coldloop("budget", *arguments)
    assert refused.code == 2
    assert says in refused.complaints[-1]


def test_the_curve_has_no_negative_coefficients(tmp_path: Path) -> None:
    """Times that grow less than with the square: nothing is left for the third power, and that is zero, not less."""
    text = WHOLE.replace("operation_ns = 400\noverhead = 5", 'factorisations = "times.csv"')
    times = "size,plc_ms\n" + "".join(f"{n},{n**1.5}\n" for n in (5, 10, 20, 40, 80))
    speeds = [find_profile(written(tmp_path, text, times)).flops_per_s(n) for n in (10, 100, 1000, 10_000)]
    assert min(speeds) > 0.0
    assert speeds == sorted(speeds)
