"""Configuration of the plant service, checked when it is made and immutable after."""

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field, FiniteFloat, PositiveFloat, field_validator, model_validator

from coldloop.modbus.settings import PLANT_PORT, ServerSettings
from coldloop.process import cold_box, sections
from coldloop.process import settings as common
from coldloop.process.settings import InputLimits, PerInput, ProcessSettings, declared, stretched, within
from coldloop.registers.codec import WordOrder
from coldloop.safety.retained import RetainSettings
from coldloop.service.settings import MetricsSettings, TelemetrySettings
from coldloop.session import SessionSettings

SHOWN: Final = (
    "plant.kind", "plant.station", "plant.refrigerator", "plant.mismatch", "plant.sensors", "plant.clock_error_ppm",
    "plant.watchdog", "plant.rate_limited", "limits.rate",
)  # fmt: skip
"""Keys of the configuration that decide results; the registers show them. Load and seed are those of a session."""

Deviation = Annotated[float, Field(ge=0)]

Factor = Annotated[float, Field(ge=0.5, le=1.4)]
Bar = Annotated[float, Field(gt=0, le=100)]
Percent = Annotated[float, Field(ge=0, le=100)]


class MismatchSettings(sections.Section):
    """Mismatch of the cold box to its model: most values are factors. It begins at the model's point of rest."""

    heat_transfer: Factor = 1.0
    """UA of the three heat exchangers."""
    turbine_efficiency: Factor = 1.0
    """Isentropic efficiency of the turbine over that of the model."""
    jt_valve: Factor = 1.0
    """Flow area of CV155."""
    turbine_valve: Factor = 1.0
    """Flow area of CV156."""
    heater: Factor = 1.0
    """Power of NCR22_A, as the next three in a loop that is not compiled."""
    load: Factor = 1.0
    """Heat load over what is announced."""
    level_gauge: Factor = 1.0
    """Factor of the reading of L1."""
    delay_ticks: Annotated[int, Field(ge=0, le=20)] = 0
    """Ticks by which inputs act later."""

    @property
    def beside_the_box(self) -> bool:
        """Whether something is off that is no parameter of the cold box."""
        return (self.heater, self.load, self.level_gauge, self.delay_ticks) != (1.0, 1.0, 1.0, 0)


class SensorSettings(ProcessSettings):
    """Standard deviations of the sensors' noise, and what they show too much; 0 is an exact sensor."""

    level: Deviation = 0.0
    """%."""
    speed: Deviation = 0.0
    """Hz."""
    temperature: Deviation = 0.0
    """K."""
    pressure: Deviation = 0.0
    """bar."""
    declared: Deviation = 0.0
    """Noise of other processes than the cold box: over the noise that the process declares."""
    level_bias: FiniteFloat = 0.0
    """%: that much is shown too much, as by the next two."""
    temperature_bias: FiniteFloat = 0.0
    """K, at each of the ten."""
    pressure_bias: FiniteFloat = 0.0
    """bar, at each of the ten."""

    @property
    def deviations(self) -> tuple[float, ...]:
        """Standard deviation of each output."""
        return tuple(
            getattr(self, output.quantity) if output.quantity else self.declared * output.noise
            for output in self.process.outputs
        )

    @property
    def biases(self) -> tuple[float, ...]:
        """Bias of each output."""
        return tuple(getattr(self, f"{output.quantity}_bias", 0.0) for output in self.process.outputs)


class SafeAction(StrEnum):
    """Action of the rack on its outputs when the control PLC is silent."""

    HOLD = "hold"
    """It leaves them as they are."""
    SAFE = "safe"
    """It applies `safe_state`."""


