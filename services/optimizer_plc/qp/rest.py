"""Where the prediction model rests."""

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.process.loaded import PROCESS
from coldloop.process.signals import L1
from optimizer_plc.qp.arithmetic import DOUBLE, Real
from optimizer_plc.qp.prediction import PredictionModel

Array = NDArray[np.float64]


def rest_map(prediction: PredictionModel, real: Real = DOUBLE) -> Array:
    """Return what states and load mismatch are at rest, as a map (n + 1, inputs + 2): all deviations.

    It is one of the inputs, of the load, and of L1 where there is a bath. There L1 integrates: any level rests, and
    with the inputs and the load that are given only one mismatch lets it. Elsewhere there is no mismatch at rest, and
    where the states do not rest they are those that move least.

    Raises:
        ConfigurationError: With another model, none does.
    """
    n = len(prediction.model.x0)
    A, B, F = (M[:n] for M in prediction.sample)
    if not PROCESS.has_bath:
        at_rest = np.linalg.pinv(np.eye(n) - A[:, :n]) @ np.hstack([B, F, np.zeros((n, 1))])
        return np.vstack([at_rest, np.zeros((1, at_rest.shape[1]))]).astype(real, copy=False)
    C, D, G = (M[L1 : L1 + 1] for M in (prediction.C, prediction.D, prediction.G))
    left = np.block([[np.eye(n) - A[:, :n], -F], [C[:, :n], G]])
    right = np.block([[B, F, np.zeros((n, 1))], [-D, -G, np.ones((1, 1))]])
    try:
        return np.linalg.solve(left, right).astype(real, copy=False)
    except np.linalg.LinAlgError as error:
        raise ConfigurationError(
            "model.file: with constant inputs no load lets the model's states and L1 rest; name another model"
        ) from error
