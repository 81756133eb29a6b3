"""The plant as a program: inputs in, one tick forward, measurements out. No sockets, no clock."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, Protocol

import numpy as np

from coldloop.process import cold_box, declaration
from coldloop.registers.plant import StationSample, StationStatus, Surroundings
from coldloop_plant.numeric import RealArray


class HeatLoad(Protocol):
    """The heat load over time."""

    def value(self, tick: int) -> float:
        """Return the load (W) that is held from `tick` to the next one."""


@dataclass(frozen=True)
class MeasurementNoise:
    """White Gaussian noise on the outputs, one draw per tick for all readers, and a bias.

    Raises:
        ValueError: not one standard deviation and one bias per output, or one that is negative or not finite.
    """

    deviations: tuple[float, ...]  # Standard deviation of each output, in its unit; shape (outputs,)
    seed: int  # Seed of the PCG64 generator, 0 or more
    biases: tuple[float, ...] = ()
    """Bias of each output: what its reading shows too much, in its unit; shape (outputs,), or none."""

    def __post_init__(self) -> None:
        if not all(0.0 <= sigma < inf for sigma in self.deviations):
            raise ValueError("noise needs standard deviations that are finite and not negative")
        if len(self.biases) not in {0, len(self.deviations)} or not all(map(isfinite, self.biases)):
            raise ValueError(f"noise needs {len(self.deviations)} biases, all finite, or none")


class PlantProgram:
    """A simulated plant, advanced tick by tick; what happens in a tick is its kind's.

    Args:
        x0: State at tick 0, a number for each state of the process.
        u0: Inputs held until the first `apply`.
        load: The load over time.
        noise: Noise on the measurements; None measures exactly.
        process: Whose plant it is.

    Raises:
        ValueError: an argument of wrong length, or not finite.
    """

    def __init__(
        self,
        *,
        x0: Sequence[float],
        u0: Sequence[float],
        load: HeatLoad,
        noise: MeasurementNoise | None = None,
        process: declaration.Process = cold_box.COLD_BOX,
    ) -> None:
        self.process = process
        self.tick = 0
        self._x = _vector(x0, process.states, "states")
        self._u = _vector(u0, process.inputs, "inputs")
        self._load = load
        self._noise = noise
        nothing = (0.0,) * len(process.outputs)
        self.biases = _vector(noise.biases or nothing if noise else nothing, process.outputs, "biases")
        """Bias of each output: what its reading shows too much, shape (outputs,)."""
        self.deviations = _vector(noise.deviations if noise else nothing, process.outputs, "standard deviations")
        """Standard deviation of the noise on each output, shape (outputs,)."""
        self._generator = np.random.Generator(np.random.PCG64(noise.seed if noise else 0))
        self._measured = self._sample(self._read(self.load))
        self._warm_up()

    def _warm_up(self) -> None:
        """Have what a tick needs ready: no session waits for that."""
        self._step(self.load)

    def _read(self, w: float) -> RealArray:
        """Return the outputs at the current state and inputs."""
        raise NotImplementedError

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        """Return the state and the outputs one tick ahead."""
        raise NotImplementedError

    def resume(
        self, tick: int, x: Sequence[float], u: Sequence[float], y: Sequence[float], noise_state: Mapping[str, Any]
    ) -> None:
        """Resume from what `retained` returned.

        Raises:
            ValueError: it is not of this plant.
        """
        self.tick = tick
        self._x = _vector(x, self.process.states, "states")
        self._u = _vector(u, self.process.inputs, "inputs")
        self._generator.bit_generator.state = noise_state
        self._measured = tuple(_vector(y, self.process.outputs, "outputs").tolist())

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        noise_state = self._generator.bit_generator.state
        own = {"tick": self.tick, "x": self._x.tolist(), "u": self._u.tolist(), "y": self._measured}
        return {**own, "noise_state": noise_state}

    def take_over(self, tick: int, x: RealArray, u: RealArray, y: RealArray) -> None:
        """Go on from another tick: with what state and measurements are there, and the inputs held up to it."""
        self.tick, self._x, self._u, self._measured = tick, x.copy(), u.copy(), tuple(y.tolist())

    @contextmanager
    def noise(self, ticks: int) -> Iterator[RealArray]:
        """Lend the draws of the next `ticks` ticks, shape (ticks, outputs), or (0, outputs) without.

        Those used are gone: the tick afterwards shows how many they were.
        """
        before, start = self._generator.bit_generator.state, self.tick
        outputs = len(self.process.outputs)
        count = ticks if self._noise else 0
        yield self._generator.standard_normal((count, outputs))
        if count and self.tick - start < count:
            self._generator.bit_generator.state = before
            self._generator.standard_normal((self.tick - start, outputs))

    @property
    def state(self) -> tuple[float, ...]:
        """The states at the current tick, without noise."""
        return tuple(self._x.tolist())

    @property
    def load(self) -> float:
        """The load held from the current tick to the next."""
        return self._load.value(self.tick)

    @property
    def station(self) -> StationSample | None:
        """Compression station and nitrogen at the current tick; only a refrigerator has one."""
        return None

    @property
    def model_range(self) -> int:
        """Parts outside the range of the simulation's tables at the current tick, bits of `ModelRange`; 0 without."""
        return 0

    @property
    def station_status(self) -> StationStatus | None:
        """The same for the registers, with what its controller asks for."""
        return None

    @property
    def surroundings(self) -> Surroundings | None:
        """Boundary conditions of a refrigerator at the current tick; other plants have none."""
        return None

    def give(self, surroundings: Surroundings) -> None:
        """Change what a refrigerator is given, from the next tick on.

        Raises:
            ValueError: The plant is no refrigerator.
        """
        raise ValueError(f"{surroundings._fields}: the plant is no refrigerator; set plant.kind to refrigerator")

    def compiled(self) -> Any:  # noqa: ANN401 a `CompiledPlant` of the rig, which this package does not know
        """Return what the rig's compiled loop takes for it, where that comes with its kind; None for others."""
        return None

    def measure(self) -> tuple[float, ...]:
        """Return the outputs at the current tick, taken before inputs applied at this tick act."""
        return self._measured

    def apply(self, u: Sequence[float]) -> None:
        """Hold the inputs `u` over the ticks that follow; actuators saturate by themselves.

        Raises:
            ValueError: not a finite number for each input.
        """
        self._u = _vector(u, self.process.inputs, "inputs")

    def advance(self) -> None:
        """Go one tick forward."""
        self._x, y = self._step(self.load)
        self.tick += 1
        self._measured = self._sample(y)

    def _sample(self, y: RealArray) -> tuple[float, ...]:
        if self._noise:
            y = y + self.biases + self.deviations * self._generator.standard_normal(len(y))
        return tuple(y.tolist())


def _vector(values: Sequence[float], signals: Sequence[object], what: str) -> RealArray:
    if len(values) != len(signals) or not all(isfinite(value) for value in values):
        raise ValueError(f"expected {len(signals)} finite {what}, not {list(values)}")
    return np.array(values, dtype=np.float64)


MakePlant = Callable[[HeatLoad, int], PlantProgram]
"""Returns the plant at tick 0, for a load and a seed of the sensors' noise."""
NoiseOfSeed = Callable[[int], MeasurementNoise | None]
"""Returns the noise of the sensors for a seed; None where they are exact."""