class WatchdogSettings(ProcessSettings):
    """The rack's watchdog over the control PLC."""

    timeout_s: Annotated[float, within(lambda process: (0, 64_000 * process.tick_s))] = stretched(10.0, least=1.0)
    """Plant time without new outputs after which it expires; 0 is never. In lock-step plant time then stops."""
    action: SafeAction = SafeAction.HOLD
    safe_state: PerInput = declared(lambda process: tuple(one.safe for one in process.inputs))
    """Safe value of each input: for the cold box CV155 %, NCR22_A W, CV156 %."""

    @field_validator("safe_state")
    @classmethod
    def _within_registers(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        for one, value in zip(common.settings_process().inputs, values, strict=True):
            low, high = one.span
            if not low <= value <= high:
                raise ValueError(f"{one.name} = {value:g} is outside {low:g} to {high:g} {one.unit}".rstrip())
        return values

    @property
    def ticks(self) -> int:
        """The time-out, in ticks."""
        return math.ceil(self.timeout_s / self.process.tick_s)


class PlantServer(ServerSettings):
    """The rack's server."""

    port: Annotated[int, Field(ge=0, le=0xFFFF)] = PLANT_PORT


class PlantKind(StrEnum):
    """Kind of the simulated plant."""

    COLD_BOX = "cold-box"
    """S1 and S2; pressures and inlet temperature are constant."""
    REFRIGERATOR = "refrigerator"
    """S1 to S4: with nitrogen pre-cooler and compression station."""
    OF_PROCESS = "of-process"
    """The plant of the process in the model file."""


class StationControlKind(StrEnum):
    """Kind of control of the two pressures."""

    LQ = "lq"
    """Both by both valves, with state feedback and integral action."""
    PI = "pi"
    """The low pressure by the bypass, the high pressure by the buffer's valves, each a PI."""


class LqWeights(sections.Section):
    """Weights of the LQ controller: 1 over the square of each of these."""

    hp_bar: PositiveFloat = 0.1
    """Deviation of the high pressure, bar."""
    lp_bar: PositiveFloat = 0.01
    """Deviation of the low pressure, bar."""
    hp_integral: PositiveFloat = 5.0
    """Integral of the high pressure's deviation, bar s."""
    lp_integral: PositiveFloat = 0.05
    """The same for the low pressure."""
    bypass_kg_s: PositiveFloat = 0.01
    """Bypass flow, kg/s."""
    inventory_kg_s: PositiveFloat = 0.01
    """Flow into or out of the buffer, kg/s."""


class PiTuning(sections.Section):
    """Gain and integral time of one loop."""

    gain: PositiveFloat
    """kg/s per bar, or % per % for the nitrogen."""
    integral_s: PositiveFloat
    """Integral time, s."""


class StationAlarmSettings(sections.Section):
    """Limits at which the station's alarms begin."""

    hp_high_bar: Bar = 16.8
    """High pressure, bar, above."""
    hp_low_bar: Bar = 14.5
    """High pressure, bar, below."""
    lp_high_bar: Bar = 1.15
    """Low pressure, bar, above."""
    lp_low_bar: Bar = 0.97
    """Low pressure, bar, below."""
    nitrogen_low: Percent = 25.0
    """%."""
    helium_lost_kg: PositiveFloat = 0.5
    """Helium that is gone from the circuit, kg."""
    bath_relief_bar: Bar = 1.8
    """Pressure of the bath, bar; its relief valve opens at 1.8 bar."""

    @model_validator(mode="after")
    def _low_is_below_high(self) -> "StationAlarmSettings":
        if not (self.hp_low_bar < self.hp_high_bar and self.lp_low_bar < self.lp_high_bar):
            raise ValueError("a low limit is not below its high one: write hp_low_bar < hp_high_bar, and so for lp")
        return self


class CompressorStart(sections.Section):
    """Start of a compressor: it idles with the bypass open, then it is loaded in a ramp."""

    idle: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Share of its flow while it idles."""
    idle_s: Annotated[float, Field(ge=0, le=600)] = 10.0
    """How long it idles, s."""
    load_s: Annotated[float, Field(gt=0, le=3600)] = 50.0
    """How long the ramp takes, s."""
    second: Annotated[float, Field(ge=0, le=1)] = 0.7
    """Share of what the first one gives that the cold box takes when the second one is started."""


class PressureProtection(sections.Section):
    """Pressures that override the controller, fully from the second one on, and those that stop a compressor."""

    hp_bar: tuple[Bar, Bar] = (17.0, 17.6)
    """Above it the charge valve shuts and the discharge valve opens; the line's relief valve opens at 18 bar."""
    lp_bar: tuple[Bar, Bar] = (0.99, 0.89)
    """Below it the discharge valve shuts and the charge valve opens."""
    trip_lp_bar: tuple[Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)]] = (0.75, 0.8)
    """Low pressures that stop NC1 and NC2: the one stops first, so that the other may go on; 0 is never."""

    @model_validator(mode="after")
    def _bands_have_a_width(self) -> "PressureProtection":
        if not self.hp_bar[0] < self.hp_bar[1]:
            raise ValueError("hp_bar: write the high pressure at which it begins to act, then a higher one")
        if not self.lp_bar[0] > self.lp_bar[1] > max(self.trip_lp_bar):
            raise ValueError("lp_bar: write the low pressure at which it begins to act, then a lower one that is above "
                             "both of trip_lp_bar")  # fmt: skip
        return self


