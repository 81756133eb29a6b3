"""Projected gradient steps on a problem whose rows are penalised: the shortest solver that Coldloop can use."""

import numpy as np

PENALTY = 3000.0
"""Weight of a row that is broken, per square; the answers of all solvers are judged with such a weight."""


class ScaledGradient:
    """min z' Phi z + z' phi + PENALTY |max(Gamma z - gamma, 0)|^2, z within its box, by steps of a fixed length."""

    def solve(self, problem, guess, iterations):
        """Return the point after so many iterations from `guess`, and how many were done."""
        hessian = 2.0 * (problem.Phi + PENALTY * problem.Gamma.T @ problem.Gamma)
        step = 1.0 / np.abs(hessian).sum(axis=1)  # rows of a diagonally scaled bound of the largest eigenvalue
        z = guess
        for _ in range(iterations):
            excess = np.maximum(problem.Gamma @ z - problem.gamma, 0.0)
            slope = 2.0 * problem.Phi @ z + problem.phi + 2.0 * PENALTY * problem.Gamma.T @ excess
            z = np.clip(z - step * slope, problem.low, problem.high)
        return z, iterations
