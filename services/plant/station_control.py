"""The controller of the compression station and of the nitrogen bath: measurements in, openings out, once a tick.

A program like the others: no sockets, no clock. It holds high and low pressure by three valves. Both designs think in
flows: `bypass` from the high to the low pressure line, and `inventory`, positive from the buffer into the low-pressure
line. The buffer is emptied into the low-pressure line and filled from the high-pressure one; with the bypass smaller
by the same flow, filling it does to both lines what a negative inventory flow into the low-pressure line would do.
"""

from math import sqrt
from typing import NamedTuple

from coldloop.process import TICK_S
from coldloop.registers.plant import StationAlarm, StationMode
from plant.components.gas_valve import CHOKED
from plant.components.valve import Valve
from plant.compression_station import CompressionStation
from plant.helium.properties import GAS_CONSTANT
from plant.station_settings import StationControlKind, StationSettings

PA_PER_BAR = 1e5
DESIGN_TEMPERATURE = 300.0
"""K, at which the controller takes the valves' flows to be."""
ROUNDING = 1e-9
"""kg/s, by which flows that are the same may differ."""
LEAST_PRESSURE = 0.5
"""bar, taken for the valves' flows when a line is emptier."""


class StationMeasurement(NamedTuple):
    """What the station's sensors show at a tick."""

    hp: float
    """bar."""
    lp: float
    """bar."""
    buffer: float
    """bar."""
    bypass: float
    """Opening of CV956, %."""
    discharge: float
    """Opening of CV952, %."""
    charge: float
    """Opening of CV953, %."""
    nitrogen: float
    """Level, %."""
    lost: float
    """Helium that has left the circuit, kg."""
    nc1: bool
    """Whether the compressor is switched on."""
    nc2: bool


class Commands(NamedTuple):
    """Openings asked of the warm valves, %; in the order of `plant.refrigerator.COMMAND_NAMES`."""

    cv956: float
    cv952: float
    cv953: float
    cv167: float


class StationReference(NamedTuple):
    """What the refrigerator's file tells the controller."""

    gains: tuple[tuple[float, ...], tuple[float, ...]]
    """K of the LQ controller, (2, 6)."""
    bypass: float
    """Opening of CV956 at the operating point, %."""
    feed: float
    """Opening of CV167 there, %."""


class _Flows(NamedTuple):
    bypass: float
    inventory: float


