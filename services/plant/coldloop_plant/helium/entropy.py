"""Entropy of helium wherever the refrigerator has it: wet, as vapour, at high pressure. For use off line."""

import numpy as np

from coldloop_plant.helium.properties import (
    HIGHEST_SATURATION,
    WARM_CP,
    Helium,
    entropy_before_expansion,
    saturation,
    supply_enthalpy_and_density,
)

LOWEST_ENTHALPY, HIGHEST_ENTHALPY = 7e3, 1580e3  # J/kg, within the table of `entropy_before_expansion`
WARM_EXCESS, WARM_EXCESS_BY_P = 5.03e3, 3.27e-3  # J/kg, and per Pa: of the enthalpy of warm helium above cp T
STEPS = 200


def entropy(P: float, h: float, helium: Helium) -> float:
    """Return s (J/(kg K)) at `P` (Pa) and `h` (J/kg), with CoolProp's reference.

    Up to 2.25 bar for all h from that of the saturated liquid on, within 0.2 J/(kg K) (wet or 0.3 K above saturation:
    0.02); from there to 19 bar for h of 7e3 or more, within 0.1 J/(kg K). Up to 350 K.
    """
    if P <= HIGHEST_SATURATION:
        sat = saturation(P, helium)
        if h <= sat.h_v:
            return sat.s_v + (h - sat.h_v) / sat.T
    if h > HIGHEST_ENTHALPY:
        excess = WARM_EXCESS + WARM_EXCESS_BY_P * P
        warmer = (h - excess) / (HIGHEST_ENTHALPY - excess)
        return entropy_before_expansion(P, HIGHEST_ENTHALPY, helium) + WARM_CP * float(np.log(warmer))
    return entropy_before_expansion(P, h, helium)


def supply_entropy(P: float, T: float, helium: Helium) -> float:
    """Return s (J/(kg K)) of the high-pressure gas at `P` (Pa, 5e5 to 19e5) and `T` (K, 4 to 350).

    Where it is colder than the table of entropies goes, ds = dh/T along the isobar. At 16 bar within 0.01 J/(kg K), up
    to 300 K; elsewhere as close as the enthalpy is, over T.
    """
    h, _ = supply_enthalpy_and_density(P, T, helium)
    if h >= LOWEST_ENTHALPY:
        return entropy(P, h, helium)
    temperatures = T + np.arange(STEPS + 1) * (10.0 - T) / STEPS
    enthalpies = np.array([supply_enthalpy_and_density(P, each, helium)[0] for each in temperatures])
    edge = int(np.argmax(enthalpies >= LOWEST_ENTHALPY))
    between = 0.5 * (temperatures[:edge] + temperatures[1 : edge + 1])
    return entropy(P, enthalpies[edge], helium) - float(np.sum(np.diff(enthalpies[: edge + 1]) / between))
