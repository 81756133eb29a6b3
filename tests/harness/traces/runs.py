"""Runs configurations in this interpreter, of any processes, and prints what each leaves behind, as JSON.

python -m tests.harness.traces.runs NAME...
"""

import ctypes
import json
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import numba
import numpy as np
import scipy

from coldloop.config import load_configuration
from coldloop.process.cold_box import STATION_SIGNAL_NAMES
from coldloop.process.declaration import Process
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load as load_model
from coldloop.process.model_file import read_header
from coldloop.registers.optimizer_plc import Optimization
from coldloop_plant.load import find_load
from coldloop_plant.program import PlantProgram
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.process_file.making import made_from
from coldloop_rig.results.recording import CONTROL, PLANT, Indicators, MemorySink, Recorder, RunEvaluation
from coldloop_rig.settings import Settings
from tests.harness.configurations import lively
from tests.harness.process_configurations import load_of_shares
from tests.harness.process_files import PROCESSES
from tests.harness.traces.checks import Group, Table, checked
from tests.harness.traces.configurations import COLD_BOX, CONFIGURATIONS, LIVELY, Configuration
from tests.harness.traces.judge import Left, Names
from tests.harness.traces.record import Found, Platform

SEED: Final = 3
SERVICES: Final = (CONTROL, PLANT)
WHOLE: Final = Optimization._fields.index("j_effective")
"""Fields of an update before this one are whole numbers."""


class ObservedRig(OneProcessRig):
    """Lets its plant be read after the run."""

    plant: PlantProgram

    def _plant(self, load: LoadProfile, seed: int) -> PlantProgram:
        self.plant = super()._plant(load, seed)
        return self.plant


def left_by(configuration: Configuration, models: Path) -> tuple[Process, Left]:
    """Run a configuration of a process, whose model file is made in the folder of models where it is not there."""
    own: tuple[str, ...] = ()
    if configuration.process != COLD_BOX:
        own = (f'model.file="{model_of(configuration.process, models)}"', 'plant.kind="of-process"')
    settings = load_configuration(Settings, environment={}, assignments=(*own, *configuration.assignments)).settings
    program, model = settings.optimizer_plc.program, load_model(settings.model.file)
    evaluation, memory = RunEvaluation(model, program.design), MemorySink()
    recorder = Recorder(configuration.ticks, [evaluation, memory])
    load = load_of(configuration, read_header(settings.model.file).w0, settings.process)
    rig = ObservedRig(settings)
    rig.run(Scenario(configuration.ticks, load, program.updating_period_s, SEED), recorder)
    recorder.close()
    recording = memory.recording(recorder.link)
    block = recording.block
    station = [block.station] if block.station.size else []
    left = Left(
        process=configuration.process,
        trace=checked([np.column_stack([block.load, block.u]), block.y, block.x, *station]),
        end=[" ".join(map(repr, values)) for values in (rig.plant.measure(), rig.plant.state)],
        updates=of_updates(recording.updates),
        instants=" ".join(str(update.tick) for update in recording.updates),
        events=[
            f"{SERVICES.index(service)} {event.kind:d} {event.tick} {event.subject} {event.cause}"
            for service, event in memory.events
        ],
        indicators=[repr(float(value)) for value in evaluation.indicators.by_name.values()],
    )
    if configuration.process != COLD_BOX:  # the cold box's model is a file; others were just computed by LAPACK
        left["processor"] = processor()
    return settings.process, left


def model_of(name: str, models: Path) -> Path:
    """Return the model file of a process of the tests."""
    file = models / name / "model.json"
    if not file.exists():
        file.parent.mkdir()
        made_from(PROCESSES[name](file.parent)).model.save(file)
    return file


def load_of(configuration: Configuration, mean: float, process: Process) -> LoadProfile:
    """Return the load of a configuration."""
    if ":" in configuration.load:
        return load_of_shares(configuration.load, mean, process.load.stored_span[1])
    return lively(mean) if configuration.load == LIVELY else find_load(configuration.load, mean, process)


def of_updates(updates: list[Optimization]) -> Table:
    """Return the checks of updates: what was decided, and costs and rates."""
    rows: Group = np.array(updates, dtype=float).reshape(len(updates), len(Optimization._fields))
    return checked([rows[:, :WHOLE], rows[:, WHOLE:]])


def processor() -> str:
    """Return the kind of processor that numpy's OpenBLAS computes for."""
    libraries = Path(np.__file__).parents[1] / "numpy.libs"
    for library in libraries.glob("*openblas*"):
        try:
            name: Any = ctypes.CDLL(str(library)).scipy_openblas_get_corename64_
        except (OSError, AttributeError):
            continue
        name.restype = ctypes.c_char_p
        return str(name().decode())
    return "unknown"


def names(process: Process) -> Names:
    """Return what columns are called, by place."""
    station = (*STATION_SIGNAL_NAMES, "mode", "alarms") if process.has_station else ()
    return Names(
        trace=["load", *process.input_names, *process.output_names, *process.state_names, *station],
        updates=[*Optimization._fields],
        indicators=[*Indicators._fields[:-1], *(f"{one.name}_outside_band_pct" for one in process.banded)],
    )


def main(words: list[str]) -> None:
    """Print what was found."""
    made_with = Platform(
        python=platform.python_version(), numpy=np.__version__, scipy=scipy.__version__, numba=numba.__version__,
        processor=processor(),
    )  # fmt: skip
    found = Found(made_with=made_with, services=[*SERVICES], names={}, configurations={})
    with tempfile.TemporaryDirectory() as folder:
        for name in words:
            process, left = left_by(CONFIGURATIONS[name], Path(folder))
            found["names"].setdefault(CONFIGURATIONS[name].process, names(process))
            found["configurations"][name] = left
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