class TurbineProtection(sections.Section):
    """Start of the turbine, and its largest speed."""

    run_up_s: Annotated[float, Field(ge=1, le=3600)] = 60.0
    """Shortest time in which CV156 opens to what is asked."""
    governed_hz: Annotated[float, Field(ge=100, le=1e4)] = 3000.0
    """Speed beyond which the governor closes CV156; 2,350 Hz is that of the operating point."""
    overspeed_hz: Annotated[float, Field(ge=100, le=1e4)] = 3300.0
    """Speed at which the turbine is tripped."""

    @model_validator(mode="after")
    def _governor_comes_first(self) -> "TurbineProtection":
        if not self.governed_hz < self.overspeed_hz:
            raise ValueError("the governor is to act before the trip: write governed_hz < overspeed_hz")
        return self


class StationSettings(sections.Section):
    """Section `plant.station`: the controller of the compression station."""

    control: StationControlKind = StationControlKind.LQ
    hp_bar: Annotated[float, Field(ge=8, le=17.5)] = 16.0
    """Set point of the high pressure."""
    lp_bar: Annotated[float, Field(ge=1.0, le=1.3)] = 1.05
    """Set point of the low pressure."""
    nitrogen_level: Annotated[float, Field(ge=5, le=95)] = 60.0
    """Set point of the nitrogen level, %."""
    weights: LqWeights = LqWeights()
    """Weights of the LQ design. The gains are those of the refrigerator's file, which must be of these weights."""
    anti_windup_s: PositiveFloat = 5.0
    """Time constant with which integrals follow what the valves can do."""
    pi_hp: PiTuning = PiTuning(gain=0.024, integral_s=50.0)
    pi_lp: PiTuning = PiTuning(gain=0.2, integral_s=4.0)
    pi_nitrogen: PiTuning = PiTuning(gain=2.0, integral_s=600.0)
    noise_bar: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Standard deviation of the noise on the station's own gauges of high and low pressure, bar."""
    dead_band: Annotated[float, Field(ge=0, le=20)] = 1.0
    """Inventory flow up to which the buffer's valves stay shut, over the standard deviation that the noise gives it:
    without noise there is no dead band."""
    charge_ends_bar: Annotated[float, Field(gt=0, le=0.5)] = 0.08
    """So far above its set point does the low pressure close the charge valve, whatever the high pressure asks for."""
    start: CompressorStart = CompressorStart()
    turbine: TurbineProtection = TurbineProtection()
    protection: PressureProtection = PressureProtection()
    alarms: StationAlarmSettings = StationAlarmSettings()

    @model_validator(mode="after")
    def _limits_are_beyond_set_points(self) -> "StationSettings":
        high, low = self.protection.hp_bar[0], self.protection.lp_bar[0]
        if not (self.hp_bar < high and low < self.lp_bar):
            raise ValueError(f"set points are to be within the limits of protection: hp_bar below {high:g} bar, lp_bar "
                             f"above {low:g} bar")  # fmt: skip
        return self


class EventTarget(StrEnum):
    """Target of an event: what it changes."""

    NC1 = "nc1"
    """1: the compressor runs, 0: it has tripped."""
    NC2 = "nc2"
    NITROGEN = "nitrogen"
    """1: there is nitrogen in the tank, 0: there is none."""
    LEAK = "leak"
    """Leak from the high-pressure line, g/s at 16 bar."""
    AMBIENT = "ambient"
    """Temperature of the surroundings, K."""
    TURBINE = "turbine"
    """1: the turbine may run, 0: it is tripped."""
    CV155 = "cv155"
    """1: the valve follows what is asked, 0: it is stuck where it is."""
    CV156 = "cv156"
    HEATER = "heater"
    """1: the heater follows what is asked, 0: it is off, 2: fully on."""
    BLOCKED_NEF1 = "blocked_nef1"
    """Share of the exchanger that impurities block in an hour; below 0 it is cleaned."""
    BLOCKED_NEF2 = "blocked_nef2"
    BLOCKED_NEF34 = "blocked_nef34"
    BLOCKED_NEF6 = "blocked_nef6"


