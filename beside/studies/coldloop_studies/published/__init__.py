"""The points of the paper's figures, as far as its source holds them.

Those of the PLC's speed are in `coldloop_rig.plc_sizing.plc`.
"""

import csv
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Series = NDArray[np.float64]
Columns = Mapping[str, Series]

FOLDER = Path(__file__).parent


def _columns(name: str, key: str) -> dict[str, dict[str, Series]]:
    """Return the numeric columns of a file, by the value of the column `key`."""
    with (FOLDER / name).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))  # noqa: TID251 ours
    groups: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault(row.pop(key), []).append(row)
    return {
        group: {column: np.array([float(row[column]) for row in members]) for column in members[0]}
        for group, members in groups.items()
    }


@cache
def solver_comparison() -> Mapping[str, Columns]:
    """Return normalized_power, J_dev, J_cst, J_total, c1, c2 and J_BF of `ode` and `qpoases` (figure `solv_cmp`)."""
    return _columns("fig_solver_comparison.csv", "solver")


@cache
def updating_period() -> Mapping[str, Columns]:
    """Return tau_u_s, cost_fixed_pct and cost_adaptive_pct of the scenarios a to f (figure `tu_opt`)."""
    return _columns("fig_updating_period.csv", "scenario")
