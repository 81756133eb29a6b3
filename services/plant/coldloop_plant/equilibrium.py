"""Toolbox for a plant given by its equations: linear model, state of rest, modes, model file.

The equations are functions of one vector z = (x, u, w), states first. They return dx/dt and, where outputs count, y
after it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple, Self

import numpy as np

from coldloop.process import declaration, lti_model
from coldloop_plant.numeric import Array, RealArray

COMPLEX_STEP = 1e-30  # in sizes of the variables
TOLERANCE = 1e-10  # of a state of rest, in sizes of the states per second


class Linear(NamedTuple):
    """dx/dt = A x + B u + F w, y = C x + D u + G w, in deviations and physical units, time in seconds."""

    A: RealArray  # Shapes (n, n), (n, m) and (n, k), or (n,) where w is one number
    B: RealArray
    F: RealArray
    C: RealArray  # Shapes (p, n), (p, m) and (p, k), or (p,)
    D: RealArray
    G: RealArray

    @classmethod
    def of(cls, jacobian: RealArray, states: int, inputs: int) -> Self:
        """Return the blocks of a Jacobian of (dx/dt, y) with respect to z."""
        rows, columns = np.split(jacobian, [states]), [states, states + inputs]
        return cls(*(block for each in rows for block in np.split(each, columns, axis=1)))


def complex_step(function: Callable[[Array], Array], at: RealArray, sizes: RealArray) -> RealArray:
    """Return the Jacobian of a function by f'(z) = Im f(z + i h) / h: without subtraction, and so exact to rounding."""
    columns = []
    for k, step in enumerate(COMPLEX_STEP * sizes):
        moved = at.astype(np.complex128)
        moved[k] += 1j * step
        columns.append(function(moved).imag / step)
    return np.stack(columns, axis=1)


def central_differences(
    function: Callable[[RealArray], RealArray], at: RealArray, steps: RealArray
) -> tuple[RealArray, RealArray]:
    """Return the Jacobian of a function by central differences, with `steps` and with steps twice as wide."""
    by_step = []
    for widths in (steps, 2.0 * steps):
        moves = zip(np.diag(widths), widths, strict=True)
        by_step.append(np.array([(function(at + move) - function(at - move)) / (2 * h) for move, h in moves]).T)
    return by_step[0], by_step[1]


class NoEquilibriumError(ValueError):
    """The plant does not come to rest."""


def newton(
    z: RealArray, rates: Callable[[RealArray], RealArray], step: Callable[[RealArray, RealArray], RealArray],
    most_steps: int, what: str,
) -> tuple[RealArray, float]:  # fmt: skip
    """Return where a plant rests, and the largest rate left.

    Args:
        z: Where the search begins: the unknowns.
        rates: Of z: dx/dt, in sizes of the states per second.
        step: Of z and its rates: the next z; may raise `LinAlgError`.
        most_steps: After which there is no rest.
        what: Begins the message.

    Raises:
        NoEquilibriumError: It does not converge.
    """
    for _ in range(most_steps):
        moving = rates(z)
        residual = float(np.max(np.abs(moving)))
        if residual < TOLERANCE:
            return z, residual
        if not isfinite(residual):
            break
        try:
            z = step(z, moving)
        except np.linalg.LinAlgError:
            break
    raise NoEquilibriumError(f"{what}: the residual stays at {residual:.2g} per second")


FASTEST = 4.0
"""Largest rate at rest, 1/s. A tick of 0.25 s follows 11 /s, and away from rest rates are up to three times as large;
the reference plant has 1.6 /s."""
GROWTH = 1e-4  # Rate from which on a deviation is said to grow, 1/s; that of the level is 0 but for rounding


class Modes(NamedTuple):
    """The modes of a plant."""

    rates: RealArray  # Real parts of the eigenvalues, 1/s
    parts: list[str]  # Part of the plant that moves most with each

    @classmethod
    def of(cls, A: RealArray, sizes: RealArray, parts: Sequence[str]) -> Self:
        """Return the modes of A (n, n), with the size of an ordinary deviation and the part of each state."""
        rates, vectors = np.linalg.eig(A)
        moves = np.abs(vectors / sizes[:, np.newaxis])
        return cls(rates.real, [parts[int(k)] for k in np.argmax(moves, axis=0)])

    def growing(self, held: str = "") -> Iterator[str]:
        """Yield which part runs away; `held` says what is controlled meanwhile."""
        rising = int(np.argmax(self.rates))
        if self.rates[rising] > GROWTH:
            yield (
                f"{self.parts[rising]}: runs away from this operating point within {1.0 / self.rates[rising]:.0f} s"
                f"{held}; take other operating_point.cv155_pct and cv156_pct"
            )

    @property
    def fastest(self) -> str:
        """The part with the fastest mode."""
        return self.parts[int(np.argmin(self.rates))]

    def too_fast(self, slower: Callable[[str], str]) -> Iterator[str]:
        """Yield which part follows faster than steps of a tick can, and what makes it slower."""
        rate = self.rates.min()
        if rate < -FASTEST:
            part = self.fastest
            yield f"{part}: follows within {-1.0 / rate:.2g} s, too fast for a tick; {slower(part)}"


def model_of(
    linear: Linear, x0: RealArray, u0: RealArray, w0: float, y0: RealArray, declared: declaration.Process,
    states: Mapping[str, str], digest: str, **described: Any,  # noqa: ANN401 as the fields are
) -> lti_model.LtiModel:  # fmt: skip
    """Return the model file of a linear model at a point, for one load and a tick of its process.

    F and G of the linear model have one dimension. `states` are names and units, `digest` is that of what the model is
    made from, `described` are further fields of `LtiModel`.
    """
    tick = lti_model.discretise(linear.A, linear.B, linear.F, declared.tick_s)
    return lti_model.LtiModel(
        **linear._asdict(), A_tick=tick.A, B_tick=tick.B, F_tick=tick.F, x0=x0, u0=u0, w0=w0, y0=y0,
        state_names=tuple(states), state_units=tuple(states.values()),
        input_names=declared.input_names, input_units=declared.input_units,
        output_names=declared.output_names, output_units=declared.output_units,
        load_name=declared.load.name, load_unit=declared.load.unit, parameters_digest=digest, **described,
    )  # fmt: skip
