"""Recording of a run: samples, updates and events, which a rig reports to a recorder and the recorder to sinks.

The `Recorder` passes samples on in blocks, and updates when their sequence was played. Sinks write files, evaluate,
show a line, or keep all in memory. Indicators of a run (paper, section V) are summed by a sink, or from a recording.
"""

import hashlib
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from functools import partial
from itertools import islice
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ColdloopError, LinkError
from coldloop.process import cold_box, lti_model
from coldloop.registers import common, control_plc, optimizer_plc, plant
from coldloop.registers.optimizer_plc import Optimization
from coldloop_optimizer_plc.qp.prediction import state_weights
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.results.columns import excess_keys


class Way(StrEnum):
    """Connection of the three programs."""

    IN_PROCESS = "in-process"
    LOCALHOST = "localhost"
    ATTACHED = "attached"
    RECORDED = "recorded"
    """Recording of another client's session, which is not driven."""
    CHAOS = "chaos"
    """Three services on localhost with injected faults."""


FloatArray = NDArray[np.float32]

CONTROL: Final = "control_plc"
PLANT: Final = "plant"
"""Services that have a journal."""

NO_STATION: FloatArray = np.empty((0, 0), np.float32)
STATION_COLUMNS = len(cold_box.STATION_SIGNAL_NAMES) + 2


class LinkStatistics(NamedTuple):
    """Timing of a run, as counted by the control PLC."""

    deadline_misses: int = 0
    overruns: int = 0
    lateness_max_ms: float = 0.0
    lateness_p99_ms: float = 0.0


class SampleBlock(NamedTuple):
    """N ticks in a row."""

    first: int
    """Tick of the first row."""
    load: FloatArray
    """W, shape (N,)."""
    u: FloatArray
    """Inputs applied, shape (N, inputs)."""
    y: FloatArray
    """Measured outputs, shape (N, outputs)."""
    x: FloatArray
    """Simulated states, shape (N, states)."""
    station: FloatArray = NO_STATION
    """Signals, mode and alarms of the compression station, shape (N, 21); (0, 0) for a cold box alone."""

    def split(self, ticks: int) -> tuple["SampleBlock", "SampleBlock"]:
        """Return the first `ticks` ticks, and the rest."""
        parts = self[1:]
        head = SampleBlock(self.first, *(part[:ticks] for part in parts))
        return head, SampleBlock(self.first + ticks, *(part[ticks:] for part in parts))

    @property
    def rows(self) -> NDArray[np.float32]:
        """Load, inputs, outputs and states side by side, shape (N, signals)."""
        side_by_side = np.hstack([self.load[:, None], self.u, self.y, self.x])
        return np.ascontiguousarray(side_by_side, dtype="<f4")

    @property
    def digested(self) -> bytes:
        """Bytes that the digest of a trace covers: the rows, each followed by the station's where there is one."""
        if not self.station.size:
            return self.rows.tobytes()
        return np.ascontiguousarray(np.hstack([self.rows, self.station]), dtype="<f4").tobytes()


class PendingTicks:
    """The newest ticks of a run, in a row, which may still be replaced; `first` is the oldest of them."""

    def __init__(self) -> None:
        self._parts: list[FloatArray] = []
        self._has_station = False
        self.first, self.count = 0, 0

    def extend(self, ticks: int, like: plant.PlantSample | SampleBlock) -> None:
        """Add ticks of which nothing is known, of as many signals as a sample or a block has."""
        end = self.count + ticks
        if not self._parts:
            sizes = (1, *(np.shape(part)[-1] for part in (like.u, like.y, like.x)), STATION_COLUMNS)
            self._parts = [np.empty((max(2048, end), size), np.float32) for size in sizes]
        if end > len(self._parts[0]):
            self._parts = [np.resize(part, (2 * end, part.shape[1])) for part in self._parts]
        for part in self._parts:
            part[self.count : end] = np.nan
        self.count = end

    def put(self, sample: plant.PlantSample, station: plant.StationSample | None) -> bool:
        """Put a tick where it belongs; return whether nothing was known of it before."""
        row = sample.tick - self.first
        load, u, y, x, warm = self._parts
        unknown = bool(np.isnan(load[row, 0]))
        load[row, 0], u[row], y[row], x[row] = sample.load, sample.u, sample.y, sample.x
        if station is not None:
            self._has_station = True
            warm[row] = (*station.signals, station.mode, station.alarms)
        return unknown

    def append(self, block: SampleBlock) -> None:
        """Add ticks in a row."""
        self.extend(len(block.load), block)
        rows = slice(self.count - len(block.load), self.count)
        load, u, y, x, warm = self._parts
        load[rows, 0], u[rows], y[rows], x[rows] = block.load, block.u, block.y, block.x
        if block.station.size:
            self._has_station = True
            warm[rows] = block.station

    def take(self, ticks: int) -> SampleBlock:
        """Take the oldest ticks away."""
        ticks = min(ticks, self.count)
        load, u, y, x, warm = (part[:ticks].copy() for part in self._parts)
        for part in self._parts:
            part[: self.count - ticks] = part[ticks : self.count].copy()
        first, self.first, self.count = self.first, self.first + ticks, self.count - ticks
        return SampleBlock(first, load[:, 0], u, y, x, warm if self._has_station else NO_STATION)


