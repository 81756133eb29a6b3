"""A session of a process by the programs alone and with compiled loops, and what differs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from coldloop.config import load_configuration
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import read_header
from coldloop.registers.common import EventKind
from coldloop_rig.cosim import one_process
from coldloop_rig.cosim.compiled import stretches
from coldloop_rig.cosim.compiled.records import record_of
from coldloop_rig.cosim.compiled.stretches import CompiledStretches, Stretch
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import MemorySink
from coldloop_rig.settings import Settings
from tests.harness.process_configurations import load_of_shares
from tests.rig.test_precompile import FirstTick, compiled_kernels


class Counted(CompiledStretches):
    """Counts what loops do."""

    ticks = updates = 0

    def ahead(self, until: int) -> Stretch | None:
        stretch = super().ahead(until)
        if stretch is not None:
            Counted.ticks += len(stretch.block.load)
            Counted.updates += len(stretch.updates)
        return stretch


class Left(NamedTuple):
    """What a run leaves behind."""

    trace: str
    updates: list[Any]
    events: list[Any]
    sensors: bytes
    """What the control PLC's check of sensors goes on with."""
    late: int
    """Kernels that were compiled after its beginning."""


def left_by(settings: Settings, load: LoadProfile, ticks: int, *, compiled: bool) -> Left:
    """Run a session."""
    sink = MemorySink()
    recorder = FirstTick(ticks, [sink])
    period_s = settings.optimizer_plc.program.updating_period_s
    rig = one_process.OneProcessRig(settings, compiled=compiled)
    rig.run(Scenario(ticks, load, period_s, seed=3), recorder)
    recorder.close()
    recording = sink.recording(recorder.link)
    events = [(service, event.tick, event.kind, event.subject, event.cause) for service, event in sink.events]
    sensors = record_of(rig.control.sensors).tobytes()
    return Left(recording.trace_sha256, recording.updates, events, sensors, compiled_kernels() - recorder.before)


class Compared(NamedTuple):
    """What two runs of a session leave behind."""

    same: list[bool]
    """Trace, updates, events, sensors."""
    late: int
    """Kernels that were compiled in the session of the programs."""
    ticks: int
    updates: int
    """Of the loops."""
    all_updates: int
    events: set[str]
    """Their kinds."""


def both_ways(model: Path, ticks: int, steps: str, assignments: Sequence[str]) -> Compared:
    """Run a session of a process by the programs alone, and with compiled loops.

    Args:
        model: Model file.
        ticks: Of the session.
        steps: Load, as tick:share,... of the way to the end of its span.
        assignments: Of the configuration.
    """
    own = (f'model.file="{model}"', 'plant.kind="of-process"')
    settings = load_configuration(Settings, environment={}, assignments=(*own, *assignments)).settings
    load = load_of_shares(steps, read_header(model).w0, settings.process.load.stored_span[1])
    Counted.ticks = Counted.updates = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stretches, "CompiledStretches", Counted)
        programs, loops = (left_by(settings, load, ticks, compiled=compiled) for compiled in (False, True))
    return Compared(
        [one == other for one, other in zip(loops[:-1], programs[:-1], strict=True)], programs.late,
        Counted.ticks, Counted.updates, len(programs.updates),
        {EventKind(kind).name for _, _, kind, *_ in programs.events},
    )  # fmt: skip
