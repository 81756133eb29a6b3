"""Settings of the station's controller: set points, weights, tunings, limits of the alarms."""

from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator

Bar = Annotated[float, Field(gt=0, le=100)]
Percent = Annotated[float, Field(ge=0, le=100)]


class StationControlKind(StrEnum):
    """How the two pressures are held."""

    LQ = "lq"
    """Both by both valves, with state feedback and integral action."""
    PI = "pi"
    """The low pressure by the bypass, the high pressure by the buffer's valves, each a PI."""


class LqWeights(BaseModel):
    """What the LQ controller weighs: 1 over the square of each of these."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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


class PiTuning(BaseModel):
    """Gain and integral time of one loop."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gain: PositiveFloat
    """kg/s per bar, or % per % for the nitrogen."""
    integral_s: PositiveFloat
    """Integral time, s."""


class StationAlarmSettings(BaseModel):
    """Where the station's alarms begin."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    """Of the bath; its relief valve opens at 1.8 bar."""

    @model_validator(mode="after")
    def _low_is_below_high(self) -> "StationAlarmSettings":
        if not (self.hp_low_bar < self.hp_high_bar and self.lp_low_bar < self.lp_high_bar):
            raise ValueError("a low limit is not below its high one: write hp_low_bar < hp_high_bar, and so for lp")
        return self


class CompressorStart(BaseModel):
    """How a compressor starts: it idles with the bypass open, then it is loaded in a ramp."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    idle: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Share of its flow while it idles."""
    idle_s: Annotated[float, Field(ge=0, le=600)] = 10.0
    """How long it idles, s."""
    load_s: Annotated[float, Field(gt=0, le=3600)] = 50.0
    """How long the ramp takes, s."""
    second: Annotated[float, Field(ge=0, le=1)] = 0.7
    """Share of what the first one gives that the cold box takes when the second one is started."""


class PressureProtection(BaseModel):
    """Pressures that override the controller, fully from the second one on, and those that stop a compressor."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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


class TurbineProtection(BaseModel):
    """How the turbine starts, and how fast it may turn."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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


class StationSettings(BaseModel):
    """Section `plant.station`: the controller of the compression station."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    control: StationControlKind = StationControlKind.LQ
    hp_bar: Annotated[float, Field(ge=8, le=17.5)] = 16.0
    """Set point of the high pressure."""
    lp_bar: Annotated[float, Field(ge=1.0, le=1.3)] = 1.05
    """Set point of the low pressure."""
    nitrogen_level: Annotated[float, Field(ge=5, le=95)] = 60.0
    """Set point of the nitrogen level, %."""
    weights: LqWeights = LqWeights()
    """Of the LQ design. The gains are those of the refrigerator's file, which must be of these weights."""
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
