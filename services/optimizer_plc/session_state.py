"""What the optimiser's program remembers of a session, as plain records."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coldloop.registers.control_plc import Update
from coldloop.sequence import InputSequence
from optimizer_plc.estimator import Estimate
from optimizer_plc.problem import QuadraticProblem, Situation
from optimizer_plc.updating_period import Assessment

Array = NDArray[np.float64]

UNDECIDED = Assessment(1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Delivery:
    """A profile, the situation it was computed for, and the sequence that tells it to the control PLC."""

    z: Array
    situation: Situation
    first_tick: int
    sequence: InputSequence | None
    qp: QuadraticProblem | None = None
    hot_start: float = 0.0
    last_but_one: float = 0.0
    delivered: float = 0.0
    iterations: int = 0


@dataclass(frozen=True, slots=True)
class Period:
    """An updating period, and what was known when it began."""

    update: Update
    estimate: Estimate
    iterations: int
    ticks: int
    effective: float
    assessment: Assessment


@dataclass(slots=True)
class SessionState:
    """What the program remembers of a session."""

    playing: Delivery
    """What the control PLC plays."""
    sent: Delivery | None = None
    last: Period | None = None
    """The period under way."""
    sequences: int = 0
    """Number of the last sequence."""
    allowance: int = 0
    """Ticks that adaptive periods are longer than the budget says: answers have been late by the clock."""
