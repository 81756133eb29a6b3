"""An optimiser that is not ours, and knows the registers alone, takes the place of ours."""

import ast
import asyncio
import importlib
import importlib.util
import math
import re
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import pytest

from coldloop.modbus.client import RegisterClient
from coldloop.process.cold_box import LEVEL_BAND, OUTPUT_NAMES, T5_BAND, TICK_S, TICKS_PER_SAMPLE
from coldloop.process.load_profile import LoadProfile
from coldloop.process.settings import InputLimits
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import MAGIC, Identity, LeaseState, LeaseStatus
from coldloop.registers.control_plc import LadderStatus, Mode, Status, Verdict
from coldloop_rig import cli
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.cosim.wiring import REQUIRED
from coldloop_rig.settings import Settings
from tests.conftest import Coldloop
from tests.harness.processes import Process, Processes
from tests.harness.records import CONTROL_MAP
from tests.rig.conftest import until_accepted

if TYPE_CHECKING:
    from tests.rig.conftest import OnTheBus

EXAMPLE = Path(__file__).parents[2] / "examples" / "optimiser_by_registers.py"
WITH_DO_MPC = EXAMPLE.with_name("optimiser_with_do_mpc.py")
FACTOR = 5.0
PATIENCE_S = 120.0


def start(processes: Processes, port: int, example: Path = EXAMPLE, *words: str) -> Process:
    command = (str(example), "--port", str(port), *words)
    return processes.python(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def end(optimiser: Process) -> tuple[str, list[str]]:
    """End it; return what it has said, and the verdicts in it.

    On a busy machine sequences may be late; any other verdict is an error.
    """
    assert optimiser.alive, optimiser.ended().err
    optimiser.popen.send_signal(2)
    ended = optimiser.ended()
    assert ended.code == 0, ended.err
    verdicts = re.findall(r"(accepted|verdict \d+)$", ended.out, re.MULTILINE)
    late = {f"verdict {verdict:d}" for verdict in (Verdict.LATE, Verdict.WRONG_UPDATE, Verdict.PLANT_LOST)}
    assert set(verdicts) <= {"accepted"} | late, ended.out
    return ended.out, verdicts


@asynccontextmanager
async def without_optimizer(
    on_the_bus: "OnTheBus", load: LoadProfile, order: WordOrder
) -> AsyncIterator[tuple[RegisterClient, int]]:
    """A session of a plant and a control PLC in real time; yields a client of the latter, and its port."""
    async with on_the_bus(order=order, services=REQUIRED) as bus:
        rig = SessionClient(bus.endpoints, bus.settings, services=REQUIRED)
        try:
            await rig.connect(PATIENCE_S)
            await rig.start(Scenario(14400, load, 0.0, 1, realtime=True, factor=FACTOR))
            yield rig.control, bus.endpoints.control_plc.port
        finally:
            rig.close()


@pytest.mark.usefixtures("realtime")
@pytest.mark.parametrize("order", list(WordOrder))
async def test_its_sequences_are_accepted_in_either_word_order(
    order: WordOrder, load_a: LoadProfile, on_the_bus: "OnTheBus", processes: Processes
) -> None:
    async with without_optimizer(on_the_bus, load_a, order) as (control, port):
        optimiser = start(processes, port)
        await until_accepted(control, 4)  # one more: it counts before the example has told it
        lease = await control.read(LeaseStatus)
        _, verdicts = await asyncio.to_thread(end, optimiser)
    assert lease.state == LeaseState.HELD
    assert lease.holder != 0
    assert verdicts.count("accepted") >= 3


@pytest.mark.usefixtures("realtime")
async def test_one_that_was_restarted_drives_again(
    load_a: LoadProfile, on_the_bus: "OnTheBus", processes: Processes
) -> None:
    async with without_optimizer(on_the_bus, load_a, WordOrder.HIGH_FIRST) as (control, port):
        first = start(processes, port)
        await until_accepted(control, 1)
        first.kill()
        async with asyncio.timeout(PATIENCE_S):
            while (await control.read(LadderStatus)).optimizer:  # noqa: ASYNC110 it is seen by its registers
                await asyncio.sleep(0.05)
        second = start(processes, port)
        await until_accepted(control, 3)
        _, verdicts = await asyncio.to_thread(end, second)
        assert verdicts.count("accepted") >= 2


@pytest.fixture
def up(processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The first port of a rig that is up without an optimiser."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    base = processes.three_ports()
    words = ("--without", "optimizer", "--load", "a", "--factor", FACTOR, "--detach")
    started = processes.coldloop("up", "--port-base", base, *words)
    assert started.popen.wait(PATIENCE_S) == 0, started.said
    assert "yours: a client of the control PLC" in started.said
    yield base
    assert cli.main(["down", "--port-base", str(base)]) == 0


@pytest.mark.usefixtures("realtime")
def test_a_rig_is_kept_up_and_operated_without_our_optimiser(up: int, coldloop: Coldloop, processes: Processes) -> None:
    optimiser = start(processes, up + 1)

    async def driven() -> None:
        control = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=up + 1, timeout_s=PATIENCE_S)
        try:
            await until_accepted(control, 2)
        finally:
            control.close()

    asyncio.run(driven())
    status = coldloop("status")
    assert status.code == 0, status.complaints
    assert re.search(r"^tau_u +-$", status.out, re.MULTILINE), status
    assert "factor 4" in coldloop("set", "factor", "4").out
    killed = coldloop("fault", "kill", "optimizer_plc")
    assert killed.code == 2
    assert killed.complaints == ["coldloop: the rig was started without an optimizer_plc service"]
    end(optimiser)


# -- with do-mpc -------------------------------------------------------------------------------------------------------

PERIODS = 40
LOAD_STEP = LoadProfile((0, 15 * TICKS_PER_SAMPLE), (385.0, 445.0))
"""As large as the steps of load a."""


async def until_it_has_the_lease(rig: SessionClient) -> int:
    """Let a session in lock-step go slowly until an optimiser is there, as it would not wait; return the tick."""
    tick = 0
    async with asyncio.timeout(PATIENCE_S):
        while (await rig.control.read(LeaseStatus)).state != LeaseState.HELD:
            tick += 1
            await rig.advance(0, tick)
            await asyncio.sleep(TICK_S)
    return tick


async def driven_until(rig: SessionClient, tick: int) -> list[Status]:
    """Let a session in lock-step go until that tick; return what was seen from the first sequence on."""
    seen: list[Status] = []
    await rig.advance(0, tick)
    async with asyncio.timeout(PATIENCE_S):
        while (await rig.plant.read(Identity)).tick < tick:
            status = await rig.control.read(Status)
            if seen or status.mode == Mode.MPC:
                seen.append(status)
            await asyncio.sleep(0.05)
    return seen


async def test_do_mpc_holds_the_bands_after_a_load_step_and_no_sequence_is_rejected(
    on_the_bus: "OnTheBus", processes: Processes
) -> None:
    async with on_the_bus(services=REQUIRED) as bus:
        rig = SessionClient(bus.endpoints, bus.settings, services=REQUIRED)
        try:
            await rig.connect(PATIENCE_S)
            await rig.start(Scenario(14400, LOAD_STEP, 0.0, 1))
            port, model = bus.endpoints.control_plc.port, bus.settings.model.file
            optimiser = start(processes, port, WITH_DO_MPC, str(model))
            began = await until_it_has_the_lease(rig)
            seen = await driven_until(rig, began + PERIODS * TICKS_PER_SAMPLE)
        finally:
            rig.close()
        said, verdicts = await asyncio.to_thread(end, optimiser)
    assert {status.mode for status in seen} == {Mode.MPC}
    assert seen[-1].rejected == 0
    assert seen[-1].deadline_misses == seen[0].deadline_misses
    assert set(verdicts) == {"accepted"}
    assert len(verdicts) >= PERIODS - 2
    outputs = [(float(level), float(t5)) for level, t5 in re.findall(r"L1 +([\d.]+) %  T5 +([\d.]+) K", said)]
    for values, (low, high) in zip(zip(*outputs, strict=True), (LEVEL_BAND, T5_BAND), strict=True):
        assert low <= min(values) <= max(values) <= high


def test_without_a_solution_the_inputs_stay_and_the_next_problem_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(WITH_DO_MPC.parent)
    example = importlib.import_module(WITH_DO_MPC.stem)
    model = example.read_model(Settings().model.file)
    controller = example.DoMpc(model)
    u, x, y = tuple(model.u0), tuple(model.x0), (math.nan,) * len(OUTPUT_NAMES)

    def first_row(load: float) -> tuple[float, ...]:
        row: tuple[float, ...] = controller(example.Update(1, 0, 0, 0, load, u, y, x))[0]
        return row

    solved = first_row(445.0)
    assert solved != u
    assert first_row(math.nan) == u
    assert first_row(445.0) == pytest.approx(solved, abs=1e-6)


# -- what it knows -----------------------------------------------------------------------------------------------------


@pytest.fixture
def example() -> ModuleType:
    specification = importlib.util.spec_from_file_location("optimiser_by_registers", EXAMPLE)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("program", "known"),
    [(EXAMPLE, {"pymodbus"}), (WITH_DO_MPC, {"casadi", "do_mpc", "numpy", "optimiser_by_registers"})],
)
def test_it_uses_nothing_of_ours(program: Path, known: set[str]) -> None:
    nodes = list(ast.walk(ast.parse(program.read_text(encoding="utf-8"))))
    names = {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    names |= {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    assert {name.partition(".")[0] for name in names} - set(sys.stdlib_module_names) == known


def test_what_it_has_written_down_is_what_the_rig_has(example: ModuleType) -> None:
    limits = InputLimits()
    assert (limits.low, limits.high, limits.rate) == (example.LOW, example.HIGH, example.RATE)
    assert (example.TICK_S, example.PERIOD_TICKS, example.MAGIC) == (TICK_S, TICKS_PER_SAMPLE, MAGIC)
    assert [OUTPUT_NAMES[place] for place in (example.L1, example.T5)] == ["L1", "T5"]
    blocks = {"update": example.UPDATE, "plan": example.PLAN, "acknowledgement": example.ACKNOWLEDGEMENT}
    assert {name: block.address for block in CONTROL_MAP.blocks if (name := block.name) in blocks} == blocks
