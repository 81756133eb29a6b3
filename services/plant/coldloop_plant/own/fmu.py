"""A plant that is an FMU: its variables connected to the signals, at rest when a session begins."""

import base64
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coldloop.errors import ModelFileError
from coldloop.process.declaration import Process
from coldloop_plant.numeric import RealArray
from coldloop_plant.own.disturbances import NO_DISTURBANCES, Disturbances, DisturbedPlant
from coldloop_plant.own.fmu_file import Fmu, Port
from coldloop_plant.program import HeatLoad, MeasurementNoise

log = logging.getLogger("coldloop.plant")


@dataclass(frozen=True)
class Wiring:
    """Which variables of an FMU are which signals, and how it is run; what a model file says of it."""

    inputs: Sequence[str]
    outputs: Sequence[str]
    load: str | None
    disturbances: Sequence[str]
    """Others than the load."""
    states: Sequence[str]
    """Variables that are its states, if it shows them."""
    start: Mapping[str, float]
    """Start values of variables."""
    steps_per_tick: int
    rest_ticks: int = 0
    """Ticks from its start until it rests at the operating point."""


class FmuSimulation:
    """An instance with its signals connected.

    Args:
        fmu: The FMU.
        wiring: Of its variables.
        tick_s: Length of a tick.
    """

    def __init__(self, fmu: Fmu, wiring: Wiring, tick_s: float) -> None:
        names = [*wiring.inputs, *([wiring.load] if wiring.load else []), *wiring.disturbances]
        self.inputs = [fmu.port(name) for name in names]
        self._outputs = [fmu.port(name) for name in wiring.outputs]
        self._states = [fmu.port(name) for name in wiring.states]
        self._instance = fmu.instance(wiring.start)
        self._wiring = wiring
        self._step_s = tick_s / wiring.steps_per_tick
        self._steps = 0

    def put(self, u: RealArray, w: RealArray) -> None:
        """Set inputs, load (which may be none) and other disturbances."""
        self._instance.put(self.inputs, [*u.tolist(), *w[0 if self._wiring.load else 1 :].tolist()])

    def outputs(self) -> RealArray:
        """Return the outputs."""
        return self._instance.read(self._outputs)

    def states(self) -> RealArray:
        """Return the states that it shows."""
        return self._instance.read(self._states)

    def read(self, ports: Sequence[Port]) -> RealArray:
        """Return other variables."""
        return self._instance.read(ports)

    def tick(self) -> None:
        """Go one tick forward.

        Raises:
            ColdloopError: The FMU does not.
        """
        for _ in range(self._wiring.steps_per_tick):
            self._instance.step(self._steps * self._step_s, self._step_s)
            self._steps += 1

    def rest(self, u: RealArray, w: RealArray) -> None:
        """Go to rest with inputs and disturbances, for as many ticks as that was found to take."""
        self.put(u, w)
        for _ in range(self._wiring.rest_ticks):
            self.tick()

    def derivatives(self, of: Sequence[Port]) -> RealArray:
        """Return partial derivatives by states, inputs, load and k other disturbances, shape (of, n + m + 1 + k)."""
        by = [*self._states, *self.inputs]
        found = self._instance.derivatives(of, by)
        no_load = len(self._states) + len(self._wiring.inputs)
        return found if self._wiring.load else np.insert(found, no_load, 0.0, axis=1)

    def saved(self) -> dict[str, Any]:
        """Return the state as plain data."""
        return {"steps": self._steps, "state": base64.b64encode(self._instance.state()).decode()}

    def return_to(self, saved: Mapping[str, Any]) -> None:
        """Return to a state that `saved` returned."""
        self._instance.return_to(base64.b64decode(saved["state"]))
        self._steps = int(saved["steps"])


class FmuPlant(DisturbedPlant):
    """An FMU as the plant, at rest at its operating point at tick 0.

    Args:
        simulation: The FMU there.
        keeps_state: Whether it can return to a state.
        u0: Inputs there, held until the first `apply`.
        load: The load over time.
        disturbances: Others than the load.
        noise: Noise on the measurements; None measures exactly.
        process: Whose plant it is.
    """

    def __init__(
        self,
        simulation: FmuSimulation,
        *,
        keeps_state: bool,
        u0: Sequence[float],
        load: HeatLoad,
        disturbances: Disturbances = NO_DISTURBANCES,
        noise: MeasurementNoise | None = None,
        process: Process,
    ) -> None:
        self._simulation = simulation
        self._keeps_state = keeps_state
        self._hidden = np.zeros(len(process.states) - len(disturbances.courses))
        x0 = np.append(self._shown(), disturbances.at(0))
        super().__init__(disturbances, x0=x0.tolist(), u0=u0, load=load, noise=noise, process=process)

    def _shown(self) -> RealArray:
        """Return the states; zeros where the FMU hides them."""
        states = self._simulation.states()
        return states if len(states) else self._hidden

    def _warm_up(self) -> None:
        """Do nothing: a tick would move it."""

    def _own_outputs(self, w: RealArray) -> RealArray:
        self._simulation.put(self._u, w)
        return self._simulation.outputs()

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        self._simulation.put(self._u, w)
        self._simulation.tick()
        return self._shown(), self._simulation.outputs()

    def _saved(self) -> dict[str, Any] | None:
        return self._simulation.saved() if self._keeps_state else None

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        if saved is None or not self._keeps_state:
            raise ValueError("the FMU cannot return to a state")
        try:
            self._simulation.return_to(saved)
        except ModelFileError as error:
            raise ValueError(str(error)) from error


def fmu_maker(
    fmu: Fmu, wiring: Wiring, u0: Sequence[float], w0: Sequence[float], tick_s: float
) -> Callable[[], FmuSimulation]:
    """Return what makes the FMU at rest at its operating point; the way there is simulated once where it keeps states.

    Raises:
        ColdloopError: It does not get there.
    """
    first = FmuSimulation(fmu, wiring, tick_s)
    first.rest(np.array(u0), np.array(w0))
    at_rest = first.saved() if fmu.keeps_state else None
    if at_rest is None:
        log.info("the FMU cannot save its state: after a restart of this service no session is resumed")

    def make() -> FmuSimulation:
        made = FmuSimulation(fmu, wiring, tick_s)
        if at_rest is None:
            made.rest(np.array(u0), np.array(w0))
        else:
            made.return_to(at_rest)
        return made

    return make
