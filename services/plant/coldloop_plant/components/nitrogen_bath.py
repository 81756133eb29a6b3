"""Nitrogen bath: helium flows through a coil in boiling nitrogen at about atmospheric pressure.

Saturated nitrogen at 1.05 bar boils at 77.66 K with 198.8 kJ/kg and weighs 804.7 kg/m3; delivered at 2.5 bar and 80 K
it brings 4.9 kJ/kg above the saturated liquid, which flash off (CoolProp 8.0). The cold vapour leaves unused.
"""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.heat_exchanger import STILL
from coldloop_plant.components.parameters import require
from coldloop_plant.components.valve import Valve, effective_area
from coldloop_plant.numeric import at_least, at_most

BOILING_POINT = 77.66  # K
LATENT_HEAT = 198.8e3  # J/kg
LIQUID_DENSITY = 804.7  # kg/m3
FEED_EXCESS = 4.9e3  # J/kg
FEED_PRESSURE = 1.45e5  # Pa, from the tank to the bath
TRICKLE = 1e-6  # kg/s
ROOM = 0.02  # share of the vessel that vapour needs to condense freely


class NitrogenBath(NamedTuple):
    """NEF5, its vessel and its feed valve."""

    UA: float
    """Of the wetted coil, W/K."""
    volume: float
    """Of the vessel, m3."""
    wet_level: float
    """Level (%) above which the whole coil is wet."""
    capacity: float
    """Heat capacity of the coil and the helium in it at 80 K, J/K."""
    feed: Valve
    """CV167, for liquid nitrogen."""


class Boiling(NamedTuple):
    """What the bath does."""

    heat: float
    """Taken from the helium, W."""
    boil_off: float
    """Vapour, kg/s."""
    feed: float
    """Liquid delivered, kg/s."""


@kernel
def nitrogen_level(bath: NitrogenBath, mass: float) -> float:
    """Return the level (%, 0 to 100) of `mass` (kg) of nitrogen."""
    return at_most(at_least(100.0 * mass / (LIQUID_DENSITY * bath.volume), 0.0), 100.0)


@kernel
def boil(
    bath: NitrogenBath,
    mass: float,
    helium_flow: float,
    cp: float,
    T_in: float,
    T_coil: float,
    opening: float,
    supply: float,
) -> Boiling:
    """Return heat, boil-off and feed with `mass` (kg) of nitrogen in the bath and helium entering at `T_in` (K).

    Q = m cp (T_in - T_N) (1 - exp(-UA wet/(m cp))), `cp` in J/(kg K); as the helium comes to rest it is the heat of the
    coil itself, at `T_coil` (K). Heat to colder helium condenses vapour that the vent line gives back, where the vessel
    has room for it: less and less in the last of it (`ROOM`). The wet share of
    the coil grows smoothly with the level. `opening` (%) is that of the feed valve, `supply` 1 with nitrogen
    in the tank and 0 without. A full vessel takes no more than what boils off.
    """
    share = at_most(nitrogen_level(bath, mass) / bath.wet_level, 1.0)
    wet = share * share * (3.0 - 2.0 * share)
    capacity_flow = at_least(helium_flow, TRICKLE) * cp
    heat = capacity_flow * (T_in - BOILING_POINT) * (1.0 - np.exp(-bath.UA * wet / capacity_flow))
    moving = at_least(at_most(helium_flow / STILL, 1.0), 0.0)
    if moving.real < 1.0:
        heat = moving * heat + (1.0 - moving) * bath.UA * wet * (T_coil - BOILING_POINT)
    if heat.real < 0.0:
        room = 1.0 - mass / (LIQUID_DENSITY * bath.volume)
        heat = heat * at_most(at_least(room / ROOM, 0.0), 1.0)
    feed = supply * effective_area(bath.feed, opening) * np.sqrt(2.0 * LIQUID_DENSITY * FEED_PRESSURE)
    if mass.real >= LIQUID_DENSITY * bath.volume:
        feed = at_most(feed, at_least(heat, 0.0) / (LATENT_HEAT - FEED_EXCESS))
    return Boiling(heat, (heat + feed * FEED_EXCESS) / LATENT_HEAT, feed)


def check_nitrogen_bath(name: str, bath: NitrogenBath) -> None:
    """Refuse parameters that no bath has (`ParameterError`)."""
    require(name, "UA", bath.UA, 0.0, 1e6)
    require(name, "volume", bath.volume, 0.0, 100.0)
    require(name, "wet_level", bath.wet_level, 0.0, 100.0)
    require(name, "capacity", bath.capacity, 0.0, 1e9)
    require(name + ".feed", "flow_area", bath.feed.flow_area, 0.0, 1.0)
