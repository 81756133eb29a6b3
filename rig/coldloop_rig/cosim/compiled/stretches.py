"""Does stretches of ordinary ticks in compiled loops, on behalf of the three programs."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import is_compiled
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import Optimization
from coldloop_control_plc.program import ControlProgram
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.solvers import KernelSolver
from coldloop_plant.program import PlantProgram
from coldloop_rig.cosim.compiled import control, loops
from coldloop_rig.cosim.compiled.plants import CompiledPlant
from coldloop_rig.cosim.compiled.records import (
    BLOCK_TICKS,
    Optimizer,
    PlantState,
    Reports,
    World,
    empty_reports,
    empty_trace,
)
from coldloop_rig.results.recording import NO_STATION, STATION_COLUMNS, SampleBlock

SHORTEST: Final = 6
"""Ticks to an updating instant below which the programs are as quick."""


class Stretch(NamedTuple):
    """Results of the ticks run in the compiled loop."""

    block: SampleBlock
    updates: list[Optimization]


class CompiledStretches:
    """Runs the programs of one session ahead while nothing unusual happens.

    Args:
        plant: The plant.
        compiled: The same for the loop.
        control: The control PLC.
        optimizer: The optimiser, in its session.
        load: What the plant's load follows.
        may_compile: Loops that have not been compiled yet are; else the programs do without.
    """

    def __init__(
        self,
        plant: PlantProgram,
        compiled: CompiledPlant,
        control_plc: ControlProgram,
        optimizer_plc: OptimizerProgram,
        load: LoadProfile,
        *,
        may_compile: bool,
    ) -> None:
        self._plant, self._compiled, self._control, self._optimizer = plant, compiled, control_plc, optimizer_plc
        process = control_plc.alarm_settings.process
        self._is_compiled = _is_compiled(optimizer_plc)
        self._may_compile = may_compile
        self._is_there: dict[Callable[..., int], bool] = {}
        self._trace, self._reports = empty_trace(process, STATION_COLUMNS if plant.station else 0), empty_reports()
        self._pause_until = 0
        sensors = control_plc.sensors
        self._world = World(
            compiled.constants, plant.biases, plant.deviations, np.array(load.times), np.array(load.watts),
            control_plc.guard.limits, np.array(sensors.low), np.array(sensors.high), np.array(sensors.least),
            np.array(sensors.is_controlled), sensors.kinds, np.array(sensors.moves),
            sensors.may_rest, sensors.each_may_rest, sensors.frozen_ticks, *process.load.stored_span,
            control_plc.watchdog.time, optimizer_plc.settings.interrupting_load_step_w,
        )  # fmt: skip

    def ahead(self, until: int) -> Stretch | None:
        """Do ordinary ticks before the tick `until`, at most a block; return them, or None if there are none."""
        if self._control.tick < self._pause_until or not control.is_ordinary(self._control):
            return None
        answered = self._control.player.has_answer
        whole = self._is_compiled and not answered and _is_ordinary(self._optimizer)
        if not whole and not answered and self._control.player.load_step:
            return None  # the programs deliver at once what a load step may cut off
        if not whole:
            until = min(until, self._control.player.next_update_tick)
        until = min(until, (self._control.tick // BLOCK_TICKS + 1) * BLOCK_TICKS)
        until = int(min(until, control.due(self._control)))
        ticks = until - self._control.tick
        with self._plant.noise(ticks) as noise:
            plant = self._compiled.state(noise, ticks)
            stretch = self._updates_too(plant, until) if whole else self._ticks_alone(plant, until)
        if stretch is None:  # the programs run alone to the next updating instant
            self._pause_until = self._control.player.next_update_tick
        return stretch

    def _ticks_alone(self, plant: PlantState, until: int) -> Stretch | None:
        """Play on to the next updating instant, where that is worth while."""
        program, sequence = self._control, self._control.player.sequence
        if sequence is None or program.player.next_update_tick - program.tick < SHORTEST:
            return None
        scans, guards = control.scan_record(program), control.guard_records(program.guard.state, program.guard.limits)
        rows, alarms = control.sequence_rows(sequence), control.alarms_of(program)
        if not self._run(loops.play, self._world, alarms, scans, guards, rows[0], plant, self._trace, until):
            return None
        s = scans[0]
        if s["tick"] == s["first"]:
            return None
        return Stretch(self._give_back(plant, s, guards[0]), [])

    def _updates_too(self, plant: PlantState, until: int) -> Stretch | None:
        program, optimizer_plc, playing = self._control, self._optimizer, self._control.player.sequence
        if playing is None:
            raise RuntimeError("an ordinary update plays a sequence")
        scans, guards = control.scan_record(program), control.guard_records(program.guard.state, program.guard.limits)
        rows = control.sequence_rows(playing)
        o = optimizer_plc
        parts = Optimizer(o.constants, o.method, o.rule, o.state)
        alarms = control.alarms_of(program)
        if not self._run(
            loops.run_block, self._world, alarms, parts, scans, guards, rows, plant, self._trace, self._reports, until
        ):
            return None
        s = scans[0]
        if s["tick"] == s["first"]:
            return None
        block, solved = self._give_back(plant, s, guards[0]), int(s["solved"])
        if solved:
            update = control.latched_update(program, s, self._trace)
            sequence = control.played_sequence(s, update.update - 1, rows[0], optimizer_plc.model_digest)
            program.player.take_over(sequence, update, int(s["next_update"]), int(s["accepted"]))
            now = o.state.numbers[0]
            program.shortage, program.suspects = float(np.float32(now["shortage"])), int(now["suspects"])
        return Stretch(block, _optimizations(self._reports, solved))

    def _run(self, loop: Callable[..., int], *arguments: Any) -> bool:  # noqa: ANN401 of each loop
        """Run a loop; return whether it is there, for it may have to be compiled: that is asked once."""
        if not self._may_compile:
            if loop not in self._is_there:
                self._is_there[loop] = is_compiled(loop, *arguments)
            if not self._is_there[loop]:
                return False
        loop(*arguments)
        return True

    def _give_back(self, plant: PlantState, s: np.void, guard: np.void) -> SampleBlock:
        """Hand the state of the loop back to plant and control PLC; return the ticks it has run."""
        self._compiled.restore(plant, int(s["tick"]), guard["applied"])
        control.restore_guard(self._control, guard)
        control.restore_scan(self._control, s, self._trace)
        ticks = int(s["tick"]) - int(s["first"])
        load, u, y, x, station = (part[:ticks].copy() for part in self._trace)
        return SampleBlock(int(s["first"]), load, u, y, x, station if station.size else NO_STATION)


def _is_compiled(program: OptimizerProgram) -> bool:
    """Tell whether the program's updates have a compiled form: solver, rule and estimator of our own, no forecast."""
    if type(program) is not OptimizerProgram:  # who has made another kind of it wants to be asked
        return False
    return isinstance(program.solver, KernelSolver) and not (program.plans_by_steps or program.process.forecasts)


def _is_ordinary(program: OptimizerProgram) -> bool:
    """Tell whether the update under way is one of many: what is played began at its instant."""
    now, playing = program.state.numbers[0], program.state.playing.numbers[0]
    return bool(now["planned"] and playing["length"] and playing["first_tick"] == now["tick"])


def _optimizations(reports: Reports, solved: int) -> list[Optimization]:
    """Return what was reported, as the recorder takes it."""
    counts, values = reports.counts[:solved].tolist(), reports.values[:solved].tolist()
    rows = ([*row, int(Verdict.ACCEPTED), *of_row] for row, of_row in zip(counts, values, strict=True))
    return [Optimization(*row) for row in rows]
