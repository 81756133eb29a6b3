"""The controller of the compression station and of the nitrogen bath: measurements in, openings out, once a tick.

It holds high and low pressure by three valves. Both designs think in flows: `bypass` from the high to the low pressure
line, and `inventory`, positive from the buffer into the low-pressure line. The buffer is emptied into the low-pressure
line and filled from the high-pressure one; with the bypass smaller by the same flow, filling it does to both lines what
a negative inventory flow into the low-pressure line would do.

The law is kernels; `station_law` makes its constants.
"""

from collections.abc import Sequence
from math import hypot, sqrt
from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop.process.cold_box import TICK_S
from coldloop.registers.plant import StationMode
from coldloop_plant.components.expansion import CHOKED, Valve
from coldloop_plant.helium import GAS_CONSTANT
from coldloop_plant.numeric import PA_PER_BAR, RealArray
from coldloop_plant.settings import StationControlKind, StationSettings
from coldloop_refrigerator.warm import CompressionStation

DESIGN_TEMPERATURE: Final = 300.0  # K, at which the controller takes the valves' flows to be
ROUNDING: Final = 1e-9  # kg/s, by which flows that are the same may differ
STOPPED_RISE: Final = 0.25
"""bar above its set point, at which the low pressure shuts the bypass when no compressor is loaded."""
STOPPED_HIGHEST: Final = 1.3
"""bar, to which that is limited: the relief valve of the low-pressure line opens at 1.5 bar."""
STOPPED_SPAN: Final = 0.25  # bar below that, at which the bypass is fully open
STARTING_SPAN: Final = 0.1
"""bar below its set point, at which the low pressure has the charge valve open while the first compressor starts."""
DECISION_S: Final = 5.0
"""s, over which the inventory flow is smoothed that decides which of the buffer's valves may open."""
SHUT: Final = 0.5  # %, to which a valve of the buffer has to shut before the other one opens
HP_INTEGRAL, LP_INTEGRAL, NITROGEN_INTEGRAL, SMOOTHED, DIRECTION = range(5)
"""Indices of the controller's memory: integrals of the errors of HP and LP (bar s) and of the nitrogen's level (% s);
with a dead band the smoothed inventory flow (kg/s), and 1 while the charge valve may be open, -1 for the discharge
valve."""
MEMORY_SIZE: Final = 5
COMPRESSORS: Final = 2
LEAST_PRESSURE: Final = 0.5  # bar, taken for the valves' flows when a line is emptier
AUTOMATIC, LIMITED, CHARGE_STOPPED, ONE_COMPRESSOR, STOPPED, STARTING, OVERRIDE = map(int, StationMode)


class StationMeasurement(NamedTuple):
    """Readings of the station's sensors at a tick."""

    hp: float
    lp: float
    buffer: float  # Pressures, bar
    bypass: float
    discharge: float
    charge: float  # Openings of CV956, CV952 and CV953, %
    nitrogen: float  # Level, %
    lost: float  # Helium that has left the circuit, kg
    bath: float  # Pressure of the bath, bar
    nc1: bool  # Whether the compressor is switched on, and not tripped by the low pressure
    nc2: bool
    loaded: int  # Compressors that are switched on and loaded
    turbine: bool  # Whether the turbine may run
    overspeed: bool  # Whether its protection has tripped it
    deviating: bool  # Whether a valve or the heater of the cold box is not as it is asked
    suction: bool  # Whether the low pressure has tripped a compressor


class Commands(NamedTuple):
    """Openings asked of the warm valves, %; in the order of `COMMAND_NAMES`."""

    cv956: float
    cv952: float
    cv953: float
    cv167: float


class Loop(NamedTuple):
    """A PI loop."""

    gain: float
    integral_s: float


class EquipmentLaw(NamedTuple):
    """Constants of the starts and of the turbine's protection: keys of `plant.station`.

    The fields of `CompressorStart`, `StationAlarmSettings.lp_low_bar` below which no compressor is started, the fields
    of `TurbineProtection`, `PressureProtection.trip_lp_bar`.
    """

    idle: float
    idle_s: float
    load_s: float
    second: float
    least_lp: float
    run_up_s: float
    governed_hz: float
    overspeed_hz: float
    trip_lp: tuple[float, float]


