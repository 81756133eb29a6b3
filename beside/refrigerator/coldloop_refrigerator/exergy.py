"""Exergy balance of a refrigerator at rest: the exergy destroyed in each component.

Exergies are about the surroundings, at their temperature T0. Helium goes round, so that only differences of h - T0 s
count; nitrogen comes from outside, so that its exergy is about 1 atm, too. Every row is what enters a component less
what leaves it, of the same streams: the rows sum to what is put in less the useful exergy, by construction.
"""

from types import SimpleNamespace
from typing import Final, NamedTuple

import numpy as np

from coldloop.process.cold_box import OUTPUT_NAMES, STATION_SIGNAL_NAMES
from coldloop_plant import helium as properties
from coldloop_plant.cold_box import OUTPUTS
from coldloop_plant.helium import WARM_CP, Helium, saturation, supply_enthalpy_and_density
from coldloop_refrigerator.model import AMBIENT, Rest
from coldloop_refrigerator.physics import SIGNALS, Crossing, Refrigerator, evaluate_refrigerator

LOWEST_ENTHALPY, HIGHEST_ENTHALPY = 7e3, 1580e3  # J/kg, within the table of `entropy_before_expansion`
WARM_EXCESS, WARM_EXCESS_BY_P = 5.03e3, 3.27e-3  # J/kg, and per Pa: of the enthalpy of warm helium above cp T
STEPS = 200


def entropy(P: float, h: float, helium: Helium) -> float:
    """Return s (J/(kg K)) at `P` (Pa) and `h` (J/kg), with CoolProp's reference.

    Up to 2.25 bar for all h from that of the saturated liquid on, within 0.2 J/(kg K) (wet or 0.3 K above saturation:
    0.02); from there to 19 bar for h of 7e3 or more, within 0.1 J/(kg K). Up to 350 K.
    """
    if P <= properties.HIGHEST_SATURATION:
        sat = saturation(P, helium)
        if h <= sat.h_v:
            return sat.s_v + (h - sat.h_v) / sat.T
    if h > HIGHEST_ENTHALPY:
        excess = WARM_EXCESS + WARM_EXCESS_BY_P * P
        warmer = (h - excess) / (HIGHEST_ENTHALPY - excess)
        return properties.entropy_before_expansion(P, HIGHEST_ENTHALPY, helium) + WARM_CP * float(np.log(warmer))
    return properties.entropy_before_expansion(P, h, helium)


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


LIQUID_NITROGEN: Final = 754.2e3  # J/kg at 80 K and 2.5 bar, about 300 K and 1 atm (CoolProp 8.0)
NITROGEN_VAPOUR: Final = 198.2e3  # J/kg, of the saturated vapour at 1.05 bar, which leaves unused
T1, T2, T4, T6, T9 = (OUTPUT_NAMES.index(name) for name in ("T1", "T2", "T4", "T6", "T9"))


class ExergyBalance(NamedTuple):
    """The exergy (W) that a refrigerator at rest is given, what of it is useful, and where the difference is lost."""

    electricity: float  # Exergy of the compressors' electricity, W
    nitrogen: float  # Exergy of the liquid nitrogen that is fed, W
    cold_power: float  # Load and heater, W
    T_bath: float  # K
    destroyed: dict[str, float]  # By component

    @property
    def put_in(self) -> float:
        """Electricity and nitrogen."""
        return self.electricity + self.nitrogen

    @property
    def ideal_power(self) -> float:
        """Power over cold power of Carnot's machine between bath and surroundings."""
        return AMBIENT / self.T_bath - 1.0

    @property
    def useful(self) -> float:
        """Least power with which the cold power could be had."""
        return self.cold_power * self.ideal_power

    @property
    def specific_power(self) -> float:
        """Electricity over cold power."""
        return self.electricity / self.cold_power


