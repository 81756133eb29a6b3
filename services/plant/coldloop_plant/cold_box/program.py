"""The cold box as a plant's program, and the same with a mismatch between plant and model."""

from collections import deque
from collections.abc import Sequence
from math import nan
from typing import Any

import numpy as np

from coldloop.kernels.compiled import entry_of
from coldloop.kernels.intrinsics import plain_tuples
from coldloop.process.cold_box import L1, TICK_S
from coldloop.process.model_range import present_model_range
from coldloop_plant.cold_box.physics import ColdBox, advance_and_read, outputs
from coldloop_plant.helium.properties import load_helium
from coldloop_plant.numeric import PA_PER_BAR, RealArray
from coldloop_plant.program import PlantProgram
from coldloop_plant.settings import MismatchSettings


class ColdBoxProgram(PlantProgram):
    """The simulated cold box, advanced tick by tick.

    Its state at tick 0 is that of the model file, so that trajectories agree to the bit everywhere. `arguments` are
    those of `PlantProgram`.
    """

    def __init__(self, *, box: ColdBox, x0: Sequence[float], **arguments: Any) -> None:  # noqa: ANN401 of the base
        self.box = box
        self._box, self._helium = plain_tuples(box), plain_tuples(load_helium())
        self._slope = np.empty(len(x0))
        kinds = self._slope, self._slope, False, np.empty(3), 0.0, TICK_S, self._box, self._helium
        self._advance = entry_of(advance_and_read, *kinds)
        self._held: tuple[float, ...] = (nan,) * 4
        """Inputs and load that the slope of the state was computed with."""
        super().__init__(x0=x0, **arguments)

    def resume(self, *retained: Any, **named: Any) -> None:  # noqa: ANN401 of the base
        """Resume from what `retained` returned (ValueError if it is not of this plant)."""
        super().resume(*retained, **named)
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
        """Parts outside the property tables at the current tick, bits of `ModelRange`."""
        return present_model_range(self._x, self.box.P_HP / PA_PER_BAR, self.box.P_LP / PA_PER_BAR)

    def advance(self) -> None:
        """Go one tick forward."""
        held = (*self._u.tolist(), self.load)
        super().advance()
        self._held = held

    def _read(self, w: float) -> RealArray:
        return outputs(self._x, self._u, w, self.box, load_helium())

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        held = (*self._u.tolist(), w) == self._held
        return self._advance(self._x, self._slope, held, self._u, w, TICK_S, self._box, self._helium)


class MismatchedPlant(ColdBoxProgram):
    """Inputs act later and the heater otherwise, the load is another than is announced, L1 is shown by a wrong scale.

    Of the mismatch these are the last four fields; the load among `arguments` is that which is announced.
    """

    def __init__(self, *, mismatch: MismatchSettings, u0: Sequence[float], **arguments: Any) -> None:  # noqa: ANN401
        self._mismatch = mismatch
        self._on_their_way = self._filled(u0)
        super().__init__(u0=u0, **arguments)

    def resume(self, *retained: Any, **named: Any) -> None:  # noqa: ANN401 of the base
        """Resume from what `retained` returned; inputs that were on their way have arrived."""
        super().resume(*retained, **named)
        self._on_their_way = self._filled(self._u.tolist())

    def _filled(self, u: Sequence[float]) -> deque[RealArray]:
        """Return inputs on their way that are all the same."""
        return deque([np.array(u, dtype=float)] * self._mismatch.delay_ticks)

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        self._on_their_way.append(self._u)
        u = self._on_their_way.popleft().copy()
        u[1] *= self._mismatch.heater
        asked, self._u = self._u, u
        self._held = (nan,) * 4  # what acts may have moved on
        reached = super()._step(w * self._mismatch.load)
        self._u = asked
        return reached

    def _sample(self, y: RealArray) -> tuple[float, ...]:
        y = np.array(y)
        y[L1] *= self._mismatch.level_gauge
        return super()._sample(y)
