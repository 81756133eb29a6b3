"""When alarms are raised, how urgent they are, and how long they may be shelved."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Final, Literal, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, model_validator

from coldloop.process.declaration import Process
from coldloop.process.sections import Range
from coldloop.process.settings import ProcessSettings, declared, settings_process, stretched, within
from coldloop.registers.safety import AlarmKind, AlarmPriority, alarm_key, alarms_of, band_alarms

PASSING: Final = (AlarmKind.SCAN_OVERRUN, AlarmKind.ACCESS_REFUSED, AlarmKind.SECOND_WRITER)
"""Alarms for something that happens at an instant: their off-delay is how long ago the last time must be."""
OF_THE_PROCESS: Final = (AlarmKind.CAPACITY, AlarmKind.SENSOR_SUSPECT, AlarmKind.INPUT_WITHOUT_EFFECT)
"""Alarms that, as those of bands, say nothing against PLCs, links and what the control PLC works with."""

LOW, MEDIUM, HIGH, CRITICAL = AlarmPriority


class AlarmRule(NamedTuple):
    """How one alarm is treated. Delays are seconds of plant time."""

    priority: AlarmPriority
    on_delay_s: float = 0.0
    """How long the condition must hold before the alarm is raised."""
    off_delay_s: float = 0.0
    """How long the condition must have ended before the alarm returns."""


DEFAULT_RULES: Final[Mapping[AlarmKind, AlarmRule]] = MappingProxyType({
    # The process is uncontrolled, or under another master: act at once.
    AlarmKind.PLANT_LOST: AlarmRule(CRITICAL),  # only the rack's watchdog protects the plant
    AlarmKind.PLANT_OTHER_MASTER: AlarmRule(CRITICAL),  # another master decides the outputs
    AlarmKind.OUTPUTS_REJECTED: AlarmRule(CRITICAL),  # what is computed is not applied
    AlarmKind.SCANS_STOPPED: AlarmRule(CRITICAL),  # nothing is computed
    # The process leaves its limits, or is about to unnoticed: act within minutes.
    AlarmKind.FIRST_BAND: AlarmRule(HIGH),  # as all bands; of the cold box the bath may run dry or flood
    AlarmKind.SECOND_BAND: AlarmRule(HIGH),  # of the cold box the turbine leaves its range
    AlarmKind.PLANT_FROZEN: AlarmRule(HIGH),  # measurements are old
    AlarmKind.CAPACITY: AlarmRule(HIGH, 20.0, 30.0),  # no control holds this load
    # Control is degraded, or a protection is lost: act within the shift.
    AlarmKind.MODE: AlarmRule(MEDIUM),  # the ladder has left MPC
    AlarmKind.SEQUENCE_EXHAUSTED: AlarmRule(MEDIUM),  # outputs are held, then the classical loops control
    AlarmKind.OPTIMIZER_LOST: AlarmRule(MEDIUM),  # no new sequence will come by itself
    AlarmKind.SENSOR_BAD: AlarmRule(MEDIUM),  # substituted; the ladder reacts to those that matter
    AlarmKind.SENSOR_SUSPECT: AlarmRule(MEDIUM),  # the optimiser does without it
    AlarmKind.INPUT_WITHOUT_EFFECT: AlarmRule(MEDIUM),  # likewise: the turbine stands
    AlarmKind.MODEL_MISMATCH: AlarmRule(MEDIUM),  # no sequence is accepted until a configuration is changed
    AlarmKind.SECOND_WRITER: AlarmRule(MEDIUM, off_delay_s=60.0),  # refused, but wired or configured wrongly
    AlarmKind.CERTIFICATE: AlarmRule(MEDIUM),  # clients will not connect once it has expired
    AlarmKind.STATE_NOT_RETAINED: AlarmRule(MEDIUM),  # a restart would not continue from here
    # No immediate action: a hint for maintenance.
    AlarmKind.SEQUENCE_REJECTED: AlarmRule(LOW),  # the rest of the last sequence is played meanwhile
    AlarmKind.SEQUENCE_LATE: AlarmRule(LOW),  # likewise
    AlarmKind.SCAN_OVERRUN: AlarmRule(LOW, off_delay_s=60.0),  # outputs came some milliseconds late
    AlarmKind.ACCESS_REFUSED: AlarmRule(LOW, off_delay_s=60.0),  # nothing has happened
    AlarmKind.CLOCK_SKEW: AlarmRule(LOW),  # the scan follows the rack's clock
})  # fmt: skip
"""Priorities by how soon an operator has to act (ANSI/ISA-18.2-2016, clause 8), and delays."""


def _known_name(name: str) -> str:
    process = settings_process()
    known = [alarm_key(alarm, process) for alarm in alarms_of(process)]
    if name.lower() not in known:
        raise ValueError(f"unknown alarm '{name}'; choose from {', '.join(known)}")
    return name.lower()


Delay = Annotated[FiniteFloat, within(lambda process: (0, 345_600 * process.tick_s))]


class RuleSettings(BaseModel):
    """What differs from the default rule of an alarm; what is not given stays."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    priority: Literal["low", "medium", "high", "critical"] | None = None
    on_delay_s: Delay | None = None
    """How long the condition must hold before the alarm is raised, plant time."""
    off_delay_s: Delay | None = None
    """How long the condition must have ended before the alarm returns, plant time."""

    def changed(self, rule: AlarmRule) -> AlarmRule:
        """Return a rule with what is given here."""
        return AlarmRule(
            rule.priority if self.priority is None else AlarmPriority[self.priority.upper()],
            rule.on_delay_s if self.on_delay_s is None else self.on_delay_s,
            rule.off_delay_s if self.off_delay_s is None else self.off_delay_s,
        )


