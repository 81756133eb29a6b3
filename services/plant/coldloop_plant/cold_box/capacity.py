"""Which heat loads a cold box can hold at rest: its steady states over a grid of the valves."""

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np

from coldloop.process.cold_box import T5
from coldloop_plant.cold_box.equilibrium import Equilibrium, NoEquilibriumError, find_equilibrium, rest_near
from coldloop_plant.cold_box.physics import ColdBox
from coldloop_plant.helium.properties import Helium

Range = tuple[float, float]

LOOP_MARGIN: Final = 39.0
"""What the optimiser leaves of the largest load, W: its rows are soft, and let L1 rest beyond its band before CV156 is
open. The reference plant rests at 554 W; it stays in its bands, with their dead bands, up to 515 W."""


class HeldLoads(NamedTuple):
    """The least and the largest load that some inputs hold at rest, and what holds them."""

    least: Equilibrium
    largest: Equilibrium


def held_loads(
    box: ColdBox, helium: Helium, level: float, cv155: Iterable[float], heater: Range, cv156: Iterable[float],
    warmth: Range,
) -> HeldLoads:  # fmt: skip
    """Return the extreme loads at rest with the bath at `level` (%) and T5 within `warmth` (K).

    Heater and load heat the same bath, so that each steady state is sought once, and the heater's ends say which loads
    go with it. The grid is of openings in %, rising; between its points loads may be some watts more.

    Raises:
        ValueError: There is no such state.
    """
    rests = [
        rest
        for rest in steady_states(box, helium, level, cv155, heater[0], cv156)
        if warmth[0] <= rest.y[T5] <= warmth[1]
    ]
    least, largest = min(rests, key=lambda rest: rest.w), max(rests, key=lambda rest: rest.w)
    by = heater[1] - heater[0]
    return HeldLoads(least._replace(u=least.u + np.array([0.0, by, 0.0]), w=least.w - by), largest)


def steady_states(
    box: ColdBox, helium: Helium, level: float, cv155: Iterable[float], heater: float, cv156: Iterable[float]
) -> Iterator[Equilibrium]:
    """Yield the steady states of a grid as far as they exist; each is sought from its neighbour's."""
    openings = list(cv155)
    for turbine in cv156:
        rest: Equilibrium | None = None
        for opening in openings:
            u = np.array([opening, heater, turbine])
            try:
                rest = rest_near(rest.x, rest.w, u, box, helium) if rest else find_equilibrium(u, level, box, helium)
            except NoEquilibriumError:
                rest = None
                continue
            yield rest
