"""Indicators of a run (paper, section V), summed during the run or from a recording."""

import hashlib
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.lti_model import LtiModel
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import Optimization
from coldloop_optimizer_plc.qp.prediction import state_weights
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig.results.columns import excess_keys
from coldloop_rig.results.recording import BLOCK_TICKS, Recording, SampleBlock, Sink


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

    def __init__(self, model: LtiModel, design: ControlDesign) -> None:
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
    return update.verdict == Verdict.NO_ANSWER or not math.isfinite(update.j_dev + update.j_cst + update.violation)


class RunEvaluation(Sink):
    """Sums the indicators of a run, and its digest, in constant memory; ticks that are unknown add nothing."""

    def __init__(self, model: LtiModel, design: ControlDesign) -> None:
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


def evaluate(recording: Recording, model: LtiModel, design: ControlDesign) -> Indicators:
    """Return the indicators of a recording, as `RunEvaluation` would have summed them."""
    evaluation = RunEvaluation(model, design)
    rest = recording.block
    while len(rest.load):
        block, rest = rest.split(BLOCK_TICKS)
        evaluation.block(block)
    for update in recording.updates:
        evaluation.update(update)
    return evaluation.indicators