BLOCKING = (EventTarget.BLOCKED_NEF1, EventTarget.BLOCKED_NEF2, EventTarget.BLOCKED_NEF34, EventTarget.BLOCKED_NEF6)
RANGES = {
    **dict.fromkeys(EventTarget, (0.0, 1.0)),
    **dict.fromkeys(BLOCKING, (-10.0, 10.0)),
    EventTarget.LEAK: (0.0, 50.0),
    EventTarget.AMBIENT: (270.0, 320.0),
    EventTarget.HEATER: (0.0, 2.0),
}
MEASURED = {EventTarget.LEAK, EventTarget.AMBIENT, *BLOCKING}
"""Targets with a value; the others are in one of a few states, numbered from 0."""


class RefrigeratorEvent(sections.Section):
    """Change of one boundary condition or piece of equipment from a time on."""

    at_s: Annotated[float, Field(ge=0, le=1e9)]
    """Plant time, in multiples of 0.25 s."""
    target: EventTarget
    value: float
    """Value of the target from then on, in its unit."""

    @model_validator(mode="after")
    def _is_possible(self) -> "RefrigeratorEvent":
        low, high = RANGES[self.target]
        if not low <= self.value <= high:
            raise ValueError(f"{self.target} = {self.value:g} is outside {low:g} to {high:g}")
        if self.target not in MEASURED and not self.value.is_integer():
            states = "0 or 1" if high == 1.0 else "0, 1 or 2"
            raise ValueError(f"{self.target} = {self.value:g}: write {states}")
        if self.at_s % cold_box.TICK_S:
            raise ValueError(f"{self.at_s:g} s is not a multiple of {cold_box.TICK_S} s")
        return self

    @property
    def tick(self) -> int:
        """The first tick that it concerns."""
        return round(self.at_s / cold_box.TICK_S)


class RefrigeratorStart(StrEnum):
    """State of a refrigerator at the beginning of a session."""

    OPERATING_POINT = "operating-point"
    """At rest, with the bath filled."""
    WARM = "warm"
    """At ambient temperature, its helium in the buffer, its compressors about to start."""


class RefrigeratorSettings(sections.Section):
    """Start and disturbances of a refrigerator."""

    file: Path | None = None
    """Its operating point and the gains of its pressure controller; by default those of the reference plant."""
    start: RefrigeratorStart = RefrigeratorStart.OPERATING_POINT
    ambient_k: Annotated[float, Field(ge=RANGES[EventTarget.AMBIENT][0], le=RANGES[EventTarget.AMBIENT][1])] = 300.0
    """Temperature of the surroundings."""
    daily_swing_k: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Amplitude of a day's sine about it; the first six hours are the warmer."""
    events: tuple[RefrigeratorEvent, ...] = ()
    """Events and their times: `{at_s = 600, target = "nc1", value = 0}` trips a compressor after ten minutes."""


class PlantSection(ProcessSettings):
    """Section `plant` of the configuration."""

    kind: PlantKind = declared(lambda process: PlantKind(process.plants[0]))
    refrigerator: RefrigeratorSettings = RefrigeratorSettings()
    """Read by the refrigerator only, as is `station`."""
    station: StationSettings = StationSettings()
    server: PlantServer = PlantServer()
    word_order: WordOrder = WordOrder.HIGH_FIRST
    metrics: MetricsSettings = MetricsSettings()
    load: Annotated[str, Field(min_length=1)] = "2h"
    """Named load or CSV file."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    """Seed of the sensors' noise."""
    mismatch: MismatchSettings = MismatchSettings()
    """Mismatch of a cold box alone."""
    sensors: SensorSettings = Field(default_factory=SensorSettings)
    clock_error_ppm: Annotated[float, Field(ge=-50_000, le=50_000)] = 0.0
    """How much too fast the rack's clock is in real time, in millionths: for tests of those who follow it."""
    watchdog: WatchdogSettings = Field(default_factory=WatchdogSettings)
    rate_limited: bool = True
    """No output moves by more than `limits.rate` in one tick of the rack, for any writer; the safe state does."""
    retain: RetainSettings = RetainSettings()


class PlantSettings(common.RootSettings):
    """Settings that the plant service reads of a configuration."""

    limits: InputLimits = Field(default_factory=InputLimits)
    session: SessionSettings = SessionSettings()
    plant: PlantSection = Field(default_factory=PlantSection)
    telemetry: TelemetrySettings = TelemetrySettings()
