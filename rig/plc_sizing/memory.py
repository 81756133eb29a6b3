"""Bytes that the on-line problem takes in the PLC, from the arrays that are computed with."""

from typing import NamedTuple

import numpy as np

from coldloop.registers.control_plc import SEQUENCE_ROWS
from optimizer_plc.computing_settings import Arithmetic, EstimatorSettings
from optimizer_plc.estimator import stationary_gains
from optimizer_plc.qp.arithmetic import real_of
from optimizer_plc.qp.design import N_INPUTS
from optimizer_plc.qp.prediction import PredictionModel
from optimizer_plc.qp.problem import PredictiveProblem
from rig.plc_sizing.operations import WORD

N_VECTORS = 8
"""Vectors of z's size that a step of the ODE solver has at a time, and half as many of gamma's."""


class Footprint(NamedTuple):
    """Bytes in single precision; what is needed for one part of the program each."""

    hessian: int
    """Phi alone."""
    problem: int
    """Gamma, the maps to phi, gamma, the bounds and the constant."""
    shift: int
    """One shift of the profile; its other shifts are computed when they are needed."""
    solver: int
    """Stage matrix and vectors."""
    estimator: int
    """Transitions and Kalman gains of every updating period, output matrices."""
    sequence: int
    """Two buffers of the longest sequence: the one being played, the one being written."""

    @property
    def total(self) -> int:
        """All of it."""
        return sum(self)


def estimator_memory(prediction: PredictionModel, settings: EstimatorSettings) -> int:
    """Return the bytes of the estimator."""
    real = real_of(Arithmetic.FLOAT32)
    single = prediction.rounded(real)
    gains = (gain.astype(real) for gain in stationary_gains(prediction, settings).values())
    transitions = (M for step in single.transitions.values() for M in step)
    return sum(M.nbytes for M in (*gains, *transitions, single.C, single.D, single.G))


def footprint(problem: PredictiveProblem, estimator: int) -> Footprint:
    """Return what a problem made in single precision needs in addition to an estimator of so many bytes."""
    if problem.Phi.dtype != np.float32:
        raise ValueError("the PLC computes in single precision")
    profile = problem.hold(np.zeros(N_INPUTS, problem.Phi.dtype.type))
    return Footprint(
        hessian=problem.Phi.nbytes,
        problem=problem.memory() - problem.Phi.nbytes,
        shift=problem.Phi.nbytes,
        solver=problem.Phi.nbytes + N_VECTORS * profile.nbytes + N_VECTORS // 2 * WORD * len(problem.Gamma),
        estimator=estimator,
        sequence=2 * SEQUENCE_ROWS * N_INPUTS * WORD,
    )
