"""A cold box whose heater, load, level gauge or actuators are not as the optimiser believes."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from coldloop.process.cold_box import L1
from coldloop_plant.cold_box.physics import ColdBox
from coldloop_plant.cold_box.program import ColdBoxProgram
from coldloop_plant.numeric import RealArray
from coldloop_plant.program import HeatLoad, MeasurementNoise
from coldloop_plant.settings import MismatchSettings

HEATER: Final = 1
"""NCR22_A."""


class MismatchedPlant(ColdBoxProgram):
    """Inputs act later and the heater otherwise, the load is another than is announced, L1 is shown by a wrong scale.

    Args:
        box: The parameters of the cold box.
        x0: State at tick 0, 28 numbers.
        u0: Inputs held until the first `apply`, 3 numbers.
        load: The heat load that is announced.
        noise: Noise on the measurements; None measures exactly.
        mismatch: Its last four fields.
    """

    def __init__(
        self,
        *,
        box: ColdBox,
        x0: Sequence[float],
        u0: Sequence[float],
        load: HeatLoad,
        noise: MeasurementNoise | None,
        mismatch: MismatchSettings,
    ) -> None:
        self._mismatch = mismatch
        self._on_their_way = self._filled(u0)
        super().__init__(box=box, x0=x0, u0=u0, load=load, noise=noise)

    def resume(
        self, tick: int, x: Sequence[float], u: Sequence[float], y: Sequence[float], noise_state: Mapping[str, Any]
    ) -> None:
        """Resume from what `retained` returned; inputs that were on their way have arrived."""
        super().resume(tick, x, u, y, noise_state)
        self._on_their_way = self._filled(u)

    def _filled(self, u: Sequence[float]) -> deque[RealArray]:
        """Return inputs on their way that are all the same."""
        return deque([np.array(u, dtype=float)] * self._mismatch.delay_ticks)

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        self._on_their_way.append(self._u)
        u = self._on_their_way.popleft().copy()
        u[HEATER] *= self._mismatch.heater
        asked, self._u = self._u, u
        self._held = (math.nan,) * 4  # what acts may have moved on
        reached = super()._step(w * self._mismatch.load)
        self._u = asked
        return reached

    def _sample(self, y: RealArray) -> tuple[float, ...]:
        y = np.array(y)
        y[L1] *= self._mismatch.level_gauge
        return super()._sample(y)
