"""The one state of the optimiser in a session, as records and arrays that kernels overwrite."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc.estimator import Belief, no_belief
from coldloop_optimizer_plc.qp.arithmetic import Real
from coldloop_optimizer_plc.rules.interface import MEMORY

Array = NDArray[np.float64]

DELIVERY: Final = (
    ("number", "i8"), ("first_tick", "i8"), ("length", "i8"), ("ticks", "i8"), ("iterations", "i8"), ("w", "real"),
    ("share", "real"), ("hot_start", "real"), ("last_but_one", "real"), ("delivered", "real"), ("j_dev", "real"),
    ("j_cst", "real"), ("violation", "real"),
)  # fmt: skip
"""number, first_tick, length: of the sequence; length 0 where there is none. ticks, w, share: updating period before
the first tick, load (W, a deviation), share of the rate limit. iterations: done. hot_start, last_but_one, delivered:
costs of the guess, after q - 1 and after q iterations. j_dev, j_cst, violation: indicators of the profile."""

PERIOD: Final = (
    ("update", "i8"), ("tick", "i8"), ("q", "i8"), ("iterations", "i8"), ("ticks", "i8"), ("sequences", "i8"),
    ("allowance", "i8"), ("in_time", "i8"), ("planned", "?"), ("solved", "?"), ("load", "real"), ("effective", "real"),
    ("efficiency", "real"), ("mismatch", "real"), ("contraction", "real"), ("gamma", "real"),
    ("guessed_before", "real"), ("delivered_before", "real"), ("shortage", "real"), ("most_open", "real"),
    ("suspects", "i8"),
)  # fmt: skip
"""update, tick, load: of the update under way. q, iterations, ticks, effective: q(t_k), what fits, tau_u and J_k.
efficiency, mismatch, contraction, gamma: what q was decided by. sequences: number of the last sequence. allowance:
ticks that adaptive periods are longer than the budget says. in_time: answers in a row that came in time. planned,
solved: whether there is a period, and an answer to it. guessed_before, delivered_before: J+ and Jhat of the problem
before, infinite where there was none. shortage: what the load is above what can be held (W); negative: below what is
needed. most_open: limit of the feed, a scaled deviation. suspects: readings left out, bit i is output i; after
those of the outputs comes the bit of an input that has no effect."""


class Delivery(NamedTuple):
    """A profile, the parameters it was computed for, and its rows for the control PLC."""

    numbers: Any
    """`DELIVERY`, shape (1,)."""
    x: Array
    """State of the problem, as a deviation, shape (n_x,)."""
    u_before: Array
    """Input before the first knot, as a deviation, shape (3,)."""
    z: Array
    """Shape (n,)."""
    rows: NDArray[np.float32]
    """Inputs as the link carries them, a row a tick, shape (240, 3)."""


class OptimizerState(NamedTuple):
    """State of the optimiser between two updates, and between a plan and its answer."""

    numbers: Any
    """`PERIOD`, shape (1,)."""
    belief: Belief
    playing: Delivery
    """What the control PLC plays."""
    sent: Delivery
    """The last answer. An answer may be computed again from the same state, with the same bits."""
    u: Array
    """Input applied at the update under way, as a deviation, shape (3,): played on where no sequence is."""
    target: Array
    """Inputs that the plant should come to rest at, scaled deviations, shape (3,)."""
    rule: Array
    """What the rule of the updating period remembers, shape (1,)."""


def empty_state(n_states: int, n_inputs: int, n_outputs: int, size: int, real: Real) -> OptimizerState:
    """Return room for the state, for so many states, inputs and outputs of the model, and variables of the problem."""

    def numbers(fields: tuple[tuple[str, str], ...]) -> Any:  # noqa: ANN401 a record
        return np.zeros(1, [(name, real if kind == "real" else kind) for name, kind in fields])

    def delivery() -> Delivery:
        rows = np.zeros((SEQUENCE_ROWS, n_inputs), np.float32)
        x, u, z = (np.zeros(n, real) for n in (n_states, n_inputs, size))
        return Delivery(numbers(DELIVERY), x, u, z, rows)

    return OptimizerState(
        numbers(PERIOD), no_belief(n_states, n_outputs, real), delivery(), delivery(), np.zeros(n_inputs, real),
        np.zeros(n_inputs, real), np.zeros(MEMORY, real),
    )  # fmt: skip
