"""A plant of first-order lags with dead times, as identified columns and furnaces are published.

Dead times are whole ticks here, exactly; the prediction model approximates them. So the plant is not its model, and
hides its states.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.process.declaration import Process
from coldloop_plant.numeric import RealArray
from coldloop_plant.own.disturbances import NO_DISTURBANCES, Disturbances, DisturbedPlant
from coldloop_plant.program import HeatLoad, MeasurementNoise


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


class LagTable(NamedTuple):
    """The lags side by side."""

    places: NDArray[np.int64]
    """Outputs that they move."""
    sources: NDArray[np.int64]
    """What they follow: inputs, then load and disturbances."""
    delays: NDArray[np.int64]
    """Ticks."""
    decay: RealArray
    """Of what each has reached, in a tick."""
    gain: RealArray
    about: RealArray
    """Inputs, load and disturbances at the operating point."""
    y0: RealArray
    """Outputs there."""
    measured: NDArray[np.int64]
    """Disturbances that are outputs, the last ones."""


class LagMemory(NamedTuple):
    """What a tick changes."""

    response: RealArray
    """Of each lag."""
    under_way: RealArray
    """What each source was in the ticks of the longest dead time and now, in turn; shape (sources, ticks)."""


@kernel
def advance_lags(c: LagTable, m: LagMemory, tick: int, u: RealArray, w: RealArray, y: RealArray) -> None:
    """Go one tick forward from `tick` with u and w held; y are the outputs then, without disturbances."""
    ticks = m.under_way.shape[1]
    for i in range(c.about.shape[0]):
        m.under_way[i, tick % ticks] = (u[i] if i < u.shape[0] else w[i - u.shape[0]]) - c.about[i]
    for k in range(c.decay.shape[0]):
        arriving = m.under_way[c.sources[k], (tick - c.delays[k]) % ticks]
        m.response[k] = c.decay[k] * m.response[k] + (1.0 - c.decay[k]) * c.gain[k] * arriving
    read_lags(c, m, y)


@kernel
def read_lags(c: LagTable, m: LagMemory, y: RealArray) -> None:
    """Write the outputs without disturbances."""
    for i in range(y.shape[0]):
        y[i] = c.y0[i]
    for k in range(c.places.shape[0]):
        y[c.places[k]] += m.response[k]


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
        process: Whose plant it is.
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
        process: Process,
    ) -> None:
        own = len(process.states) - len(disturbances.courses)
        sources = (*process.input_names, process.load.name, *process.state_names[own:])
        delays = [round(lag.delay_s / process.tick_s) for lag in lags]
        self.constants = LagTable(
            places=np.array([process.output_names.index(lag.output) for lag in lags]),
            sources=np.array([sources.index(lag.source) for lag in lags]),
            delays=np.array(delays),
            decay=np.exp([-process.tick_s / lag.time_constant_s for lag in lags]),
            gain=np.array([lag.gain for lag in lags]),
            about=np.array([*u0, *w0]),
            y0=np.array(y0),
            measured=np.flatnonzero(disturbances.measured),
        )
        self.memory = LagMemory(np.zeros(len(lags)), np.zeros((len(sources), max(delays) + 1)))
        x0 = [*[0.0] * own, *w0[1:]]
        super().__init__(disturbances, x0=x0, u0=u0, load=load, noise=noise, process=process)

    def _warm_up(self) -> None:
        memory, self.memory = self.memory, LagMemory(*(part.copy() for part in self.memory))
        super()._warm_up()
        self.memory = memory

    def _room(self) -> RealArray:
        return np.empty(len(self.process.outputs) - sum(self.disturbances.measured))

    def _own_outputs(self, w: RealArray) -> RealArray:  # noqa: ARG002 nothing acts at once
        y = self._room()
        read_lags(self.constants, self.memory, y)
        return y

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        y = self._room()
        advance_lags(self.constants, self.memory, self.tick, self._u, w, y)
        return self._own, y

    def _saved(self) -> dict[str, Any]:
        return {name: part.tolist() for name, part in self.memory._asdict().items()}

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        kept = LagMemory(**{name: np.array((saved or {})[name], dtype=np.float64) for name in LagMemory._fields})
        if any(part.shape != ours.shape for part, ours in zip(kept, self.memory, strict=True)):
            raise ValueError("the retained state is that of another plant")
        self.memory = kept
