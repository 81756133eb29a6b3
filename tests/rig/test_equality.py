"""The backbone: a run has one trace, bit for bit, however its three services are connected."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.process.load_profile import LoadProfile
from coldloop.registers.codec import WordOrder
from coldloop_control_plc.settings import ControlSection, ControlStrategy
from coldloop_optimizer_plc.computing_settings import PlausibilitySettings
from coldloop_optimizer_plc.settings import AdaptiveSettings, OptimizerSection, ProgramSettings, RuleName
from coldloop_plant.settings import PlantSection, SensorSettings
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from coldloop_rig.results.recording import Recording
    from tests.conftest import Coldloop
    from tests.rig.conftest import Bus, OnTheBus, Simulate

NOISY = PlantSection(sensors=SensorSettings(level=0.02, speed=0.5, temperature=0.02, pressure=0.002))


def three_minutes(load: LoadProfile, period_s: float = 0.0, seed: int = 1) -> Scenario:
    return Scenario(ticks=720, load=load, updating_period_s=period_s, seed=seed)


def assert_same(one: "Recording", other: "Recording") -> None:
    assert one.updates == other.updates
    assert one.trace_sha256 == other.trace_sha256


@pytest.mark.parametrize("period_s", [0.0, 2.5], ids=["adaptive", "fixed"])
def test_one_process_and_three_processes_leave_the_same_trace(
    period_s: float, lively: LoadProfile, simulate: "Simulate", three_processes: "Bus"
) -> None:
    scenario = three_minutes(lively, period_s)
    assert_same(simulate(scenario), asyncio.run(three_processes.record(scenario)))


def test_a_second_session_on_the_same_services_repeats_the_first(lively: LoadProfile, three_processes: "Bus") -> None:
    scenario = replace(three_minutes(lively), ticks=240)
    first, between, second = (
        asyncio.run(three_processes.record(one)) for one in (scenario, three_minutes(lively, 1.0), scenario)
    )
    assert_same(first, second)
    assert between.trace_sha256 != first.trace_sha256


@pytest.mark.parametrize("period_s", [0.0, 2.5], ids=["adaptive", "fixed"])
async def test_load_steps_that_interrupt_change_nothing_about_the_equality(
    period_s: float, lively: LoadProfile, simulate: "Simulate", on_the_bus: "OnTheBus"
) -> None:
    scenario = three_minutes(lively, period_s)
    adaptive = AdaptiveSettings(rule=RuleName.CONTRACTION)
    section = OptimizerSection(program=ProgramSettings(interrupting_load_step_w=10.0, adaptive=adaptive))
    async with on_the_bus(Settings(optimizer_plc=section)) as bus:
        networked = await bus.record(scenario)
    alone = simulate(scenario, optimizer_plc=section)
    assert_same(alone, networked)
    steps = [time for time in lively.times[1:] if time < 700]
    assert all(any(row.tick == step for row in alone.updates) for step in steps), "each step began an update"
    assert steps


async def test_noise_suspects_and_the_low_word_first_change_nothing_about_the_equality(
    lively: LoadProfile, simulate: "Simulate", on_the_bus: "OnTheBus"
) -> None:
    scenario = three_minutes(lively, seed=20)
    limits = PlausibilitySettings(sigmas=2.0, settled_s=5.0, agreeing_s=5.0, spike_s=0.0)
    suspicious = OptimizerSection(program=ProgramSettings(plausibility=limits))
    async with on_the_bus(Settings(plant=NOISY, optimizer_plc=suspicious), order=WordOrder.LOW_FIRST) as bus:
        networked = await bus.record(scenario)
    alone = simulate(scenario, plant=NOISY, optimizer_plc=suspicious)
    assert_same(alone, networked)
    assert alone.trace_sha256 != simulate(scenario, plant=NOISY).trace_sha256, "some readings were left out"


def test_the_seed_decides_the_noise_and_so_the_trace(lively: LoadProfile, simulate: "Simulate") -> None:
    one, same, other = (simulate(three_minutes(lively, seed=seed), plant=NOISY) for seed in (1, 1, 2))
    assert_same(one, same)
    assert other.trace_sha256 != one.trace_sha256


def test_without_noise_the_seed_decides_nothing(lively: LoadProfile, simulate: "Simulate") -> None:
    assert_same(simulate(three_minutes(lively, seed=1)), simulate(three_minutes(lively, seed=2)))


async def test_the_classical_loops_leave_one_trace_too_and_no_updates(
    lively: LoadProfile, simulate: "Simulate", on_the_bus: "OnTheBus"
) -> None:
    section = ControlSection(driver=ControlStrategy.CLASSICAL)
    scenario = three_minutes(lively)
    async with on_the_bus(Settings(control_plc=section)) as bus:
        first, second = await bus.record(scenario), await bus.record(scenario)
    assert first.updates == []
    assert_same(first, second)
    assert_same(simulate(scenario, control_plc=section), first)
    assert first.trace_sha256 != simulate(scenario).trace_sha256


@pytest.mark.usefixtures("undrawn", "processes")
def test_the_command_starts_three_services_and_gets_the_trace_of_one_process(
    coldloop: "Coldloop", tmp_path: Path
) -> None:
    run = ("run", "--load", "c", "--duration", "30s", "--updating-period", "2.5")
    traces = []
    for arguments in (("--in-process", "--out", tmp_path / "one"), ("--out", tmp_path / "three")):
        outcome = coldloop(*run, *arguments)
        assert outcome.code == 0, outcome.complaints
        traces += [line for line in outcome.out.splitlines() if line.startswith("trace")]
    assert len(traces) == 2
    assert traces[0] == traces[1]
    assert {log.name for log in (tmp_path / "three" / "logs").iterdir()} == {
        "plant.log", "control_plc.log", "optimizer_plc.log"
    }  # fmt: skip


@pytest.mark.night
@pytest.mark.usefixtures("undrawn", "processes")
def test_tls_on_every_connection_changes_nothing_about_the_trace(coldloop: "Coldloop", tmp_path: Path) -> None:
    assert coldloop("certificates", "--out", tmp_path / "site").code == 0
    traces = []
    for arguments in (("--in-process",), ("--config", tmp_path / "site" / "tls.toml")):
        out = tmp_path / f"run-{len(traces)}"
        outcome = coldloop("run", "--load", "c", "--duration", "20s", *arguments, "--out", out)
        assert outcome.code == 0, outcome.complaints
        traces += [line for line in outcome.out.splitlines() if line.startswith("trace")]
    assert traces[0] == traces[1]
    logs = [log.read_text(encoding="utf-8") for log in (out / "logs").iterdir()]
    assert len(logs) == 3
    assert not [log for log in logs if "refused" in log]
