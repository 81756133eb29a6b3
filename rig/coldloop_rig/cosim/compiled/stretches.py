"""Does stretches of ticks in compiled loops, on behalf of the three programs."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from coldloop.kernels.compiled import is_compiled
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.control_plc import SEQUENCE_ROWS, Update, Verdict
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import Measurement
from coldloop_control_plc.program import ControlProgram
from coldloop_optimizer_plc import decisions, solvers
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_plant.program import PlantProgram
from coldloop_rig.cosim.compiled import loops, plants, records
from coldloop_rig.results.recording import NO_STATION, STATION_COLUMNS, SampleBlock


class Stretch(NamedTuple):
    """Results of the ticks run in the compiled loop."""

    block: SampleBlock
    updates: list[Optimization]
    latched: Update | None
    """Latched in the last tick, and without a plan."""


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
        compiled: plants.CompiledPlant,
        control_plc: ControlProgram,
        optimizer_plc: OptimizerProgram,
        load: LoadProfile,
        *,
        may_compile: bool,
    ) -> None:
        self._plant, self._compiled, self._control, self._optimizer = plant, compiled, control_plc, optimizer_plc
        process = control_plc.alarm_settings.process
        ours = type(optimizer_plc) is OptimizerProgram  # a subclass may behave differently
        others = optimizer_plc.plans_by_steps or process.forecasts
        self._updates_too = ours and isinstance(optimizer_plc.solver, solvers.KernelSolver) and not others
        """Whether the updates have a compiled form: solver, rule and estimator of our own, no forecast."""
        self._may_compile = may_compile
        self._is_there: dict[Callable[..., int], bool] = {}
        ticks, sizes = records.BLOCK_TICKS, [len(part) for part in (process.inputs, process.outputs, process.states)]
        rooms = (np.empty((ticks, size), np.float32) for size in (*sizes, STATION_COLUMNS if plant.station else 0))
        self._trace = records.Trace(np.empty(ticks, np.float32), *rooms)
        self._reports = records.Reports(np.empty((ticks, 5), np.int64), np.empty((ticks, 11), np.float32))
        self._rows = np.zeros((2, SEQUENCE_ROWS, len(process.inputs)))
        self._scans = records.scan_records(control_plc.scan)
        self._pause_until = 0
        real = optimizer_plc.state.u.dtype
        u_before, u, y, x, ahead = (np.zeros(size, real) for size in (sizes[0], *sizes, 0))
        self._latched = decisions.Latched(0, 0, 0, real.type(0.0), u_before, u, y, x, ahead)
        self._world = records.World(
            compiled.constants, plant.biases, plant.deviations, np.array(load.times), np.array(load.watts),
            records.as_arrays(control_plc.scan_constants),
        )  # fmt: skip

    def ahead(self, until: int) -> Stretch | None:
        """Do ticks before the tick `until`, at most a block; return them, or None if there are none for the loop."""
        program, o = self._control, self._optimizer
        first, instant = program.tick, program.player.next_update_tick
        if first < self._pause_until or not program.is_ordinary:
            return None
        if not self._updates_too and (program.awaiting_sequence or instant - first < 6):
            return None  # fewer ticks to the updating instant are as quick in the programs
        until = int(min(until, (first // records.BLOCK_TICKS + 1) * records.BLOCK_TICKS, program.alarms.next_report))
        for slot, sequence in enumerate(program.player.sequences):
            if sequence is not None:
                self._rows[slot, : len(sequence.rows)] = sequence.rows
        scans, counts = self._scans, np.array([first, first, 0, 0])
        for part, kept in zip(program.scan, scans, strict=True):
            records.write(part, kept)
        with self._plant.noise(until - first) as noise:
            plant = self._compiled.state(noise, until - first)
            loop: Callable[..., int] = loops.play
            further: tuple[Any, ...] = (scans, self._rows, plant, self._trace)
            if self._updates_too:
                starts = decisions.Starts(o.rule.first, o.rule.after_interruption())
                parts = records.Optimizer(o.constants, o.method, o.rule, starts, o.state, self._latched)
                loop, further = loops.run_block, (parts, scans, self._rows, plant, self._trace, self._reports)
            outcome = self._run(loop, self._world, *further, counts, until)
            ticks = int(counts[records.TICK]) - first
            if ticks:
                self._compiled.restore(plant, int(counts[records.TICK]), scans.guard[0]["applied"])
        if not ticks:  # the programs run alone to the next updating instant
            self._pause_until = instant
            return None
        latched = self._give_back(first, ticks, outcome)
        load, u, y, x, station = (part[:ticks].copy() for part in self._trace)
        block = SampleBlock(first, load, u, y, x, station if station.size else NO_STATION)
        reported = (part[: counts[records.SOLVED]].tolist() for part in self._reports)
        rows = ([*numbers, int(Verdict.ACCEPTED), *values] for numbers, values in zip(*reported, strict=True))
        updates = [Optimization(*row) for row in rows]
        return Stretch(block, updates, latched)

    def _run(self, loop: Callable[..., int], *arguments: Any) -> int:  # noqa: ANN401 arguments differ by loop
        """Run a loop and return how it ended; it may have to be compiled: whether it is there is asked once."""
        if not self._may_compile:
            if loop not in self._is_there:
                self._is_there[loop] = is_compiled(loop, *arguments)
            if not self._is_there[loop]:
                return loops.DONE
        return loop(*arguments)

    def _give_back(self, first: int, ticks: int, outcome: int) -> Update | None:
        """Let the control PLC continue behind the ticks of a loop; return an update that awaits its plan."""
        program, player, u = self._control, self._control.player, self._trace.u[:ticks].tolist()
        befores = [program.applied, *map(tuple, u)]
        for part, kept in zip(program.scan, self._scans, strict=True):
            records.restore(part, kept)
        place, update = player.update_tick - first, None
        if place >= 0:
            m = self._measurement(first, place)
            update = Update(
                session=m.session, update=player.update_number, tick=m.tick, playing=player.playing, load=m.load,
                u_before=befores[place], u=m.u, y=m.y, x=m.x,
            )  # fmt: skip
        player.continue_from(self._rows, update)
        concluded = outcome != loops.OBSERVED
        latched = program.take_over(self._measurement(first, ticks - 1), befores[ticks - 1], concluded=concluded)
        return update if outcome == loops.LATCHED else latched

    def _measurement(self, first: int, row: int) -> Measurement:
        u, y, x = (tuple(part[row].tolist()) for part in (self._trace.u, self._trace.y, self._trace.x))
        return Measurement(first + row, float(self._trace.load[row]), y, x, self._control.session, u)
