"""Joint intervals of the gains that a record shows: by records drawn anew from its model and what that leaves of it."""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from coldloop.process.lti_model import discretise
from coldloop_rig.process_file.identified import Identified, Record, identified, simulated

Array = NDArray[np.float64]

LEVEL: Final = 0.99
"""Probability with which all gains are in their intervals."""
DRAWS: Final = 30
WIDER: Final = 1.5
"""Factor for slow noise, which a fitted model follows and its draws lack: found over records of a known plant."""


def gains_after(found: Identified, horizon_s: float) -> Array:
    """Return what 1 of each input, held, does to the outputs after a horizon: shape (p, m)."""
    result: Array = found.C @ discretise(found.A, found.B, np.zeros(len(found.A)), horizon_s).B
    return result


def half_widths(record: Record, found: Identified, horizon_s: float) -> Array:
    """Return half the widths of the intervals of the gains, shape (p, m), jointly by Bonferroni's inequality.

    In each draw what a model of the next order leaves of the record is shifted in time and has a random sign, which
    keeps how errors follow one another and each other output's. The gains of a model of the order found, identified
    anew, are off those of the former by noise, and by what the lower order cannot show.
    """
    order, count = len(found.A), len(record.outputs)
    more = identified(record, order + 1)
    y = simulated(more.A, more.B, more.C, np.zeros((len(more.C), more.B.shape[1])), record)
    left = (record.outputs - y) * np.sqrt(count / max(count - more.A.size - more.B.size, 1))
    random, best, errors = np.random.default_rng(1), gains_after(more, horizon_s), []
    for _ in range(DRAWS):
        noise = np.roll(left, random.integers(1, count), axis=0) * random.choice([-1.0, 1.0])
        errors.append(gains_after(identified(record._replace(outputs=y + noise), order), horizon_s) - best)
    quantile = WIDER * stdtrit(DRAWS - 1, 1.0 - (1.0 - LEVEL) / (2 * best.size))
    widths: Array = quantile * np.sqrt((np.array(errors) ** 2).mean(axis=0))
    return widths
