"""Make the property tables with CoolProp: `python -m plant.helium.tabulate`.

Run off line only. The result, `helium_tables.npz`, is shipped, so that nothing else needs CoolProp.

Largest errors against CoolProp 8.0 at 1,500 random points of each range (a test holds them): along the 16 bar isobar
h / cp within 2e-7 K, rho and rho cp within 4e-8; at saturation T within 5e-8 K, h within 0.002 J/kg, s within 4e-4
J/(kg K), densities within 3e-7; vapour h / cp within 5e-6 K, cp within 6e-4 (next to the saturation line), T(P, h)
within 5e-6 K, h after the expansion within 6e-4 K times cp, s before it within 0.003 J/(kg K).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from CoolProp.CoolProp import PropsSI
from scipy.interpolate import CubicSpline

from plant.helium.properties import EXCESS_OFFSET, GAS_CONSTANT, SUPERHEAT_OFFSET
from plant.numeric import RealArray

FLUID = "Helium"
P_HP = 16e5
DEPARTURE_NODES = 24
TARGET = Path(__file__).with_name("helium_tables.npz")

# NIST cryogenic material properties, aluminium 6061-T6, 4 to 300 K: log10 c = sum a_k (log10 T)^k, c in J/(kg K).
ALUMINIUM = (46.6467, -314.292, 866.662, -1298.3, 1162.27, -637.795, 210.351, -38.3094, 2.96344)


def tabulate() -> dict[str, RealArray]:
    """Return every table and, under its name with `_grid`, where its grid starts and how it steps."""
    pressures = np.linspace(0.9e5, 1.9e5, 41)
    lines = np.linspace(0.9e5, 1.9e5, 21)
    superheats = np.linspace(np.log(SUPERHEAT_OFFSET), np.log(115.0), 121)
    excesses = np.linspace(np.log(EXCESS_OFFSET), np.log(600e3), 81)
    entropies = np.linspace(0.0, 18e3, 91)
    log_pressures = np.linspace(np.log(1e5), np.log(P_HP), 31)
    log_enthalpies = np.linspace(np.log(36e3), np.log(528e3), 61)
    log_temperatures = np.linspace(np.log(4.0), np.log(300.0), 361)
    return {
        **curves("isobar", log_temperatures, _isobar),
        **curves("departure", log_temperatures, _departure),
        **curves("saturation", pressures, _saturation),
        **surface("vapour", lines, superheats, _vapour),
        **surface("vapour_superheat", lines, excesses, _superheat),
        **surface("vapour_excess", lines, entropies, _excess),
        **surface("turbine_entropy", log_pressures, log_enthalpies, _turbine_entropy),
    }


def curves(name: str, grid: RealArray, functions: Callable[[float], list[float]]) -> dict[str, RealArray]:
    """Tabulate `functions` of one variable on a uniform grid."""
    values = np.array([functions(float(position)) for position in grid])
    step = grid[1] - grid[0]
    slopes = CubicSpline(grid, values)(grid, 1) * step
    return {name: np.stack([values, slopes], axis=-1), f"{name}_grid": np.array([grid[0], step])}


def surface(
    name: str, rows: RealArray, columns: RealArray, function: Callable[[float, float], float]
) -> dict[str, RealArray]:
    """Tabulate a function of two variables on a uniform grid."""
    values = np.array([[function(float(row), float(column)) for column in columns] for row in rows])
    row_step, column_step = rows[1] - rows[0], columns[1] - columns[0]
    along = CubicSpline(columns, values, axis=1)(columns, 1) * column_step
    across = CubicSpline(rows, values, axis=0)(rows, 1) * row_step
    mixed = CubicSpline(rows, along, axis=0)(rows, 1) * row_step
    grid = np.array([rows[0], row_step, columns[0], column_step])
    return {name: np.stack([values, along, across, mixed], axis=-1), f"{name}_grid": grid}


def aluminium_heat_capacity(T: float) -> float:
    """Return the specific heat of aluminium 6061-T6 in J/(kg K), T from 4 to 300 K (NIST, within 5 %)."""
    decades = np.log10(T)
    return float(10.0 ** sum(a * decades**k for k, a in enumerate(ALUMINIUM)))


def _isobar(log_temperature: float) -> list[float]:
    T = float(np.exp(log_temperature))
    h, rho, cp = (_property(name, "P", P_HP, "T", T) for name in ("H", "D", "C"))
    return [h, rho, rho * cp, aluminium_heat_capacity(T)]


def _departure(log_temperature: float) -> list[float]:
    """Return the cubics through 16 bar, in bar from there, that fit h, rho and rho cp best over 5 to 19 bar."""
    T = float(np.exp(log_temperature))
    angles = (np.arange(DEPARTURE_NODES) + 0.5) * np.pi / DEPARTURE_NODES
    pressures = 12e5 + 7e5 * np.cos(angles)
    bars = (pressures - P_HP) / 1e5
    powers = np.stack([bars, bars**2, bars**3], axis=1)
    h, rho, rho_cp, _ = _isobar(log_temperature)
    rows = [[_property(name, "P", float(P), "T", T) for name in ("H", "D", "C")] for P in pressures]
    departures = np.array([[row[0] - h, row[1] - rho, row[1] * row[2] - rho_cp] for row in rows])
    cubics: RealArray = np.linalg.lstsq(powers, departures, rcond=None)[0]
    return [float(coefficient) for coefficient in cubics.T.ravel()]


def _saturation(P: float) -> list[float]:
    return [_property(name, "P", P, "Q", quality) for name, quality in SATURATION]


SATURATION = (("T", 0.0), ("D", 0.0), ("D", 1.0), ("H", 0.0), ("H", 1.0), ("S", 1.0))


def _vapour(P: float, log_superheat: float) -> float:
    return _near_saturation("H", P, "T", float(np.exp(log_superheat)) - SUPERHEAT_OFFSET)


def _superheat(P: float, log_excess: float) -> float:
    T = _near_saturation("T", P, "H", float(np.exp(log_excess)) - EXCESS_OFFSET)
    return float(np.log(T - _property("T", "P", P, "Q", 1.0) + SUPERHEAT_OFFSET))


def _excess(P: float, entropy_rise: float) -> float:
    h = _near_saturation("H", P, "S", entropy_rise)
    return float(np.log(h - _property("H", "P", P, "Q", 1.0) + EXCESS_OFFSET))


def _turbine_entropy(log_pressure: float, log_enthalpy: float) -> float:
    P, h = float(np.exp(log_pressure)), float(np.exp(log_enthalpy))
    return _property("S", "P", P, "H", h) + GAS_CONSTANT * log_pressure


def _near_saturation(name: str, P: float, axis: str, distance: float) -> float:
    """Return a property at `distance` along `axis` from the saturated vapour, which itself needs the quality."""
    if distance < 1e-9:
        return _property(name, "P", P, "Q", 1.0)
    return _property(name, "P", P, axis, _property(axis, "P", P, "Q", 1.0) + distance)


def _property(name: str, first: str, x: float, second: str, y: float) -> float:
    return float(PropsSI(name, first, x, second, y, FLUID))


if __name__ == "__main__":
    tables: dict[str, Any] = tabulate()
    np.savez_compressed(TARGET, **tables)
