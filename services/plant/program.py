"""The plant as a program: inputs in, one tick forward, measurements out. No sockets, no clock."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Any, Protocol

import numpy as np

from coldloop.process.model_range import model_range
from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from coldloop.registers.plant import StationSample, StationStatus, Surroundings
from plant.cold_box.physics import PA_PER_BAR, ColdBox, outputs
from plant.helium.properties import load_helium
from plant.integrator import advance_and_read, plain_tuples
from plant.numeric import RealArray


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

    deviations: tuple[float, ...]
    """Standard deviation of each output, in its unit; shape (22,)."""
    seed: int
    """Seed of the PCG64 generator, 0 or more."""
    biases: tuple[float, ...] = (0.0,) * len(OUTPUT_NAMES)
    """What each output shows too much, in its unit; shape (22,)."""

    def __post_init__(self) -> None:
        if len(self.deviations) != len(OUTPUT_NAMES) or not all(0.0 <= sigma < inf for sigma in self.deviations):
            raise ValueError(f"noise needs {len(OUTPUT_NAMES)} standard deviations, finite and not negative")
        if len(self.biases) != len(OUTPUT_NAMES) or not all(map(isfinite, self.biases)):
            raise ValueError(f"noise needs {len(OUTPUT_NAMES)} biases, all finite")


class PlantProgram:
    """The simulated cold box, advanced tick by tick.

    Args:
        box: The parameters of the cold box.
        x0: State at tick 0, 28 numbers; from the model file, so that trajectories agree to the bit everywhere.
        u0: Inputs held until the first `apply`, 3 numbers.
        load: The heat load over time.
        noise: Noise on the measurements; None measures exactly.
        tick_s: Length of a tick in seconds, above 0 and at most 0.5, where the integration stays stable.

    Raises:
        ValueError: an argument of wrong length, not finite, or out of range.
    """

    def __init__(
        self,
        *,
        box: ColdBox,
        x0: Sequence[float],
        u0: Sequence[float],
        load: HeatLoad,
        noise: MeasurementNoise | None = None,
        tick_s: float = 0.25,
    ) -> None:
        if not 0.0 < tick_s <= 0.5:
            raise ValueError(f"a tick of {tick_s} s is outside 0 to 0.5 s")
        helium = load_helium()
        self.tick = 0
        self._tick_s = tick_s
        self.box = box
        self._box, self._helium = plain_tuples(box), plain_tuples(helium)
        self._x = _vector(x0, STATE_NAMES, "states")
        self._u = _vector(u0, INPUT_NAMES, "inputs")
        self._slope = np.empty_like(self._x)
        self._held: tuple[float, ...] = (nan,) * 4
        """Inputs and load that the slope of the state was computed with."""
        self._load = load
        self._noise = noise
        nothing = (0.0,) * len(OUTPUT_NAMES)
        self.biases = np.array(noise.biases if noise else nothing)
        """What each output shows too much, shape (22,)."""
        self.deviations = np.array(noise.deviations if noise else nothing)
        """Standard deviation of the noise on each output, shape (22,)."""
        self._generator = np.random.Generator(np.random.PCG64(noise.seed if noise else 0))
        self._measured = self._sample(outputs(self._x, self._u, self.load, box, helium))
        self._warm_up()

    def _warm_up(self) -> None:
        """Have the kernel of a tick compiled: no session waits for that."""
        self._step(self.load, held=False)

    def resume(
        self, tick: int, x: Sequence[float], u: Sequence[float], y: Sequence[float], noise_state: Mapping[str, Any]
    ) -> None:
        """Resume from what `retained` returned.

        Raises:
            ValueError: it is not of this plant.
        """
        self.tick = tick
        self._x = _vector(x, STATE_NAMES, "states")
        self._u = _vector(u, INPUT_NAMES, "inputs")
        self._held = (nan,) * 4
        self._generator.bit_generator.state = noise_state
        self._measured = tuple(_vector(y, OUTPUT_NAMES, "outputs").tolist())

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        noise_state = self._generator.bit_generator.state
        return {
            "tick": self.tick, "x": self._x.tolist(), "u": self._u.tolist(), "y": self._measured,
            "noise_state": noise_state,
        }  # fmt: skip

    def between_ticks(self) -> tuple[RealArray, RealArray, RealArray]:
        """Return the state, its slope, and the inputs and the load that the slope is for."""
        return self._x.copy(), self._slope.copy(), np.array(self._held)

    def take_over(self, tick: int, x: RealArray, slope: RealArray, held: RealArray, y: RealArray) -> None:
        """Resume at another tick with what `between_ticks` and `measure` would return there."""
        self.tick, self._x, self._slope, self._u = tick, x.copy(), slope.copy(), held[:3].copy()
        self._held, self._measured = tuple(held.tolist()), tuple(y.tolist())

    @contextmanager
    def noise(self, ticks: int) -> Iterator[RealArray]:
        """Lend the draws of the next `ticks` ticks, shape (ticks, 22), or (0, 22) without noise; those used are gone.

        The tick afterwards shows how many were used.
        """
        before, start = self._generator.bit_generator.state, self.tick
        outputs = len(OUTPUT_NAMES)
        count = ticks if self._noise else 0
        yield self._generator.standard_normal((count, outputs))
        if count and self.tick - start < count:
            self._generator.bit_generator.state = before
            self._generator.standard_normal((self.tick - start, outputs))

    @property
    def state(self) -> tuple[float, ...]:
        """The 28 states at the current tick, without noise."""
        return tuple(self._x.tolist())

    @property
    def load(self) -> float:
        """The heat load (W) held from the current tick to the next."""
        return self._load.value(self.tick)

    @property
    def station(self) -> StationSample | None:
        """Compression station and nitrogen at the current tick; a cold box alone has none."""
        return None

    @property
    def model_range(self) -> int:
        """What is outside the property tables at the current tick, bits of `ModelRange`."""
        return int(model_range(self._x, self.box.P_HP / PA_PER_BAR, self.box.P_LP / PA_PER_BAR))

    @property
    def station_status(self) -> StationStatus | None:
        """The same for the registers, with what its controller asks for."""
        return None

    @property
    def surroundings(self) -> Surroundings | None:
        """What a refrigerator is given at the current tick; a cold box alone is given nothing."""
        return None

    def give(self, surroundings: Surroundings) -> None:
        """Change what a refrigerator is given, from the next tick on.

        Raises:
            ValueError: The plant is a cold box alone.
        """
        raise ValueError(f"{surroundings._fields}: the plant is a cold box alone; set plant.kind to refrigerator")

    def measure(self) -> tuple[float, ...]:
        """Return the 22 outputs at the current tick, taken before inputs applied at this tick act."""
        return self._measured

    def apply(self, u: Sequence[float]) -> None:
        """Hold `u` (CV155 %, NCR22_A W, CV156 %) over the ticks that follow; the valves saturate by themselves.

        Raises:
            ValueError: not three finite numbers.
        """
        self._u = _vector(u, INPUT_NAMES, "inputs")

    def advance(self) -> None:
        """Go one tick forward."""
        w = self.load
        conditions = (*self._u.tolist(), w)
        self._x, y = self._step(w, held=conditions == self._held)
        self._held = conditions
        self.tick += 1
        self._measured = self._sample(y)

    def _step(self, w: float, *, held: bool) -> tuple[RealArray, RealArray]:
        """Return the state and the outputs one tick ahead; `held` are inputs and load if they were so before."""
        return advance_and_read(self._x, self._slope, held, self._u, w, self._tick_s, self._box, self._helium)

    def _sample(self, y: RealArray) -> tuple[float, ...]:
        if self._noise:
            y = y + self.biases + self.deviations * self._generator.standard_normal(len(y))
        return tuple(y.tolist())


def _vector(values: Sequence[float], names: tuple[str, ...], what: str) -> RealArray:
    if len(values) != len(names) or not all(isfinite(value) for value in values):
        raise ValueError(f"expected {len(names)} finite {what}, not {list(values)}")
    return np.array(values, dtype=np.float64)
