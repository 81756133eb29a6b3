"""The whole optimiser in Structured Text answers updates by the plans and sequences of the kernels, in every bit."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from coldloop.process.settings import InputLimits
from coldloop_export.golden import GuardKernels, golden_calls, integers_of
from coldloop_export.st_files import GuardText, OptimizerText, plcopen_xml, register_table
from coldloop_export.st_printer import LARGEST_LIST, StructuredTextPrinter
from coldloop_optimizer_plc.program import OptimizerProgram
from tests.harness.records import CONTROL_MAP
from tests.plc_export.matiec import NEEDS_MATIEC, joined, self_test
from tests.plc_export.recorded_optimizers import OPTIMISERS, disturbed_updates, recorded_updates, recorder
from tests.plc_export.st_interpreter import Machine
from tests.plc_export.st_parser import parsed
from tests.plc_export.test_plcopen import ET, SCHEMA, text_of

FEW = 100
"""Ticks: the interpreter takes a second for an update or two."""
NUMBER = re.compile(r"(REAL#|-)\d\.\d{9}E[+-]\d\d")

pytestmark = [
    pytest.mark.usefixtures("compiles"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # numpy's of overflow: the kernels have none
]


def export(ticks: int, *assignments: str) -> OptimizerText:
    return OptimizerText(recorder(*assignments).optimizer, recorded_updates(ticks, "e", *assignments))


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    return export(FEW).files()


@pytest.fixture(scope="module")
def machine(texts: dict[str, str]) -> Machine:
    return Machine(*texts.values())


def run(test: SimpleNamespace, most: int = 100_000) -> SimpleNamespace:
    test.run = True
    for _ in range(most):
        test.run_()
        if test.done or test.failures:
            break
    return test


@pytest.mark.night
def test_executed_as_text_the_self_test_passes(machine: Machine) -> None:
    test = run(machine.instance("cl_self_test"))
    assert (test.done, test.passed, test.what) == (True, True, 0)


@pytest.mark.night
def test_a_changed_bit_is_found_wherever_it_is(texts: dict[str, str]) -> None:
    for name, what in (("configuration.st", 4), ("golden.st", 5)):
        number = list(NUMBER.finditer(texts[name]))[-7]
        after = np.nextafter(np.float32(number[0].removeprefix("REAL#")), np.float32(np.inf))
        written, text = StructuredTextPrinter({}).number(after), texts[name]
        changed = f"{text[: number.start()]}{written}{text[number.end() :]}"
        test = run(Machine(*{**texts, name: changed}.values()).instance("cl_self_test"))
        assert (test.what, test.passed) == (what, False)


@pytest.mark.parametrize("late", [True, False])
def test_how_an_answer_came_is_noted_as_the_kernel_does(machine: Machine, *, late: bool) -> None:
    optimizer: OptimizerProgram = recorder().optimizer
    optimizer.restart(0.0)
    restart, answered = (machine.instance(f"cl_optimizer_{name}") for name in ("restart", "answered"))
    restart.fixed_ticks = 0
    restart.run_()
    assert restart.accepted
    machine.globals.cl_state_ticks = optimizer.state.numbers[0]["ticks"] = 7
    for _ in range(5):
        answered.late = late
        answered.run_()
        optimizer.answered(late=late)
        now = optimizer.state.numbers[0]
        found = (machine.globals.cl_state_allowance, machine.globals.cl_state_in_time)
        assert found == (int(now["allowance"]), int(now["in_time"]))


def test_what_does_not_fit_is_not_accepted(machine: Machine) -> None:
    restart, plan, solve = (machine.instance(f"cl_optimizer_{name}") for name in ("restart", "plan", "solve"))
    machine.globals.cl_state_begun = machine.globals.cl_state_planned = False
    plan.u_before, plan.u, plan.y, plan.x = ({} for _ in range(4))
    plan.start = solve.start = True
    plan.run_()
    solve.run_()
    assert (plan.accepted, solve.accepted, solve.done) == (False, False, False)
    for ticks in (-1, 1, 21):
        restart.fixed_ticks = ticks
        restart.run_()
        assert not restart.accepted


class Site:
    """The blocks of the interface, with the first of the golden updates before them."""

    def __init__(self, machine: Machine) -> None:
        self.restart, self.plan, self.solve = (
            machine.instance(f"cl_optimizer_{name}") for name in ("restart", "plan", "solve")
        )
        self.golden, self.machine = recorded_updates(FEW, "e")[0], machine
        update, plan = self.golden.update, self.plan
        plan.update, plan.tick, plan.playing = update.update, update.tick, update.playing
        plan.load, plan.work, self.solve.work = np.float32(update.load), 3000, 3000
        for name in ("u_before", "u", "y", "x"):
            setattr(plan, name, dict(enumerate(np.array(getattr(update, name), np.float32))))
        self.begin()

    def begin(self) -> None:
        self.restart.fixed_ticks = 0
        self.restart.run_()

    @staticmethod
    def call(block: SimpleNamespace, *, start: bool = False) -> bool:
        """Return whether it is done."""
        block.start = start
        block.run_()
        return bool(block.done)

    def planned(self) -> bool:
        """Return whether the plan that is under way comes to what is golden."""
        while not self.call(self.plan):
            pass
        _, _, _, _, next_update_tick, suspects, *_ = integers_of(self.golden)
        return (self.plan.next_update_tick, self.plan.suspects) == (next_update_tick, suspects)


def test_what_is_under_way_is_not_begun_again(machine: Machine) -> None:
    site = Site(machine)
    assert not site.call(site.solve, start=True)
    assert not site.solve.accepted, "there is no plan"
    for block in (site.plan, site.solve):
        assert not site.call(block, start=block is site.plan)
    assert site.plan.accepted
    for block in (site.plan, site.solve):
        assert not site.call(block, start=True)
        assert not block.accepted, "a plan is under way"
    assert site.planned()
    mismatch = machine.globals.cl_state_belief_mismatch
    assert not site.call(site.solve, start=True)
    assert site.solve.accepted
    site.call(site.plan, start=True)
    assert not site.plan.accepted, "a solve is under way"
    while not site.call(site.solve):
        pass
    assert site.solve.length == integers_of(site.golden)[9]
    assert machine.globals.cl_state_belief_mismatch == mismatch, "the estimator took the update once"


def test_a_restart_ends_what_is_under_way(machine: Machine) -> None:
    site = Site(machine)
    site.call(site.plan, start=True)
    site.begin()
    before = dict(vars(machine.globals))
    assert not any(site.call(site.plan) for _ in range(40))
    assert vars(machine.globals) == before
    site.call(site.plan, start=True)
    assert site.planned()


@NEEDS_MATIEC
@pytest.mark.parametrize("assignments", OPTIMISERS.values(), ids=OPTIMISERS)
@pytest.mark.parametrize("level", ["-O0", "-O2"])
def test_the_self_test_passes_in_native_code(tmp_path: Path, assignments: tuple[str, ...], level: str) -> None:
    assert self_test(tmp_path, export(1200, *assignments).files().values(), level) == "1 1 0"


@NEEDS_MATIEC
@pytest.mark.night
def test_optimiser_and_output_guard_are_one_project_in_native_code(tmp_path: Path, texts: dict[str, str]) -> None:
    guard = GuardText(GuardKernels(InputLimits()), golden_calls(InputLimits())).files()
    assert self_test(tmp_path, joined(texts, guard), "-O2") == "1 1 0\n1 1 0"


@NEEDS_MATIEC
@pytest.mark.night
@pytest.mark.parametrize("assignments", OPTIMISERS.values(), ids=OPTIMISERS)
def test_half_an_hour_of_updates_has_the_same_bits_in_native_code(tmp_path: Path, assignments: tuple[str, ...]) -> None:
    golden = recorded_updates(7200, "e", *assignments)
    texts = OptimizerText(recorder(*assignments).optimizer, golden).files()
    assert self_test(tmp_path, texts.values(), "-O2") == "1 1 0"


@NEEDS_MATIEC
@pytest.mark.parametrize("assignments", OPTIMISERS.values(), ids=OPTIMISERS)
def test_whatever_arrives_is_answered_as_in_python_in_native_code(tmp_path: Path, assignments: tuple[str, ...]) -> None:
    source = recorded_updates(480, "e", *assignments)
    golden = [update for seed in range(4) for fixed_ticks in (0, 10)
              for update in disturbed_updates(source, seed, fixed_ticks, *assignments)]  # fmt: skip
    assert any(np.isnan(each.update.y).any() for each in golden)
    texts = OptimizerText(recorder(*assignments).optimizer, golden).files()
    assert self_test(tmp_path, texts.values(), "-O2") == "1 1 0"


@pytest.mark.parametrize("assignments", OPTIMISERS.values(), ids=OPTIMISERS)
def test_no_list_of_constants_is_larger_than_tools_take(assignments: tuple[str, ...]) -> None:
    made = export(FEW, *assignments)
    lists = made.files()["configuration.st"].split("VAR_GLOBAL\n")[1:]
    assert len(lists) > 4
    assert all(4 * len(NUMBER.findall(each)) <= LARGEST_LIST for each in lists)
    assert made.sizes()["constants"] > 4 * LARGEST_LIST
    assert made.sizes()["instances of the four blocks"] < LARGEST_LIST * 2


def test_the_plcopen_xml_has_all_of_it(texts: dict[str, str]) -> None:
    project = ET.fromstring(plcopen_xml(texts.values(), "the whole optimiser"))
    assert parsed(text_of(project)) == parsed(*texts.values())


@pytest.mark.skipif(not SCHEMA, reason="COLDLOOP_TC6_SCHEMA does not name PLCopen's tc6_xml_v201.xsd")
def test_the_schema_says_so_of_the_whole_optimiser(texts: dict[str, str]) -> None:
    etree = pytest.importorskip("lxml.etree")
    schema = etree.XMLSchema(etree.parse(SCHEMA))
    schema.assertValid(etree.fromstring(plcopen_xml(texts.values(), "the whole optimiser").encode()))


def test_the_table_of_registers_names_variables_that_there_are(texts: dict[str, str]) -> None:
    blocks = {f"cl_optimizer_{name}": name for name in ("plan", "solve", "answered")}
    units = parsed(*texts.values()).units
    known = {f"{name}.{variable}" for block, name in blocks.items() for variable in units[block].variables}
    named = set(re.findall(r"`((?:plan|solve|answered)\.\w+)`", register_table(CONTROL_MAP)))
    assert len(named) > 15
    assert named <= known
