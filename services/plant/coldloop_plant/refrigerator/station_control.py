"""The controller of the compression station and of the nitrogen bath: measurements in, openings out, once a tick.

A program like the others: no sockets, no clock. What it computes is `coldloop_plant.refrigerator.station_law`.
"""

from math import hypot
from typing import NamedTuple

import numpy as np

from coldloop.process.cold_box import TICK_S
from coldloop.registers.plant import StationAlarm, StationMode
from coldloop_plant.refrigerator.compression_station import CompressionStation
from coldloop_plant.refrigerator.equipment import EquipmentLaw
from coldloop_plant.refrigerator.station_law import (
    MEMORY_SIZE,
    AlarmLimits,
    Commands,
    Loop,
    Overrides,
    StationLaw,
    StationMeasurement,
    control_station,
    per_percent,
    raised_alarms,
)
from coldloop_plant.refrigerator.station_settings import PiTuning, StationControlKind, StationSettings


class StationReference(NamedTuple):
    """Gains from the refrigerator's file."""

    gains: tuple[tuple[float, ...], tuple[float, ...]]
    """K of the LQ controller, (2, 6)."""
    bypass: float
    """Opening of CV956 at the operating point, %."""
    feed: float
    """Opening of CV167 there, %."""


class StationControl:
    """Both pressure loops and the nitrogen loop.

    Args:
        settings: Configuration.
        reference: Gains, and openings at the operating point.
        station: Sizes of the valves.
    """

    def __init__(self, settings: StationSettings, reference: StationReference, station: CompressionStation) -> None:
        self.law = station_law(settings, reference, station)
        self.integrals = np.zeros(MEMORY_SIZE)
        """What the law remembers, from `station_law.HP_INTEGRAL` on."""
        self.mode = StationMode.AUTOMATIC
        self.alarms = StationAlarm(0)

    def step(self, measured: StationMeasurement) -> Commands:
        """Return the openings for the tick that begins."""
        self.alarms = StationAlarm(raised_alarms(self.law.alarms, measured))
        commands, mode = control_station(self.law, self.integrals, measured)
        self.mode = StationMode(mode)
        return commands


def station_law(settings: StationSettings, reference: StationReference, station: CompressionStation) -> StationLaw:
    """Return the constants of the law for a configuration, an operating point and the sizes of valves."""
    limits, is_lq = settings.alarms, settings.control is StationControlKind.LQ
    per_bar = hypot(*reference.gains[1][:2]) if is_lq else settings.pi_hp.gain
    return StationLaw(
        is_lq=is_lq,
        hp=settings.hp_bar, lp=settings.lp_bar, charge_ends=settings.charge_ends_bar,
        share=min(TICK_S / settings.anti_windup_s, 1.0),
        gains=np.array(reference.gains),
        nominal=reference.bypass * per_percent(station.bypass, settings.hp_bar),
        dead_band=settings.dead_band * settings.noise_bar * per_bar,
        bypass=station.bypass, discharge=station.discharge, charge=station.charge,
        over_hp=_loop(settings.pi_hp), over_lp=_loop(settings.pi_lp), over_nitrogen=_loop(settings.pi_nitrogen),
        nitrogen=settings.nitrogen_level, feed=reference.feed,
        alarms=AlarmLimits(
            limits.hp_high_bar, limits.hp_low_bar, limits.lp_high_bar, limits.lp_low_bar, limits.nitrogen_low,
            limits.helium_lost_kg, limits.bath_relief_bar,
        ),
        equipment=EquipmentLaw(
            settings.start.idle, settings.start.idle_s, settings.start.load_s, settings.start.second, limits.lp_low_bar,
            settings.turbine.run_up_s, settings.turbine.governed_hz, settings.turbine.overspeed_hz,
            settings.protection.trip_lp_bar,
        ),
        overrides=Overrides(*settings.protection.hp_bar, *settings.protection.lp_bar),
    )  # fmt: skip


def _loop(tuning: PiTuning) -> Loop:
    return Loop(tuning.gain, tuning.integral_s)