def _bands_of(process: Process) -> dict[str, Range]:
    return {one.name: one.alarm or one.edges for one in process.banded if one.edges is not None}


def _with_declared(given: object) -> object:
    """Return bands by output, those of the process where none are given."""
    if not isinstance(given, Mapping):
        return given
    found: dict[str, object] = {**_bands_of(settings_process())}
    names = {name.lower(): name for name in found}  # the environment has no capitals
    for name, band in given.items():
        if str(name).lower() not in names:
            raise ValueError(f"{name}: no output with a band; choose from {', '.join(found)}")
        found[names[str(name).lower()]] = band
    return found


class AlarmSettings(ProcessSettings):
    """When the alarms are raised, how urgent they are, and how long they may be shelved."""

    bands: Annotated[dict[str, tuple[FiniteFloat, FiniteFloat]], BeforeValidator(_with_declared)] = declared(_bands_of)
    """Of each output that has one, by its name; those that are not given are as the process declares them."""
    band_delay_s: Delay = stretched(5.0)
    """On-delay of their alarms: how long an output must be outside, plant time."""
    rules: dict[Annotated[str, AfterValidator(_known_name)], RuleSettings] = Field(default_factory=dict)
    """By name of the alarm, such as `sensor_bad`."""
    shelving_s: Annotated[FiniteFloat, Field(ge=1, le=65_535)] = 900.0
    """How long an alarm is shelved by a command that gives no time, plant time."""
    longest_shelving_s: Annotated[FiniteFloat, Field(ge=1, le=65_535)] = 28_800.0
    """Longest time of one command, plant time. A shift: the next one decides again."""

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, given: object) -> object:
        for name in ("level_band", "t5_band"):
            if isinstance(given, Mapping) and name in given:
                raise ValueError(f"{name}: bands have the names of their outputs since 0.4: set bands.L1 or bands.T5")
        return given

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.shelving_s > self.longest_shelving_s:
            raise ValueError("shelving_s is above longest_shelving_s; shorten it, or allow more")
        delayed = [kind.name.lower() for kind in PASSING if self.rule(kind).on_delay_s]
        if delayed:
            raise ValueError(f"{delayed[0]} happens at an instant and would never be raised; leave out its on_delay_s")
        return self

    def rule(self, alarm: int) -> AlarmRule:
        """Return how an alarm is treated."""
        is_band = alarm in band_alarms(self.process)
        default = DEFAULT_RULES[AlarmKind.FIRST_BAND if is_band else AlarmKind(alarm)]
        if alarm == AlarmKind.CAPACITY:
            stretch = self.process.stretch
            default = AlarmRule(default.priority, default.on_delay_s * stretch, default.off_delay_s * stretch)
        if is_band:
            default = default._replace(on_delay_s=self.band_delay_s)
        return self.rules.get(alarm_key(alarm, self.process), RuleSettings()).changed(default)

    def shelving_ticks(self, asked_s: int) -> int:
        """Return how long an alarm is shelved when so many seconds are asked for; 0 asks for the default."""
        return self.ticks(min(asked_s or self.shelving_s, self.longest_shelving_s))

    def ticks(self, seconds: float) -> int:
        """Return a time in ticks, not shorter than it; what is smaller than the error of a float does not count."""
        return math.ceil(seconds / self.process.tick_s - 1e-9)
