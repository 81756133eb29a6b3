"""Bytes that the on-line problem takes in the PLC, from the arrays that are computed with."""

from typing import NamedTuple

import numpy as np

from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorSettings
from coldloop_optimizer_plc.estimator import stationary_gains
from coldloop_optimizer_plc.qp.arithmetic import real_of
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem
from coldloop_optimizer_plc.settings import SolverName
from coldloop_rig.plc_sizing.operations import WORD


class Workspace(NamedTuple):
    """What a solver holds at a time besides the problem, in numbers of single precision; zeros are stored.

    Our own solvers as in their code, without copies of Phi and Gamma in another order; the others as their papers have
    them.
    """

    matrices: int
    """Elements of matrices."""
    by_variable: int
    """Vectors with an element for each variable."""
    by_row: int
    """Vectors with an element for each row of Gamma."""


def workspaces(n: int, m: int) -> dict[SolverName, int]:
    """Return the bytes of each solver's workspace for n variables and m rows."""
    triangle = n * (n + 1) // 2
    held = {
        # stage matrix; three points, four velocities, variables held; excess and three sets of active rows
        SolverName.ODE: Workspace(n * n, 8, 4),
        # Q, R, T; z, multipliers and data (gradient, bounds) with their steps, two products
        SolverName.QPOASES: Workspace(3 * n * n, 12, 6),
        # L; z and z~ with scaling, five vectors of the rows of Gamma and of the n bounds, D of L D L'
        SolverName.OSQP: Workspace(n * m + triangle, 10, 6),
        # z, the extrapolated point, gradient, change, step sizes; excess and active rows
        SolverName.FAST_GRADIENT: Workspace(0, 5, 2),
        # Newton matrix; point, step, predicted point (z and two multipliers each), distances of both points, products,
        # gradient, best point
        SolverName.INTERIOR_POINT: Workspace(n * n, 17, 8),
        # M, R^-1, L; nine vectors of variables, three of rows and bounds
        SolverName.DAQP: Workspace(n * m + 2 * triangle + n + 1, 12, 3),
    }
    sizes = {name: WORD * (one.matrices + one.by_variable * n + one.by_row * m) for name, one in held.items()}
    return {**sizes, SolverName.HYBRID: max(sizes[SolverName.ODE], sizes[SolverName.INTERIOR_POINT])}


class Footprint(NamedTuple):
    """Bytes in single precision; what is needed for one part of the program each."""

    hessian: int
    """Phi alone."""
    problem: int
    """Gamma, the maps to phi, gamma, the bounds and the constant."""
    shift: int
    """One shift of the profile; its other shifts are computed when they are needed."""
    solver: int
    """Its workspace."""
    estimator: int
    """Transitions, Kalman gains and inverse covariances of every updating period, output matrices, states beside."""
    sequence: int
    """Two buffers of the longest sequence: the one being played, the one being written."""

    @property
    def total(self) -> int:
        """All of it."""
        return sum(self)


def estimator_memory(prediction: PredictionModel, settings: EstimatorSettings, apart: int = 0) -> int:
    """Return the bytes of the estimator, with so many predictions beside the filter's."""
    real = real_of(Arithmetic.FLOAT32)
    single = prediction.rounded(real)
    gains = (array.astype(real) for array in stationary_gains(prediction, settings))
    transitions = (M for step in single.transitions.values() for M in step)
    states = WORD * apart * (2 * prediction.n_states + 1)
    return states + sum(M.nbytes for M in (*gains, *transitions, single.C, single.D, single.G))


def footprint(problem: PredictiveProblem, estimator: int, solver: SolverName) -> Footprint:
    """Return what a problem made in single precision needs with a solver and an estimator of so many bytes."""
    if problem.Phi.dtype != np.float32:
        raise ValueError("the PLC computes in single precision")
    return Footprint(
        hessian=problem.Phi.nbytes,
        problem=problem.memory() - problem.Phi.nbytes,
        shift=problem.Phi.nbytes,
        solver=workspaces(problem.size, len(problem.Gamma))[solver],
        estimator=estimator,
        sequence=2 * SEQUENCE_ROWS * problem.design.n_inputs * WORD,
    )
