"""The dead band around a band: its alarm is raised beyond it, and returns inside the band."""

from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import COLD_BOX, LEVEL_BAND
from coldloop.registers.common import AlarmKind

if TYPE_CHECKING:
    from tests.control_plc.conftest import Bench

LEVEL, TEMPERATURE = COLD_BOX.dead_bands


@pytest.mark.parametrize("excess", [-1e-6, 0.9 * LEVEL])
def test_a_level_within_the_dead_band_raises_nothing(excess: float, bench: "Bench") -> None:
    bench.steady, bench.level = True, LEVEL_BAND[1] - 60.0 + excess
    bench.scans(40)
    assert not bench.program.alarms.rows[AlarmKind.FIRST_BAND].active


def test_the_alarm_is_raised_beyond_the_dead_band_and_returns_inside_the_band(bench: "Bench") -> None:
    bench.steady, alarm = True, AlarmKind.FIRST_BAND
    for excess, is_active in ((1.1 * LEVEL, 1), (0.1 * LEVEL, 1), (-0.1 * LEVEL, 0), (0.9 * LEVEL, 0)):
        bench.level = LEVEL_BAND[1] - 60.0 + excess
        bench.scans(22)
        assert bench.program.alarms.rows[alarm].active == is_active, excess
    assert bench.program.alarms.rows[alarm].times == 1


def test_dead_bands_are_a_fiftieth_of_the_bands() -> None:
    assert pytest.approx((0.04, 0.14)) == (LEVEL, TEMPERATURE)
