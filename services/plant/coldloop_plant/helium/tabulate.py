"""Make the property tables with CoolProp: `python -m coldloop_plant.helium.tabulate`.

Run off line only. The result, `helium_tables.npz`, is shipped, so that nothing else needs CoolProp. What the shipped
file holds already keeps its bits.

Largest errors against CoolProp 8.0 at 1,500 random points of each range (a test holds them): along the 16 bar isobar
h / cp within 2e-7 K, rho and rho cp within 4e-8; at saturation T within 5e-8 K, h within 0.002 J/kg, s within 4e-4
J/(kg K), densities within 3e-7; vapour h / cp within 5e-6 K, cp within 6e-4 (next to the saturation line), T(P, h)
within 5e-6 K, h after the expansion within 6e-4 K times cp, s before it within 0.003 J/(kg K). That is for 4 to 300 K,
0.9 to 1.9 bar and a turbine from 10 to 100 K. Beyond, to 2.5 K, 0.3 to 2.2 bar and 300 K: T at saturation within 2e-6
K, densities within 3e-4 (dry vapour above 115 K 3e-3), vapour h / cp within 6e-5 K, T(P, h) within 9e-4 K, h after the
expansion within 0.04 K times cp, s before it within 0.1 J/(kg K); up to 2.25 bar, 1 % below the critical pressure,
densities within 1e-3 and h after the expansion within 0.05 K times cp.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from CoolProp.CoolProp import PropsSI
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

from coldloop_plant.helium import EXCESS_OFFSET, GAS_CONSTANT, SUPERHEAT_OFFSET
from coldloop_plant.numeric import RealArray

FLUID = "Helium"
P_HP = 16e5
DEPARTURE_NODES = 24
TARGET = Path(__file__).with_name("helium_tables.npz")

# NIST cryogenic material properties, aluminium 6061-T6, 4 to 300 K: log10 c = sum a_k (log10 T)^k, c in J/(kg K).
ALUMINIUM = (46.6467, -314.292, 866.662, -1298.3, 1162.27, -637.795, 210.351, -38.3094, 2.96344)


class Axis(NamedTuple):
    """A uniform grid: `nodes` of it between two ends, and further ones before and behind them.

    What hours of operation read lies between the ends. The further nodes came later and do not change it, not to the
    last bit.
    """

    first: float
    last: float
    nodes: int
    before: int = 0
    after: int = 0

    @property
    def inner(self) -> RealArray:
        """The nodes between the ends."""
        return np.linspace(self.first, self.last, self.nodes)

    @property
    def whole(self) -> RealArray:
        """All nodes."""
        inner = self.inner
        step = inner[1] - inner[0]
        behind = inner[-1] + step * np.arange(1, self.after + 1)
        return np.concatenate([inner[0] - step * np.arange(self.before, 0, -1), inner, behind])

    @property
    def grid(self) -> list[float]:
        """Start, step, and number of nodes before the start."""
        inner = self.inner
        return [float(inner[0]), float(inner[1] - inner[0]), float(self.before)]


PRESSURES = Axis(0.9e5, 1.9e5, 41, before=24, after=14)
LINES = Axis(0.9e5, 1.9e5, 21, before=12, after=7)
SUPERHEATS = Axis(np.log(SUPERHEAT_OFFSET), np.log(115.0), 121)
EXCESSES = Axis(np.log(EXCESS_OFFSET), np.log(600e3), 81)
ENTROPIES = Axis(0.0, 18e3, 91, after=29)
LOG_PRESSURES = Axis(np.log(1e5), np.log(P_HP), 31, before=13, after=3)
LOG_ENTHALPIES = Axis(np.log(36e3), np.log(528e3), 61, before=40, after=25)
LOG_TEMPERATURES = Axis(np.log(4.0), np.log(300.0), 361, before=40)


def tabulate() -> dict[str, RealArray]:
    """Return every table and, under its name with `_grid`, its axes."""
    return {
        **curves("isobar", LOG_TEMPERATURES, _isobar),
        **curves("departure", LOG_TEMPERATURES, _departure),
        **curves("saturation", PRESSURES, lambda P: [_property(name, "P", P, "Q", q) for name, q in SATURATION]),
        **surface("vapour", LINES, SUPERHEATS, lambda P, log: _at_log("H", P, "T", log, SUPERHEAT_OFFSET)),
        **surface("vapour_superheat", LINES, EXCESSES, _superheat),
        **surface("vapour_density", LINES, EXCESSES, lambda P, log: np.log(_at_log("D", P, "H", log, EXCESS_OFFSET))),
        **surface("vapour_excess", LINES, ENTROPIES, _excess),
        **surface("turbine_entropy", LOG_PRESSURES, LOG_ENTHALPIES, _turbine_entropy),
    }


def curves(name: str, axis: Axis, functions: Callable[[float], list[float]]) -> dict[str, RealArray]:
    """Tabulate `functions` of one variable."""
    values = np.array([functions(float(position)) for position in axis.whole])
    step = axis.grid[1]
    slopes = CubicSpline(axis.whole, values)(axis.whole, 1) * step
    inner = slice(axis.before, axis.before + axis.nodes)
    slopes[inner] = CubicSpline(axis.inner, values[inner])(axis.inner, 1) * step
    return {name: np.stack([values, slopes], axis=-1), f"{name}_grid": np.array(axis.grid)}


def surface(name: str, rows: Axis, columns: Axis, function: Callable[[float, float], float]) -> dict[str, RealArray]:
    """Tabulate a function of two variables."""
    values = np.array([[function(float(row), float(column)) for column in columns.whole] for row in rows.whole])
    nodes = _with_slopes(rows.whole, columns.whole, values)
    row_slice = slice(rows.before, rows.before + rows.nodes)
    column_slice = slice(columns.before, columns.before + columns.nodes)
    nodes[row_slice, column_slice] = _with_slopes(rows.inner, columns.inner, values[row_slice, column_slice])
    return {name: nodes, f"{name}_grid": np.array([*rows.grid, *columns.grid])}


def _with_slopes(rows: RealArray, columns: RealArray, values: RealArray) -> RealArray:
    """Return values and slopes, times the steps, of a spline through the values on a grid."""
    row_step, column_step = rows[1] - rows[0], columns[1] - columns[0]
    along = CubicSpline(columns, values, axis=1)(columns, 1) * column_step
    across = CubicSpline(rows, values, axis=0)(rows, 1) * row_step
    mixed = CubicSpline(rows, along, axis=0)(rows, 1) * row_step
    return np.stack([values, along, across, mixed], axis=-1)


def aluminium_heat_capacity(T: float) -> float:
    """Return the specific heat of aluminium 6061-T6 in J/(kg K), T from 4 to 300 K (NIST, within 5 %)."""
    decades = np.log10(T)
    return float(10.0 ** sum(a * decades**k for k, a in enumerate(ALUMINIUM)))


def aluminium_enthalpy(T: float) -> float:
    """Return the enthalpy of aluminium 6061-T6 above that at 4 K, in J/kg, `T` to 300 K."""
    return float(quad(lambda t: aluminium_heat_capacity(float(np.exp(t))) * np.exp(t), np.log(4.0), np.log(T))[0])


def _isobar(log_temperature: float) -> list[float]:
    T = float(np.exp(log_temperature))
    h, rho, cp = (_property(name, "P", P_HP, "T", T) for name in ("H", "D", "C"))
    return [h, rho, rho * cp, aluminium_heat_capacity(T), aluminium_enthalpy(T)]


def _departure(log_temperature: float) -> list[float]:
    """Return the cubics through 16 bar, in bar from there, that fit h, rho and rho cp best over 5 to 19 bar."""
    T = float(np.exp(log_temperature))
    angles = (np.arange(DEPARTURE_NODES) + 0.5) * np.pi / DEPARTURE_NODES
    pressures = 12e5 + 7e5 * np.cos(angles)
    bars = (pressures - P_HP) / 1e5
    powers = np.stack([bars, bars**2, bars**3], axis=1)
    h, rho, rho_cp = _isobar(log_temperature)[:3]
    rows = [[_property(name, "P", float(P), "T", T) for name in ("H", "D", "C")] for P in pressures]
    departures = np.array([[row[0] - h, row[1] - rho, row[1] * row[2] - rho_cp] for row in rows])
    cubics: RealArray = np.linalg.lstsq(powers, departures, rcond=None)[0]
    return [float(coefficient) for coefficient in cubics.T.ravel()]


SATURATION = (("T", 0.0), ("D", 0.0), ("D", 1.0), ("H", 0.0), ("H", 1.0), ("S", 1.0))


def _superheat(P: float, log_excess: float) -> float:
    T = _at_log("T", P, "H", log_excess, EXCESS_OFFSET)
    return float(np.log(T - _property("T", "P", P, "Q", 1.0) + SUPERHEAT_OFFSET))


def _excess(P: float, entropy_rise: float) -> float:
    h = _near_saturation("H", P, "S", entropy_rise)
    return float(np.log(h - _property("H", "P", P, "Q", 1.0) + EXCESS_OFFSET))


def _turbine_entropy(log_pressure: float, log_enthalpy: float) -> float:
    P, h = float(np.exp(log_pressure)), float(np.exp(log_enthalpy))
    return _property("S", "P", P, "H", h) + GAS_CONSTANT * log_pressure


def _at_log(name: str, P: float, axis: str, log: float, offset: float) -> float:
    return _near_saturation(name, P, axis, float(np.exp(log)) - offset)


def _near_saturation(name: str, P: float, axis: str, distance: float) -> float:
    """Return a property at `distance` along `axis` from the saturated vapour, which itself needs the quality."""
    if distance < 1e-9:
        return _property(name, "P", P, "Q", 1.0)
    return _property(name, "P", P, axis, _property(axis, "P", P, "Q", 1.0) + distance)


def _property(name: str, first: str, x: float, second: str, y: float) -> float:
    return float(PropsSI(name, first, x, second, y, FLUID))


def keep_bits(tables: dict[str, RealArray], shipped: Any) -> None:  # noqa: ANN401 - an archive
    """Put the nodes that are shipped already into new tables in their place: on another machine last digits differ.

    Raises:
        ValueError: The new ones are not those, but for rounding.
    """
    for name in (name for name in shipped.files if not name.endswith("_grid")):
        old, new = shipped[name], tables[name]
        befores = tables[f"{name}_grid"][2::3].astype(int) - shipped[f"{name}_grid"][2::3].astype(int)
        block = tuple(slice(before, before + count) for before, count in zip(befores, old.shape[:-1], strict=False))
        block = (*block, *(slice(count) for count in old.shape[len(block) :]))
        if not np.allclose(new[block], old, rtol=1e-7, atol=1e-5):
            raise ValueError(f"{name}: other nodes than in {TARGET.name}; delete that to begin anew")
        new[block] = old


if __name__ == "__main__":
    made: dict[str, Any] = tabulate()
    if TARGET.exists():
        with np.load(TARGET) as archive:
            keep_bits(made, archive)
    np.savez_compressed(TARGET, **made)
