"""Design of the station's LQ controller, off line: gains from the linearised lines S4 (Bonne et al., CEC 2013, idea).

The states are the pressures of the two lines (bar), the flows through bypass and inventory valves (kg/s), which follow
their commands with the actuators' lag, and the integrals of the two pressures' errors (bar s). Inputs are flows: u =
(bypass, inventory), the inventory flow positive from the buffer into the low-pressure line. `station_control` turns
flows into openings.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from coldloop.process.cold_box import OUTPUT_NAMES, TICK_S
from coldloop_plant.numeric import RealArray
from coldloop_plant.refrigerator.physics import SIGNAL_NAMES, STATE_NAMES
from coldloop_plant.refrigerator.station_settings import LqWeights

LINES = tuple(STATE_NAMES.index(name) for name in ("M_HP", "M_LP"))
PRESSURE_ROWS = tuple(len(STATE_NAMES) + len(OUTPUT_NAMES) + SIGNAL_NAMES.index(name) for name in ("P12", "P11"))
"""Rows of the refrigerator's Jacobian that are those of the two pressures."""


class LineModel(NamedTuple):
    """dp/dt = A p + B (bypass, inventory) of the two pressures, bar and kg/s."""

    A: RealArray
    """Shape (2, 2), 1/s."""
    B: RealArray
    """Shape (2, 2), bar/kg."""


def line_model(jacobian: RealArray) -> LineModel:
    """Return the model of the lines from the refrigerator's Jacobian, with the cold box's states held."""
    scale = np.diag([jacobian[row, line] for row, line in zip(PRESSURE_ROWS, LINES, strict=True)])
    A = scale @ jacobian[np.ix_(LINES, LINES)] @ np.linalg.inv(scale)
    return LineModel(A, scale @ np.array([[-1.0, 0.0], [1.0, 1.0]]))


def lq_gains(lines: LineModel, lag_s: float, weights: LqWeights) -> RealArray:
    """Return K, shape (2, 6), of flows = -K (HP, LP, bypass, inventory, integral of HP, integral of LP)."""
    A = np.zeros((4, 4))
    A[:2, :2], A[:2, 2:] = lines.A, lines.B
    A[2:, 2:] = -np.eye(2) / lag_s
    held = np.zeros((6, 6))
    held[:4, :4], held[2:4, 4:] = A, np.eye(2) / lag_s
    held = expm(held * TICK_S)
    F, G = np.eye(6), np.zeros((6, 2))
    F[:4, :4], G[:4] = held[:4, :4], held[:4, 4:]
    F[4:, :2] = TICK_S * np.eye(2)
    sizes = [weights.hp_bar, weights.lp_bar, np.inf, np.inf, weights.hp_integral, weights.lp_integral]
    Q = np.diag(1.0 / np.square(sizes))
    R = np.diag(1.0 / np.square([weights.bypass_kg_s, weights.inventory_kg_s]))
    P = solve_discrete_are(F, G, Q, R)
    gains: RealArray = np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)
    return gains