def exergy_balance(rest: Rest, plant: Refrigerator, helium: Helium) -> ExergyBalance:
    """Return the balance of a refrigerator at rest; the heater counts as load, its electricity is left out."""
    crossing = evaluate_refrigerator(
        rest.x, rest.u, rest.v, rest.d, plant, helium, np.empty_like(rest.x), np.empty(OUTPUTS), np.empty(SIGNALS)
    )
    signals = dict(zip(STATION_SIGNAL_NAMES, rest.signals.tolist(), strict=True))
    e, s = _exergies(rest, crossing, signals, plant, helium), crossing.cold
    m, bypass, boil_off = s.m_jt + s.m_t, 1e-3 * signals["M_CV956"], crossing.cooling.boiling.boil_off
    power, nitrogen = 1e3 * signals["E_NC"], boil_off * LIQUID_NITROGEN
    h6, _ = supply_enthalpy_and_density(signals["P12"] * 1e5, rest.y[T6], helium)
    shaft = s.m_t * (h6 - s.exhaust.h_out)
    balance = ExergyBalance(power, nitrogen, float(rest.d[0] + rest.u[1]), float(rest.y[T1]), {})
    unused = boil_off * NITROGEN_VAPOUR
    balance.destroyed.update({
        "compressors and coolers": power - (m + bypass) * (e.compressed - e.suction),
        "bypass": bypass * (e.compressed - e.suction),
        "NEF6": m * (e.compressed - e.before_nef5 + e.after_nef34 - e.after_nef6),
        "NEF5": m * (e.before_nef5 - e.before_nef34) + nitrogen - unused,
        "nitrogen vapour unused": unused,
        "NEF34": m * (e.before_nef34 - e.before_nef2 + e.after_nef2 - e.after_nef34),
        "CV156": s.m_t * (e.before_nef2 - e.before_nozzle),
        "turbine": s.m_t * (e.before_nozzle - e.exhaust) - shaft,
        "turbine's brake": shaft,
        "mixing with the exhaust": s.m_v * e.at_mixing + s.m_t * e.exhaust - (s.m_v + s.m_t) * e.mixed,
        "NEF2": s.m_jt * (e.before_nef2 - e.before_nef1) + m * (e.mixed - e.after_nef2),
        "NEF1": s.m_jt * (e.before_nef1 - e.before_cv155) + s.m_v * (e.vapour - e.after_nef1),
        "CV155": s.m_jt * (e.before_cv155 - e.before_bath),
        "bath": s.m_jt * e.before_bath - s.m_v * e.vapour - balance.useful,
        "return line": s.m_v * (e.after_nef1 - e.at_mixing) + m * (e.after_nef6 - e.suction),
    })  # fmt: skip
    return balance


def _exergies(
    rest: Rest, crossing: Crossing, signals: dict[str, float], plant: Refrigerator, helium: Helium
) -> SimpleNamespace:
    """Return h - T0 s of helium (J/kg) at each place, high pressure first, from warm to cold, then low pressure back.

    Enthalpies of the return follow from the balances of the exchangers. `at_mixing` is the vapour as it meets the
    exhaust.
    """
    s, P_HP, P_LP, y = crossing.cold, 1e5 * signals["P12"], 1e5 * signals["P11"], rest.y
    P_bath, T_in = float(rest.x[0]), float(y[T9])

    def supply(T: float) -> tuple[float, float]:
        h, _ = supply_enthalpy_and_density(P_HP, T, helium)
        return h, h - AMBIENT * supply_entropy(P_HP, T, helium)

    def at(P: float, h: float) -> float:
        return h - AMBIENT * entropy(P, h, helium)

    hot = supply(AMBIENT + plant.station.cooler_approach)
    inlet, upper, middle, lower = supply(T_in), supply(y[T6]), supply(y[T4]), supply(y[T2])
    h_top = saturation(P_bath, helium).h_v
    h_1 = h_top + s.m_jt / s.m_v * (middle[0] - lower[0])
    h_mixed = (s.m_v * h_1 + s.m_t * s.exhaust.h_out) / (s.m_v + s.m_t)
    h_2 = h_mixed + s.m_jt / (s.m_v + s.m_t) * (upper[0] - middle[0])
    h_suction, _ = properties.vapour_enthalpy_and_cp(P_LP, AMBIENT, saturation(P_LP, helium).T, helium.vapour)
    h_6 = crossing.cooling.warm_end.h
    return SimpleNamespace(
        compressed=hot[1], before_nef5=supply(signals["T13"])[1], before_nef34=inlet[1], before_nef2=upper[1],
        before_nef1=middle[1], before_cv155=lower[1], before_bath=at(P_bath, s.h_jt),
        before_nozzle=at(s.P_turbine, upper[0]), exhaust=at(s.P_mix, s.exhaust.h_out),
        vapour=at(P_bath, h_top), after_nef1=at(P_bath, h_1), at_mixing=at(s.P_mix, h_1), mixed=at(s.P_mix, h_mixed),
        after_nef2=at(s.P_mix, h_2), after_nef34=at(s.P_mix, crossing.leaving.h), after_nef6=at(s.P_mix, h_6),
        suction=at(P_LP, h_suction),
    )  # fmt: skip
