"""The nitrogen pre-cooler, S3: the warm counter-flow exchanger NEF6 and the nitrogen bath NEF5.

States, `PRECOOLER_STATES`: the cells of NEF6 from the hot end on and the coil of NEF5 (K), the nitrogen in the bath
(kg), the opening of its feed valve CV167 (%).
"""

from typing import Final, NamedTuple

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.actuator import Actuator, check_actuator
from coldloop_plant.components.heat_exchanger import HeatExchanger, LowPressureFlow
from coldloop_plant.components.nitrogen_bath import Boiling, NitrogenBath, boil, check_nitrogen_bath
from coldloop_plant.components.warm_exchanger import check_warm_exchanger, transfer_warm
from coldloop_plant.helium.properties import WARM_CP
from coldloop_plant.numeric import Array

NEF6_CELLS: Final = 8
PRECOOLER_STATES: Final = (*(f"T_nef6_{i}" for i in range(1, NEF6_CELLS + 1)), "T_nef5", "M_N2", "CV167")
PRECOOLER_STATE_UNITS: Final = (*["K"] * (NEF6_CELLS + 1), "kg", "%")


class Precooler(NamedTuple):
    """Components of S3, in SI units."""

    nef6: HeatExchanger
    """From ambient temperature to the nitrogen bath."""
    nef5: NitrogenBath
    """The bath."""
    actuator: Actuator
    """Of CV167."""


class Precooling(NamedTuple):
    """What the pre-cooler does."""

    warm_end: LowPressureFlow
    """The low-pressure flow as it leaves for the compressors."""
    boiling: Boiling


@kernel
def precooler_flows(
    x: Array,
    T_hot: float,
    flows: Array,
    low: LowPressureFlow,
    supply: float,
    precooler: Precooler,
    dx: Array,
) -> Precooling:
    """Write the rate of the nitrogen into `dx` (11, per second); return what the pre-cooler does.

    In the place of the rates of the exchangers' temperatures is the heat that they give (W).

    Args:
        x: States, `PRECOOLER_STATES`.
        T_hot: Of the helium from the compressors, K.
        flows: Of high-pressure helium into each cell of NEF6 and through the coil, kg/s, shape (9,).
        low: From the cold box.
        supply: 1 with nitrogen in the tank, 0 without.
        precooler: Parameters.
        dx: Heats and rates.
    """
    cells = precooler.nef6.cells
    warm_end = transfer_warm(precooler.nef6, x[:cells], T_hot, flows[:cells], low, dx[:cells])
    boiling = boil(precooler.nef5, x[cells + 1], flows[cells], WARM_CP, x[cells - 1], x[cells], x[cells + 2], supply)
    dx[cells] = boiling.heat
    dx[cells + 1] = boiling.feed - boiling.boil_off
    return Precooling(warm_end, boiling)


def check_precooler(precooler: Precooler) -> None:
    """Refuse parameters that no pre-cooler has (`ParameterError`)."""
    check_warm_exchanger("nef6", precooler.nef6, NEF6_CELLS)
    check_nitrogen_bath("nef5", precooler.nef5)
    check_actuator("cv167", precooler.actuator)
