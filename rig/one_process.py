"""The three programs in one process, by direct calls; what would cross the bus is rounded as the bus would round it."""

from coldloop.lti_model import load
from coldloop.registers.codec import as_transmitted
from coldloop.registers.control_plc import Update, Verdict
from coldloop.registers.plant import LoadStep, Measurement, PlantSample
from control_plc.runtime import make_program as make_control_program
from optimizer_plc.program import OptimizerProgram
from plant.kinds import plant_maker
from plant.program import LoadProfile, PlantProgram
from plant.runtime import own_header
from plant.settings import PlantKind
from rig.compiled.stretches import CompiledStretches
from rig.recording import Recorder
from rig.scenario import Scenario
from rig.settings import Settings


class OneProcessRig:
    """Plant, control PLC and optimiser PLC, connected by calls.

    Args:
        settings: Configuration.
        compiled: Ordinary ticks of a cold box alone are done in compiled loops, with the same bits.
    """

    def __init__(self, settings: Settings, *, compiled: bool = True) -> None:
        header = own_header(settings.model.file)
        self._settings = settings
        self._header = header
        self._compiled = compiled and settings.plant.kind is PlantKind.COLD_BOX
        program = settings.optimizer_plc.program
        self.optimizer = OptimizerProgram(load(settings.model.file), program, settings.limits)
        self.control = make_control_program(header, settings.control_plc, settings.limits)

    def run(self, scenario: Scenario, recorder: Recorder) -> None:
        """Run a scenario from the operating point, in lock-step."""
        steps = [as_transmitted(LoadStep(*step)) for step in zip(scenario.load.times, scenario.load.watts, strict=True)]
        load_table = LoadProfile(tuple(step.tick for step in steps), tuple(step.watts for step in steps))
        plant = plant_maker(self._header, self._settings.plant)(load_table, scenario.seed)
        self.optimizer.restart(scenario.updating_period_s)
        told = self.control.journal.count
        self.control.restart(session=1)
        stretches = None
        if self._compiled:
            stretches = CompiledStretches(plant, self.control, self.optimizer, load_table, self._settings.limits)
        recorder.begin()
        while self.control.tick < scenario.ticks:
            stretch = stretches.ahead(scenario.ticks) if stretches else None
            if stretch is not None:
                recorder.stretch(*stretch)
                continue
            self._tick(plant, recorder)
            for event in self.control.journal.since(told):
                recorder.event(event)
                told = event.number

    def _tick(self, plant: PlantProgram, recorder: Recorder) -> None:
        """Let the programs do one tick."""
        if self.control.awaiting_sequence:
            self._deliver(recorder)
        update = self._scan(plant, recorder)
        if update is not None:
            self.control.accept_plan(as_transmitted(self.optimizer.plan(as_transmitted(update))))

    def _deliver(self, recorder: Recorder) -> None:
        sequence = self.optimizer.solve()
        answer = self.control.offer(sequence)
        recorder.update(as_transmitted(self.optimizer.report(Verdict(answer.verdict))))

    def _scan(self, plant: PlantProgram, recorder: Recorder) -> Update | None:
        actuators = as_transmitted(self.control.begin_scan())
        u = actuators[1:4]
        plant.apply(u)
        measurement = as_transmitted(
            Measurement(plant.tick, plant.load, plant.measure(), plant.state, actuators.session)
        )
        if plant.station is not None:
            recorder.station(as_transmitted(plant.station))
        recorder.sample(PlantSample(plant.tick, measurement.load, u, measurement.y, measurement.x))
        plant.advance()
        return self.control.end_scan(measurement)
