"""A state estimator: a Kalman filter that computes its gain at each measurement, by the readings that there are."""

import numpy as np


class RunningCovariance:
    """Made for each session from the model. The load's mismatch is the last state, which nothing moves."""

    def __init__(self, model):
        self.A = np.block([[model.A, model.F], [np.zeros(len(model.A)), np.ones(1)]])
        self.C, self.D, self.G = np.hstack([model.C, model.G]), model.D, model.G
        self.noise = model.noise**2
        self.process = np.diag(model.walks**2)  # in a tick
        self.P = 2000.0 * self.process

    def correct(self, predicted, mismatch, measured):
        """Return the state and the load's mismatch after a measurement."""
        A = np.linalg.matrix_power(self.A, measured.ticks)
        self.P = A @ self.P @ A.T + measured.ticks * self.process
        x, there = np.append(predicted, mismatch), np.isfinite(measured.y)
        expected = self.C @ x + self.D @ measured.u + self.G[:, 0] * measured.load
        C = self.C[there]
        gain = np.linalg.solve(C @ self.P @ C.T + np.diag(self.noise[there]), C @ self.P).T
        x += gain @ (measured.y - expected)[there]
        self.P -= gain @ C @ self.P
        return x[:-1], x[-1]