class StationLaw(NamedTuple):
    """Constants of the law."""

    is_lq: bool
    hp: float
    """Set point of the high pressure, bar."""
    lp: float
    """Set point of the low pressure, bar."""
    charge_ends: float
    """So far above its set point (bar) does the low pressure close the charge valve."""
    share: float
    """Anti-windup: share of the valves' saturation that the integrals follow in a tick."""
    gains: RealArray
    """K of the LQ controller, shape (2, 6)."""
    nominal: float
    """Bypass flow at the operating point, kg/s."""
    dead_band: float
    """Inventory flow (kg/s) up to which the buffer's valves stay shut; 0: they follow every sign of it."""
    bypass: Valve
    discharge: Valve
    charge: Valve
    over_hp: Loop
    """Loop from the high pressure to the inventory flow, kg/s per bar."""
    over_lp: Loop
    """Loop from the low pressure to the bypass flow, kg/s per bar."""
    over_nitrogen: Loop
    """Loop from the level to the feed valve, % per %."""
    nitrogen: float
    """Set point of the level, %."""
    feed: float
    """Opening of CV167 at the operating point, %."""
    alarms: tuple[float, float, float, float, float, float, float]
    """Limits at which alarms begin, as in `StationAlarmSettings`: bar, % and kg."""
    equipment: EquipmentLaw
    hp_override: tuple[float, float]
    """High pressures (bar) at which it begins to move the buffer's valves, and at which it has them to itself."""
    lp_override: tuple[float, float]


class Flows(NamedTuple):
    """Virtual flows, kg/s."""

    bypass: float
    inventory: float


@kernel
def control_station(c: StationLaw, integrals: RealArray, m: StationMeasurement) -> tuple[Commands, int]:
    """Return the openings for the tick that begins, and the mode (`StationMode`).

    `integrals` (5), from `HP_INTEGRAL` on, are what it remembers, and are overwritten.
    """
    feed = nitrogen_feed(c, integrals, m.nitrogen)
    if not (m.nc1 or m.nc2):
        integrals[HP_INTEGRAL] = integrals[LP_INTEGRAL] = integrals[SMOOTHED] = integrals[DIRECTION] = 0.0
        return Commands(bypass_at_rest(c, m.lp), 100.0 if m.hp > m.buffer else 0.0, 0.0, feed), STOPPED
    if m.loaded == 0:
        discharge = 100.0 if m.hp > m.buffer and m.lp > c.lp else 0.0
        charge = 100.0 * min(max((c.lp - m.lp) / STARTING_SPAN, 0.0), 1.0)
        return Commands(bypass_at_rest(c, m.lp), discharge, charge, feed), STARTING
    wanted = wanted_flows(c, integrals, m)
    allowed = outside_dead_band(c, integrals, wanted, m) if c.dead_band > 0.0 else wanted
    given, openings = split(c, allowed, m)
    mode = mode_of(c, allowed, given, m)
    limited, moved = overridden(openings, beyond(m.hp, c.hp_override), beyond(m.lp, c.lp_override))
    if moved != openings:
        given, mode = flows_through(c, limited, m), OVERRIDE
    follow(c, integrals, wanted, given, m)
    return Commands(moved[0], moved[1], moved[2], feed), mode


@kernel
def beyond(pressure: float, limits: tuple[float, float]) -> float:
    """Return how far a pressure is beyond a limit, as a share of the way to where that acts fully, 0 to 1."""
    limit, full = limits
    return min(max((pressure - limit) / (full - limit), 0.0), 1.0)


