"""The cold box as a plant's program: its kernels, and what is known between two ticks."""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any

import numpy as np

from coldloop.kernels.named import plain_tuples
from coldloop.process.cold_box import TICK_S
from coldloop.process.model_range import model_range
from coldloop_plant.cold_box.physics import ColdBox, outputs
from coldloop_plant.helium.properties import load_helium
from coldloop_plant.integrator import advance_and_read
from coldloop_plant.numeric import PA_PER_BAR, RealArray
from coldloop_plant.program import HeatLoad, MeasurementNoise, PlantProgram


class ColdBoxProgram(PlantProgram):
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
        tick_s: float = TICK_S,
    ) -> None:
        if not 0.0 < tick_s <= 0.5:
            raise ValueError(f"a tick of {tick_s} s is outside 0 to 0.5 s")
        self._tick_s = tick_s
        self.box = box
        self._box, self._helium = plain_tuples(box), plain_tuples(load_helium())
        self._slope = np.empty(len(x0))
        self._held: tuple[float, ...] = (nan,) * 4
        """Inputs and load that the slope of the state was computed with."""
        super().__init__(x0=x0, u0=u0, load=load, noise=noise)

    def resume(
        self, tick: int, x: Sequence[float], u: Sequence[float], y: Sequence[float], noise_state: Mapping[str, Any]
    ) -> None:
        """Resume from what `retained` returned.

        Raises:
            ValueError: it is not of this plant.
        """
        super().resume(tick, x, u, y, noise_state)
        self._held = (nan,) * 4

    def between_ticks(self) -> tuple[RealArray, RealArray, RealArray]:
        """Return the state, its slope, and the inputs and the load that the slope is for."""
        return self._x.copy(), self._slope.copy(), np.array(self._held)

    def take_over_slope(self, tick: int, x: RealArray, slope: RealArray, held: RealArray, y: RealArray) -> None:
        """Go on from another tick with what `between_ticks` and `measure` would return there."""
        self.take_over(tick, x, held[:3], y)
        self._slope, self._held = slope.copy(), tuple(held.tolist())

    @property
    def model_range(self) -> int:
        """What is outside the property tables at the current tick, bits of `ModelRange`."""
        return int(model_range(self._x, self.box.P_HP / PA_PER_BAR, self.box.P_LP / PA_PER_BAR))

    def advance(self) -> None:
        """Go one tick forward."""
        held = (*self._u.tolist(), self.load)
        super().advance()
        self._held = held

    def _read(self, w: float) -> RealArray:
        return outputs(self._x, self._u, w, self.box, load_helium())

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        held = (*self._u.tolist(), w) == self._held
        return advance_and_read(self._x, self._slope, held, self._u, w, self._tick_s, self._box, self._helium)
