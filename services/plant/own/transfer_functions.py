"""A plant of first-order lags with dead times, as identified columns and furnaces are published.

Dead times are whole ticks here, exactly; the prediction model approximates them. So the plant is not its model, and
hides its states.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from coldloop.process.loaded import PROCESS
from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES, TICK_S
from plant.numeric import RealArray
from plant.own.disturbances import NO_DISTURBANCES, Disturbances, DisturbedPlant
from plant.program import HeatLoad, MeasurementNoise


class Lag(NamedTuple):
    """How an output follows an input, the load or another disturbance: gain exp(-delay s) / (time constant s + 1)."""

    output: str
    source: str
    gain: float
    time_constant_s: float
    delay_s: float


def lags_of(documents: Sequence[Mapping[str, Any]]) -> tuple[Lag, ...]:
    """Return the lags of a model file."""
    return tuple(Lag(**document) for document in documents)


class TransferFunctionPlant(DisturbedPlant):
    """The lags, each with its own state and what is on its way to it.

    Args:
        lags: How outputs follow inputs and load, by deviations from the operating point.
        y0: Outputs there.
        u0: Inputs there, held until the first `apply`.
        w0: Load and disturbances there.
        load: The load over time.
        disturbances: Others than the load, which are the last states.
        noise: Noise on the measurements; None measures exactly.
    """

    def __init__(
        self,
        lags: Sequence[Lag],
        *,
        y0: Sequence[float],
        u0: Sequence[float],
        w0: Sequence[float],
        load: HeatLoad,
        disturbances: Disturbances = NO_DISTURBANCES,
        noise: MeasurementNoise | None = None,
    ) -> None:
        self._y0, self._about = np.array(y0), np.array([*u0, *w0])
        self._places = [OUTPUT_NAMES.index(lag.output) for lag in lags]
        count = len(disturbances.courses)
        sources = (*INPUT_NAMES, PROCESS.load.name, *STATE_NAMES[len(STATE_NAMES) - count :])
        self._sources = [sources.index(lag.source) for lag in lags]
        self._decay = np.exp([-TICK_S / lag.time_constant_s for lag in lags])
        self._gain = np.array([lag.gain for lag in lags])
        self._response = np.zeros(len(lags))
        self._under_way = [deque([0.0] * round(lag.delay_s / TICK_S)) for lag in lags]
        x0 = [*[0.0] * (len(STATE_NAMES) - count), *w0[1:]]
        super().__init__(disturbances, x0=x0, u0=u0, load=load, noise=noise)

    def _warm_up(self) -> None:
        """Do nothing: a tick would move what is under way."""

    def _own_outputs(self, w: RealArray) -> RealArray:  # noqa: ARG002 nothing acts at once
        y = self._y0[: len(self._y0) - sum(self._disturbances.measured)].copy()
        for place, response in zip(self._places, self._response, strict=True):
            y[place] += response
        return y

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        moved = np.append(self._u, w) - self._about
        arriving = np.empty(len(self._response))
        for k, (source, under_way) in enumerate(zip(self._sources, self._under_way, strict=True)):
            under_way.append(moved[source])
            arriving[k] = under_way.popleft()
        self._response = self._decay * self._response + (1.0 - self._decay) * self._gain * arriving
        return self._own, self._own_outputs(w)

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        own = {"response": self._response.tolist(), "under_way": [list(each) for each in self._under_way]}
        return {**super().retained(), "own": own}

    def resume(
        self,
        tick: int,
        x: Sequence[float],
        u: Sequence[float],
        y: Sequence[float],
        noise_state: Mapping[str, Any],
        own: Mapping[str, Any] | None = None,
    ) -> None:
        """Resume from what `retained` returned (ValueError or KeyError if it is not of this plant)."""
        if own is None or len(own["under_way"]) != len(self._under_way):
            raise ValueError("the retained state is that of another plant")
        super().resume(tick, x, u, y, noise_state)
        self._response = np.array(own["response"], dtype=np.float64)
        self._under_way = [deque(map(float, each)) for each in own["under_way"]]
