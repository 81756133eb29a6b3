"""Where the prediction model rests."""

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop_optimizer_plc.qp.arithmetic import DOUBLE, Real
from coldloop_optimizer_plc.qp.prediction import PredictionModel

Array = NDArray[np.float64]


def rest_map(prediction: PredictionModel, real: Real = DOUBLE) -> Array:
    """Return what states and load mismatch are at rest, as a map (n + 1, inputs + 2): all deviations.

    It is one of the inputs, of the load, and of the level where there is a bath. There it integrates: any rests, and
    with the inputs and the load that are given only one mismatch lets it. Elsewhere there is no mismatch at rest, and
    where the states do not rest they are those that move least. What inputs and load do not move, as disturbances
    beside the load, is 0 at rest.

    Raises:
        ConfigurationError: With another model, none does.
    """
    n = len(prediction.model.x0)
    A, B, F = (M[:n] for M in prediction.sample)
    moved = prediction.model.moved
    A, B, F = A[np.ix_(moved, moved)], B[moved], F[moved]
    zeros = np.zeros((len(moved), 1))
    found = np.zeros((n + 1, B.shape[1] + 2))
    process = prediction.process
    if process.bath is None:
        found[moved] = np.linalg.pinv(np.eye(len(moved)) - A) @ np.hstack([B, F, zeros])
        return found.astype(real, copy=False)
    level = [process.output_names.index(process.bath.level)]
    C, D, G = (M[level] for M in (prediction.C, prediction.D, prediction.G))
    left = np.block([[np.eye(len(moved)) - A, -F], [C[:, moved], G]])
    right = np.block([[B, F, zeros], [-D, -G, np.ones((1, 1))]])
    try:
        found[[*moved, n]] = np.linalg.solve(left, right)
    except np.linalg.LinAlgError as error:
        raise ConfigurationError(
            "model.file: with constant inputs no load lets the model's states and the level rest; name another model"
        ) from error
    return found.astype(real, copy=False)