class StationControl:
    """Both pressure loops and the nitrogen loop.

    Args:
        settings: Configuration.
        reference: Gains, and openings at the operating point.
        station: Sizes of the valves.
    """

    def __init__(self, settings: StationSettings, reference: StationReference, station: CompressionStation) -> None:
        self._settings = settings
        self._reference = reference
        self._station = station
        self._nominal = reference.bypass * _per_percent(station.bypass, settings.hp_bar)
        self._integrals = (0.0, 0.0)
        """Of the errors of HP and LP, bar s."""
        self._nitrogen_integral = 0.0
        """% s."""
        self.mode = StationMode.AUTOMATIC
        self.alarms = StationAlarm(0)

    def retained(self) -> list[float]:
        """Return what `resume` needs."""
        return [*self._integrals, self._nitrogen_integral]

    def resume(self, retained: list[float]) -> None:
        """Go on from what `retained` returned (ValueError if it is of something else)."""
        hp, lp, self._nitrogen_integral = retained
        self._integrals = (hp, lp)

    def step(self, measured: StationMeasurement) -> Commands:
        """Return the openings for the tick that begins."""
        self.alarms = self._judged(measured)
        feed = self._feed(measured.nitrogen)
        if not (measured.nc1 or measured.nc2):
            self.mode = StationMode.STOPPED
            self._integrals = (0.0, 0.0)
            return Commands(0.0, 0.0, 0.0, feed)
        wanted = self._lq(measured) if self._is_lq else self._pi(measured)
        given, commands = self._split(wanted, measured)
        self._follow(wanted, given, measured)
        self.mode = self._mode(wanted, given, measured)
        return Commands(*commands, feed)

    def _errors(self, measured: StationMeasurement) -> tuple[float, float]:
        return measured.hp - self._settings.hp_bar, measured.lp - self._settings.lp_bar

    def _lq(self, measured: StationMeasurement) -> _Flows:
        """Return the flows that state feedback asks for."""
        opened = self._flowing(measured)
        state = (*self._errors(measured), opened.bypass - self._nominal, opened.inventory, *self._integrals)
        moves = [-sum(gain * value for gain, value in zip(row, state, strict=True)) for row in self._reference.gains]
        return _Flows(self._nominal + moves[0], moves[1])

    def _pi(self, measured: StationMeasurement) -> _Flows:
        """Return the flows that two single loops ask for."""
        hp, lp = self._errors(measured)
        over_hp, over_lp = self._settings.pi_hp, self._settings.pi_lp
        return _Flows(
            self._nominal - over_lp.gain * (lp + self._integrals[1] / over_lp.integral_s),
            -over_hp.gain * (hp + self._integrals[0] / over_hp.integral_s),
        )

    def _flowing(self, measured: StationMeasurement) -> _Flows:
        """Return what the valves pass at their present openings, as virtual flows."""
        station = self._station
        discharge = measured.discharge * _per_percent(station.discharge, measured.hp)
        charge = measured.charge * _per_percent(station.charge, measured.buffer)
        bypass = measured.bypass * _per_percent(station.bypass, measured.hp)
        return _Flows(bypass + discharge if self._is_lq else bypass, charge - discharge)

    @property
    def _is_lq(self) -> bool:
        return self._settings.control is StationControlKind.LQ

    def _split(self, wanted: _Flows, measured: StationMeasurement) -> tuple[_Flows, tuple[float, float, float]]:
        """Return the flows that the valves can give, and their openings."""
        station = self._station
        per_bypass = _per_percent(station.bypass, measured.hp)
        per_discharge = _per_percent(station.discharge, measured.hp)
        per_charge = _per_percent(station.charge, measured.buffer)
        room = self._charge_room(measured.lp)
        inventory = min(max(wanted.inventory, -100.0 * per_discharge), 100.0 * per_charge * room)
        discharge, charge = max(-inventory, 0.0), max(inventory, 0.0)
        less = discharge if self._is_lq else 0.0
        bypass = min(max(wanted.bypass - less, 0.0), 100.0 * per_bypass)
        openings = bypass / per_bypass, discharge / per_discharge, charge / per_charge
        return _Flows(bypass + less, inventory), openings

    def _charge_room(self, lp: float) -> float:
        """Return the share of the charge valve that the low pressure allows, 0 to 1."""
        above = (lp - self._settings.lp_bar) / self._settings.charge_ends_bar
        return min(max(2.0 - 2.0 * above, 0.0), 1.0)

    def _follow(self, wanted: _Flows, given: _Flows, measured: StationMeasurement) -> None:
        """Integrate the errors, and lead the integrals to where they would have asked for what was given."""
        hp, lp = self._errors(measured)
        missing = given.bypass - wanted.bypass, given.inventory - wanted.inventory
        if self._is_lq:
            (a, b), (c, d) = (row[4:] for row in self._reference.gains)
            determinant = a * d - b * c
            back = (d * missing[0] - b * missing[1]) / determinant, (a * missing[1] - c * missing[0]) / determinant
        else:
            over_hp, over_lp = self._settings.pi_hp, self._settings.pi_lp
            back = missing[1] * over_hp.integral_s / over_hp.gain, missing[0] * over_lp.integral_s / over_lp.gain
        share = min(TICK_S / self._settings.anti_windup_s, 1.0)
        self._integrals = (
            self._integrals[0] + TICK_S * hp - share * back[0],
            self._integrals[1] + TICK_S * lp - share * back[1],
        )

    def _feed(self, level: float) -> float:
        """Return the opening of the nitrogen feed; its integral stops at the ends of the valve's range."""
        tuning = self._settings.pi_nitrogen
        error = self._settings.nitrogen_level - level
        wanted = self._reference.feed + tuning.gain * (error + self._nitrogen_integral / tuning.integral_s)
        given = min(max(wanted, 0.0), 100.0)
        if given == wanted or (wanted > given) != (error > 0.0):
            self._nitrogen_integral += TICK_S * error
        return given

    def _mode(self, wanted: _Flows, given: _Flows, measured: StationMeasurement) -> StationMode:
        if not (measured.nc1 and measured.nc2):
            return StationMode.ONE_COMPRESSOR
        if wanted.inventory > given.inventory and self._charge_room(measured.lp) < 1.0:
            return StationMode.CHARGE_STOPPED
        limited = max(abs(asked - had) for asked, had in zip(wanted, given, strict=True)) > ROUNDING
        return StationMode.LIMITED if limited else StationMode.AUTOMATIC

    def _judged(self, measured: StationMeasurement) -> StationAlarm:
        limits = self._settings.alarms
        raised = {
            StationAlarm.HP_HIGH: measured.hp > limits.hp_high_bar,
            StationAlarm.HP_LOW: measured.hp < limits.hp_low_bar,
            StationAlarm.LP_HIGH: measured.lp > limits.lp_high_bar,
            StationAlarm.LP_LOW: measured.lp < limits.lp_low_bar,
            StationAlarm.NC1_TRIPPED: not measured.nc1,
            StationAlarm.NC2_TRIPPED: not measured.nc2,
            StationAlarm.NITROGEN_LOW: measured.nitrogen < limits.nitrogen_low,
            StationAlarm.HELIUM_LOST: measured.lost > limits.helium_lost_kg,
        }
        return StationAlarm(sum(alarm for alarm, is_raised in raised.items() if is_raised))


def _per_percent(valve: Valve, pressure: float) -> float:
    """Return the choked flow (kg/s) of a valve per % of opening at a pressure (bar) before it."""
    P = PA_PER_BAR * max(pressure, LEAST_PRESSURE)
    return float(valve.flow_area / 100.0 * P * CHOKED / sqrt(GAS_CONSTANT * DESIGN_TEMPERATURE))