@kernel
def overridden(
    openings: tuple[float, float, float], high: float, low: float
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return what a high and a low pressure leave of the openings (%) of bypass, discharge and charge valve, and make.

    In the first half of its way beyond its limit a pressure opens the valve that relieves it, in the second half it
    shuts the one that makes it worse: the integrals know of that alone. With both beyond their limits, as when the
    turbine trips, the buffer is a second bypass.
    """
    bypass, discharge, charge = openings
    left = bypass, min(discharge, 200.0 * (1.0 - low)), min(charge, 200.0 * (1.0 - high))
    return left, (bypass, max(left[1], min(200.0 * high, 100.0)), max(left[2], min(200.0 * low, 100.0)))


@kernel
def flows_through(c: StationLaw, openings: tuple[float, float, float], m: StationMeasurement) -> Flows:
    """Return what the valves pass at openings (%) of bypass, discharge and charge valve, as virtual flows."""
    discharge = openings[1] * per_percent(c.discharge, m.hp)
    bypass = openings[0] * per_percent(c.bypass, m.hp) + (discharge if c.is_lq else 0.0)
    return Flows(bypass, openings[2] * per_percent(c.charge, m.buffer) - discharge)


@kernel
def bypass_at_rest(c: StationLaw, lp: float) -> float:
    """Return the opening of the bypass (%) while no compressor is loaded: so far as the low-pressure line has room."""
    room = (min(c.lp + STOPPED_RISE, STOPPED_HIGHEST) - lp) / STOPPED_SPAN
    return 100.0 * min(max(room, 0.0), 1.0)


@kernel
def outside_dead_band(c: StationLaw, integrals: RealArray, wanted: Flows, m: StationMeasurement) -> Flows:
    """Return the flows with the inventory flow that a dead band leaves of them.

    A valve of the buffer passes the smoothed flow from when that leaves the band until it is back in half of it, not
    before the other valve is shut. What is not given leads the integrals, see `follow`.
    """
    integrals[SMOOTHED] += TICK_S / DECISION_S * (wanted.inventory - integrals[SMOOTHED])
    smoothed = integrals[SMOOTHED]
    if integrals[DIRECTION] * smoothed < 0.5 * c.dead_band:
        integrals[DIRECTION] = 0.0
    if abs(smoothed) > c.dead_band:
        integrals[DIRECTION] = 1.0 if smoothed > 0.0 else -1.0
    direction = integrals[DIRECTION]
    other = m.discharge if direction > 0.0 else m.charge
    inventory = direction * max(direction * smoothed, 0.0) if other <= SHUT else 0.0
    return Flows(wanted.bypass, inventory)


@kernel
def wanted_flows(c: StationLaw, integrals: RealArray, m: StationMeasurement) -> Flows:
    """Return the flows that state feedback asks for, or two single loops."""
    if not c.is_lq:
        return Flows(
            c.nominal - c.over_lp.gain * (m.lp - c.lp + integrals[LP_INTEGRAL] / c.over_lp.integral_s),
            -c.over_hp.gain * (m.hp - c.hp + integrals[HP_INTEGRAL] / c.over_hp.integral_s),
        )
    opened = flows_through(c, (m.bypass, m.discharge, m.charge), m)
    state = (
        m.hp - c.hp, m.lp - c.lp, opened.bypass - c.nominal, opened.inventory,
        integrals[HP_INTEGRAL], integrals[LP_INTEGRAL],
    )  # fmt: skip
    bypass = inventory = 0.0
    for i in range(len(state)):
        bypass += c.gains[0, i] * state[i]
        inventory += c.gains[1, i] * state[i]
    return Flows(c.nominal - bypass, -inventory)


@kernel
def split(c: StationLaw, wanted: Flows, m: StationMeasurement) -> tuple[Flows, tuple[float, float, float]]:
    """Return the flows that the valves can give, and their openings (%): bypass, discharge, charge."""
    per_bypass, per_discharge = per_percent(c.bypass, m.hp), per_percent(c.discharge, m.hp)
    per_charge = per_percent(c.charge, m.buffer)
    inventory = min(max(wanted.inventory, -100.0 * per_discharge), 100.0 * per_charge * charge_room(c, m.lp))
    discharge, charge = max(-inventory, 0.0), max(inventory, 0.0)
    less = discharge if c.is_lq else 0.0
    bypass = min(max(wanted.bypass - less, 0.0), 100.0 * per_bypass)
    return Flows(bypass + less, inventory), (bypass / per_bypass, discharge / per_discharge, charge / per_charge)


@kernel
def charge_room(c: StationLaw, lp: float) -> float:
    """Return the share of the charge valve that the low pressure allows, 0 to 1."""
    above = (lp - c.lp) / c.charge_ends
    return min(max(2.0 - 2.0 * above, 0.0), 1.0)


@kernel
def follow(c: StationLaw, integrals: RealArray, wanted: Flows, given: Flows, m: StationMeasurement) -> None:
    """Integrate the errors, and lead the integrals to where they would have asked for what was given."""
    bypass, inventory = given.bypass - wanted.bypass, given.inventory - wanted.inventory
    if c.is_lq:
        K = c.gains
        determinant = K[0, 4] * K[1, 5] - K[0, 5] * K[1, 4]
        back_hp = (K[1, 5] * bypass - K[0, 5] * inventory) / determinant
        back_lp = (K[0, 4] * inventory - K[1, 4] * bypass) / determinant
    else:
        back_hp = inventory * c.over_hp.integral_s / c.over_hp.gain
        back_lp = bypass * c.over_lp.integral_s / c.over_lp.gain
    integrals[HP_INTEGRAL] = integrals[HP_INTEGRAL] + TICK_S * (m.hp - c.hp) - c.share * back_hp
    integrals[LP_INTEGRAL] = integrals[LP_INTEGRAL] + TICK_S * (m.lp - c.lp) - c.share * back_lp


@kernel
def nitrogen_feed(c: StationLaw, integrals: RealArray, level: float) -> float:
    """Return the opening of the nitrogen feed (%); its integral stops at the ends of the valve's range."""
    error = c.nitrogen - level
    wanted = c.feed + c.over_nitrogen.gain * (error + integrals[NITROGEN_INTEGRAL] / c.over_nitrogen.integral_s)
    given: float = min(max(wanted, 0.0), 100.0)
    if given == wanted or (wanted > given) != (error > 0.0):
        integrals[NITROGEN_INTEGRAL] += TICK_S * error
    return given


@kernel
def mode_of(c: StationLaw, wanted: Flows, given: Flows, m: StationMeasurement) -> int:
    """Return what the law can do about the pressures, with a compressor running."""
    if m.loaded < COMPRESSORS:
        return ONE_COMPRESSOR
    if wanted.inventory > given.inventory and charge_room(c, m.lp) < 1.0:
        return CHARGE_STOPPED
    missing = max(abs(wanted.bypass - given.bypass), abs(wanted.inventory - given.inventory))
    return LIMITED if missing > ROUNDING else AUTOMATIC


@kernel
def raised_alarms(c: StationLaw, m: StationMeasurement) -> int:
    """Return the alarms at this tick, the bits of `StationAlarm` in their order."""
    hp_high, hp_low, lp_high, lp_low, nitrogen_low, helium_lost, bath_relief = c.alarms
    conditions = (
        m.hp > hp_high, m.hp < hp_low, m.lp > lp_high, m.lp < lp_low, not m.nc1, not m.nc2, m.nitrogen < nitrogen_low,
        m.lost > helium_lost, not (m.nc1 or m.nc2), m.bath > bath_relief, not m.turbine, m.overspeed, m.deviating,
        m.suction,
    )  # fmt: skip
    raised = 0
    for bit in range(len(conditions)):
        if conditions[bit]:
            raised += 1 << bit
    return raised


@kernel
def per_percent(valve: Valve, pressure: float) -> float:
    """Return the choked flow (kg/s) of a valve per % of opening at a pressure (bar) before it."""
    P = PA_PER_BAR * max(pressure, LEAST_PRESSURE)
    flow: float = valve.flow_area / 100.0 * P * CHOKED / sqrt(GAS_CONSTANT * DESIGN_TEMPERATURE)
    return flow


def station_law(
    settings: StationSettings, gains: Sequence[Sequence[float]], openings: Sequence[float], station: CompressionStation
) -> StationLaw:
    """Return the constants of the law.

    `gains` are K of the LQ controller, (2, 6), `openings` (%) those at the operating point, in the order of `Commands`.
    """
    is_lq, trips = settings.control is StationControlKind.LQ, settings.protection
    per_bar = hypot(*gains[1][:2]) if is_lq else settings.pi_hp.gain
    return StationLaw(
        is_lq=is_lq,
        hp=settings.hp_bar, lp=settings.lp_bar, charge_ends=settings.charge_ends_bar,
        share=min(TICK_S / settings.anti_windup_s, 1.0),
        gains=np.array(gains),
        nominal=openings[0] * per_percent(station.bypass, settings.hp_bar),
        dead_band=settings.dead_band * settings.noise_bar * per_bar,
        bypass=station.bypass, discharge=station.discharge, charge=station.charge,
        over_hp=Loop(**settings.pi_hp.model_dump()), over_lp=Loop(**settings.pi_lp.model_dump()),
        over_nitrogen=Loop(**settings.pi_nitrogen.model_dump()),
        nitrogen=settings.nitrogen_level, feed=openings[3],
        alarms=tuple(settings.alarms.model_dump().values()),
        equipment=EquipmentLaw(*[
            *settings.start.model_dump().values(), settings.alarms.lp_low_bar, *settings.turbine.model_dump().values(),
            trips.trip_lp_bar,
        ]),
        hp_override=trips.hp_bar, lp_override=trips.lp_bar,
    )  # fmt: skip
