"""Runs a session of the process that is loaded by the programs alone and with compiled loops, and says what differs.

python -m tests.process.both_ways TICKS LOAD [ASSIGNMENT]...    LOAD: tick:share,... of the way to the end of its span
"""

import json
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import pytest

from coldloop.config import load_configuration
from coldloop.process.load_profile import LOAD_SPAN, LoadProfile
from coldloop.process.loaded import FILE
from coldloop.process.model_file import read_header
from coldloop.registers.audit import EventKind
from rig.cosim import one_process
from rig.cosim.compiled import stretches
from rig.cosim.compiled.stretches import CompiledStretches, Stretch
from rig.cosim.scenario import Scenario
from rig.results.recording import MemorySink
from rig.settings import Settings
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
    sensors: list[Any]
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
    sensors = rig.control.sensors
    history = [sensors.unchanged, sensors.rests, sensors.inputs, sensors.inputs_moved, vars(sensors.image)]
    return Left(recording.trace_sha256, recording.updates, events, history, compiled_kernels() - recorder.before)


def main(ticks: str, steps: str, assignments: Sequence[str]) -> None:
    """Print it."""
    own = (f'model.file="{FILE}"', 'plant.kind="of-process"')
    settings = load_configuration(Settings, environment={}, assignments=(*own, *assignments)).settings
    w0, end = read_header(settings.model.file).w0, LOAD_SPAN[1]
    load = load_of_shares(steps, w0, end)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stretches, "CompiledStretches", Counted)
        programs, loops = (left_by(settings, load, int(ticks), compiled=compiled) for compiled in (False, True))
    raised = {(EventKind(kind).name, subject, cause) for _, _, kind, subject, cause in programs.events}
    report = {
        "same": [one == other for one, other in zip(loops[:-1], programs[:-1], strict=True)], "late": programs.late,
        "ticks": Counted.ticks, "updates": Counted.updates, "all_updates": len(programs.updates),
        "events": sorted(raised),
    }  # fmt: skip
    sys.stdout.write(json.dumps(report))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