def joined(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """Return blocks that follow each other as one."""
    if not blocks:
        return SampleBlock(0, np.empty(0, np.float32), *(np.empty((0, 0), np.float32) for _ in range(3)))
    columns = (np.concatenate(parts) for parts in zip(*(block[1:] for block in blocks), strict=True))
    return SampleBlock(blocks[0].first, *columns)


class Recording(NamedTuple):
    """A finished run of N ticks in memory."""

    load: FloatArray
    """W, shape (N,)."""
    u: FloatArray
    """Inputs applied, shape (N, inputs)."""
    y: FloatArray
    """Measured outputs, shape (N, outputs)."""
    x: FloatArray
    """Simulated states, shape (N, states)."""
    updates: list[optimizer_plc.Optimization]
    link: LinkStatistics
    station: FloatArray = NO_STATION
    """Samples of the station as in `SampleBlock`."""
    events: Sequence[tuple[str, common.Event]] = ()
    """Events of the journals, each with the service that reported it."""

    @property
    def block(self) -> SampleBlock:
        """The trace as one block."""
        return SampleBlock(0, self.load, self.u, self.y, self.x, self.station)

    @property
    def trace_sha256(self) -> str:
        """SHA-256 over load, inputs, outputs, states and station of all ticks, as little-endian single precision."""
        return hashlib.sha256(self.block.digested).hexdigest()


BLOCK_TICKS: Final = 512
"""Samples that are passed on together."""
SETTLED_TICKS: Final = 512
"""An update that nothing has followed for so long after its period was not cut off. In a networked run samples are
read up to 256 ticks before the updates that go with them."""
KEPT_TICKS: Final = BLOCK_TICKS  # newest ticks that are not passed on yet: a restarted plant may do some of them again


class Sink:
    """Takes what a run yields. The methods do nothing; a sink overrides those that concern it."""

    def begin(self) -> None:
        """Real time begins to count: the first tick is about to be done."""

    def sample(self, sample: plant.PlantSample) -> None:
        """Take a tick as it is done."""

    def block(self, block: SampleBlock) -> None:
        """Take up to `BLOCK_TICKS` ticks."""

    def reported(self, update: optimizer_plc.Optimization) -> None:
        """Take an update as it is reported, before it is known whether its sequence is played."""

    def update(self, update: optimizer_plc.Optimization) -> None:
        """Take an update whose sequence was played, before the block that its period ends in is much older."""

    def event(self, service: str, event: common.Event) -> None:
        """Take an event of the journal of a service, `control_plc` or `plant`."""

    def close(self) -> None:
        """Nothing more comes; raises what kept the sink from its work."""


class MemorySink(Sink):
    """Keeps the whole run: about 220 bytes a tick."""

    def __init__(self) -> None:
        self._blocks: list[SampleBlock] = []
        self._updates: list[optimizer_plc.Optimization] = []
        self.events: list[tuple[str, common.Event]] = []

    def block(self, block: SampleBlock) -> None:
        """Keep a block."""
        self._blocks.append(block)

    def update(self, update: optimizer_plc.Optimization) -> None:
        """Keep an update."""
        self._updates.append(update)

    def event(self, service: str, event: common.Event) -> None:
        """Keep an event."""
        self.events.append((service, event))

    def recording(self, link: LinkStatistics) -> Recording:
        """Return what was kept."""
        block = joined(self._blocks)
        return Recording(block.load, block.u, block.y, block.x, self._updates, link, block.station, self.events)


class Recorder:
    """Passes what a run yields to its sinks.

    Args:
        ticks: Length of the run.
        sinks: Who takes it; by default a sink in memory, whose content `recording` returns.
    """

    def __init__(self, ticks: int, sinks: Sequence[Sink] | None = None) -> None:
        self.ticks = ticks
        self.next_tick = 0
        """First tick that is still to come."""
        self.missing_ticks = 0
        """Ticks before it of which nothing is known."""
        self.link = LinkStatistics()
        self._memory = MemorySink()
        self._sinks = (self._memory,) if sinks is None else tuple(sinks)
        self._pending = PendingTicks()
        self._stations: dict[int, plant.StationSample] = {}
        """Samples of the station, by ticks whose own sample is still to come."""
        self._unsettled: deque[optimizer_plc.Optimization] = deque()
        self._stop: ColdloopError | None = None
        self._closed = False
        self._began = self._last = time.monotonic()

    def begin(self) -> None:
        """Begin to count real time: the first tick is about to be done."""
        self._began = self._last = time.monotonic()
        for sink in self._sinks:
            sink.begin()

    @property
    def wall_seconds(self) -> float:
        """Real time from the beginning to the last sample."""
        return self._last - self._began

    def stop(self, reason: ColdloopError) -> None:
        """Let the next sample raise `reason`: a signal handler calls this."""
        self._stop = reason

    def sample(self, sample: plant.PlantSample) -> None:
        """Take the next tick; or a later one, and those before it are unknown; or one of the last ones that came again.

        Raises LinkError: a tick came again that is older than `KEPT_TICKS`; ColdloopError: the run is to stop; the tick
        is recorded.
        """
        place = sample.tick - self._pending.first
        if place < 0:
            raise LinkError(
                f"tick {sample.tick} was repeated after tick {self.next_tick - 1}: the plant was set back too far"
            )
        missing = max(0, sample.tick - self.next_tick)
        again = sample.tick < self.next_tick
        if not again:
            self._pending.extend(missing + 1, sample)
            self.next_tick = sample.tick + 1
        unknown = self._pending.put(sample, self._stations.pop(sample.tick, None))
        self.missing_ticks += missing - (again and unknown)
        self._taken(sample)

    def stretch(self, block: SampleBlock, updates: Sequence[optimizer_plc.Optimization]) -> None:
        """Take ticks and their updates at once; sinks see the last one. Raises ColdloopError: the run is to stop."""
        for update in updates:
            self.update(update)
        self._pending.append(block)
        self.next_tick += len(block.load)
        load, u, y, x = (part[-1].tolist() for part in (block.load, block.u, block.y, block.x))
        self._taken(plant.PlantSample(self.next_tick - 1, load, tuple(u), tuple(y), tuple(x)))

    def _taken(self, sample: plant.PlantSample) -> None:
        self._last = time.monotonic()
        for sink in self._sinks:
            sink.sample(sample)
        if self._pending.count >= BLOCK_TICKS + KEPT_TICKS:
            self._pass_on()
        if self._stop is not None:
            raise self._stop

    def station(self, sample: plant.StationSample) -> None:
        """Take what goes with a tick that is about to come, where the plant is a whole refrigerator."""
        self._stations[sample.tick] = sample

    def update(self, update: optimizer_plc.Optimization) -> None:
        """Take the next update, also one that a load step will cut off."""
        self._unsettled.append(update)
        for sink in self._sinks:
            sink.reported(update)
        if len(self._unsettled) > BLOCK_TICKS:
            self._settle()

    def event(self, event: common.Event, service: str = CONTROL) -> None:
        """Take an event of the journal of a service; before the ticks after it are older than `SETTLED_TICKS`."""
        for sink in self._sinks:
            sink.event(service, event)

    def close(self) -> None:
        """Pass on what is left, and close all sinks, each of them even if another one fails.

        Raises OSError: a sink could not write; ColdloopError: the disk is full.
        """
        if not self._closed:
            self._closed = True
            _all(self._pass_on, *(sink.close for sink in self._sinks))

    def recording(self) -> Recording:
        """Return what is in memory, with the updates whose sequence was played: none that a load step cut off."""
        self.close()
        return self._memory.recording(self.link)

    def _pass_on(self) -> None:
        """Pass on all blocks that are whole and old enough; at the end all that is left."""
        self._settle()
        kept = 0 if self._closed else KEPT_TICKS
        calls = []
        while self._pending.count > kept and (self._closed or self._pending.count >= BLOCK_TICKS + kept):
            block = self._pending.take(BLOCK_TICKS)
            calls += [partial(sink.block, block) for sink in self._sinks]
        _all(*calls)

    def _settle(self) -> None:
        while self._unsettled:
            update, *following = tuple(islice(self._unsettled, 2))
            end = update.tick + update.tau_u
            cut_off = bool(following) and following[0].tick < end
            latest = end if following or self._closed else end + SETTLED_TICKS - 1
            if not cut_off and self.next_tick <= latest:
                return
            self._unsettled.popleft()
            if not cut_off:
                _all(*(partial(sink.update, update) for sink in self._sinks))


def _all(*calls: Callable[[], None]) -> None:
    """Make all calls, then raise the first error: what one sink cannot do does not concern the others."""
    errors = []
    for call in calls:
        try:
            call()
        except (OSError, ColdloopError) as error:
            errors.append(error)
    if errors:
        raise errors[0]


class Indicators(NamedTuple):
    """Costs are in the units of the predictive problem's J; sums run over the problems solved, as in the paper.

    What does not exist is NaN: without updates all that is predicted, without ticks all that is measured.
    """

    J_dev: float
    """Sum over the problems of the predicted deviation cost."""
    J_cst: float
    """Sum over the problems of the predicted violation cost."""
    J_open_mean: float
    """Mean of J_dev + J_cst per unit of time: comparable between updating periods. A problem weighs by the time since
    the last delivery, which counts the time lost by an interrupted one."""
    J_BF: float
    """Closed-loop cost: sum of the instantaneous cost over the sampling periods of 5 s."""
    c1: float
    """Largest predicted constraint violation, in the units of the row."""
    c2: float
    """Mean over the problems of the largest predicted violation."""
    tau_u_mean: float
    """Mean updating period over time, s: the mean length of the period that a moment belongs to."""
    tau_u_mean_per_update: float
    """Mean updating period over the updates, s, in which short periods count more often."""
    iterations_total: int
    outside_band_pct: Mapping[str, float]
    """Share of the known ticks, %, in which each output with a band was outside, by name."""

    @property
    def by_name(self) -> dict[str, float]:
        """All of them, by the names that they have in `summary.json`."""
        shares = {f"{name}_outside_band_pct": share for name, share in self.outside_band_pct.items()}
        return {**dict(zip(self._fields[:-1], self[:-1], strict=True)), **shares}


def excess_of(y: NDArray[Any], design: ControlDesign) -> NDArray[np.float64]:
    """Return by how much outputs (N, outputs) are beyond their bands, shape (N, bands); NaN where one is unknown.

    An output is outside where that is more than its dead band.
    """
    constrained = y[:, design.process.controlled].astype(float)
    beyond = np.maximum(constrained - design.output_high, design.output_low - constrained)
    return np.maximum(beyond, 0.0)


class StageCost:
    """The stage cost of what was really reached: deviations from the operating point, and violations of the bands."""

    def __init__(self, model: lti_model.LtiModel, design: ControlDesign) -> None:
        self.process = design.process
        n = len(self.process.states)  # a model of the whole refrigerator has further ones, which weigh nothing
        self._x0, self._u0, self._y0 = model.x0[:n], model.u0, model.y0
        self._output_weights = np.array([output.weight for output in self.process.outputs])
        self._outputs_weigh = bool(self._output_weights.any())
        self._state_weights = state_weights(model, design)[:n]
        self._design = design

    def of(self, block: SampleBlock) -> NDArray[np.float64]:
        """Return the cost of each tick, shape (N,)."""
        design = self._design
        x = block.x.astype(float) - self._x0
        u = block.u.astype(float) - self._u0
        cost: NDArray[np.float64] = (
            (x**2 * self._state_weights).sum(axis=1)
            + (u**2 * design.input_weight).sum(axis=1)
            + (excess_of(block.y, design) ** 2 * design.violation_weight).sum(axis=1)
        )
        if self._outputs_weigh:
            cost += ((block.y - self._y0) ** 2 * self._output_weights).sum(axis=1)
        return cost


def has_no_answer(update: Optimization) -> bool:
    """Return whether an update had no answer; in real time it may have been rejected for another reason first."""
    cost = update.j_dev + update.j_cst + update.violation
    return update.verdict == control_plc.Verdict.NO_ANSWER or not math.isfinite(cost)


class RunEvaluation(Sink):
    """Sums the indicators of a run, and its digest, in constant memory; ticks that are unknown add nothing."""

    def __init__(self, model: lti_model.LtiModel, design: ControlDesign) -> None:
        self._cost = StageCost(model, design)
        self.process, self._design = design.process, design
        self._digest = hashlib.sha256()
        self._outside = np.zeros(len(self.process.banded), dtype=int)
        self._beyond, self._furthest, self._excess = np.zeros((3, len(self.process.banded)))
        self._stage_costs = 0.0
        self._j_dev = self._j_cst = self._weighted = self._violations = self._largest = 0.0
        self._taus = self._squared_taus = self._delivered = self._known = 0
        self.ticks = self.updates = self.iterations = self.failed_updates = 0

    def block(self, block: SampleBlock) -> None:
        """Take ticks."""
        constrained = block.y[:, self.process.controlled]
        outside = (constrained < self._design.output_low) | (constrained > self._design.output_high)
        self._outside += outside.sum(axis=0)
        excess = excess_of(block.y, self._design)
        self._beyond += (excess > self.process.dead_bands).sum(axis=0)
        self._furthest = np.fmax(self._furthest, np.fmax.reduce(excess, axis=0, initial=0.0))
        self._excess += np.nansum(excess, axis=0) * self.process.tick_s
        self._known += int(np.isfinite(block.load).sum())
        self._stage_costs += float(np.nansum(self._cost.of(block)))
        self._digest.update(block.digested)
        self.ticks += len(block.load)

    def update(self, update: Optimization) -> None:
        """Take an update; one without an answer has no prediction."""
        if has_no_answer(update):
            self.failed_updates += 1
            return
        delivered = update.tick + update.tau_u
        self._j_dev += update.j_dev
        self._j_cst += update.j_cst
        self._weighted += (update.j_dev + update.j_cst) * (delivered - self._delivered)
        self._delivered = delivered
        self._violations += update.violation
        self._largest = max(self._largest, update.violation)
        self._taus += update.tau_u
        self._squared_taus += update.tau_u**2
        self.iterations += update.iterations
        self.updates += 1

    @property
    def trace_sha256(self) -> str:
        """SHA-256 over load, inputs, outputs, states and station of all ticks, as little-endian single precision."""
        return self._digest.hexdigest()

    @property
    def excesses(self) -> dict[str, float]:
        """Excess of each output over its band, with the names of `excess_keys`; NaN where no tick is known."""
        known = self._known or math.nan
        exists = known / known
        by_band = zip(100.0 * self._beyond / known, self._furthest * exists, self._excess * exists, strict=True)
        return dict(zip(excess_keys(self.process), [float(one) for values in by_band for one in values], strict=True))

    @property
    def indicators(self) -> Indicators:
        """The indicators of what was taken so far."""
        count, known = self.updates or math.nan, self._known or math.nan
        exists, tick_s = 1.0 if self.updates else math.nan, self.process.tick_s
        shares = (100.0 * self._outside / known).tolist()
        return Indicators(
            J_dev=self._j_dev * exists,
            J_cst=self._j_cst * exists,
            J_open_mean=self._weighted / (self._delivered or math.nan),
            J_BF=self._stage_costs / self.process.ticks_per_sample if self._known else math.nan,
            c1=self._largest * exists,
            c2=self._violations / count,
            tau_u_mean=self._squared_taus * tick_s / (self._taus or math.nan),
            tau_u_mean_per_update=self._taus * tick_s / count,
            iterations_total=self.iterations,
            outside_band_pct={one.name: share for one, share in zip(self.process.banded, shares, strict=True)},
        )


def evaluate(recording: Recording, model: lti_model.LtiModel, design: ControlDesign) -> Indicators:
    """Return the indicators of a recording, as `RunEvaluation` would have summed them."""
    evaluation = RunEvaluation(model, design)
    rest = recording.block
    while len(rest.load):
        block, rest = rest.split(BLOCK_TICKS)
        evaluation.block(block)
    for update in recording.updates:
        evaluation.update(update)
    return evaluation.indicators
