"""How the pressures' responses to steps are judged, and what the controllers make of a step."""

import numpy as np
import pytest

from coldloop_plant.settings import StationControlKind
from coldloop_refrigerator.pressure_steps import LOAD, Response, pressures_after, response_of, table
from coldloop_refrigerator.program import SHIPPED, read_refrigerator_file

pytestmark = pytest.mark.usefixtures("compiles")

FILE = read_refrigerator_file(SHIPPED)


@pytest.mark.parametrize(
    ("deviations", "response"),
    [
        ([0, 3, 4, -1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1], Response(4, 1, 5 * 0.25)),
        ([0, -3, -4, 1, -2, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1], Response(-4, 1, 5 * 0.25)),
        ([2, 1, 0, 0, 0, 0, 0, 0, 0, 0], Response(2, 0, 2 * 0.25)),
        ([0, 0, 0, 0], Response(0, 0, 0)),
        (list(range(10)), Response(9, 0, None)),
    ],
    ids=["overshoot", "overshoot of a fall", "decay", "nothing moves", "a ramp does not settle"],
)
def test_a_response_is_judged_as_by_hand(deviations: list[float], response: Response) -> None:
    assert response_of(np.array(deviations, dtype=np.float64), 0.5) == response


def test_without_control_a_pressure_that_is_pushed_does_not_come_back_and_with_it_does() -> None:
    ends = {
        control: pressures_after("CV953", 20.0, control, 200.0, FILE)[-1, 0] - 16.0
        for control in (None, *StationControlKind)
    }
    assert ends[None] > 1.0
    assert max(abs(ends[control]) for control in StationControlKind) < 0.15


def test_the_table_has_a_line_for_each_step_and_control() -> None:
    lines = table(1.0, ((LOAD, 60.0), ("CV956", 5.0)))
    assert [line.split(" | ")[:2] for line in lines[2:]] == [
        [f"| {step}", control] for step in ("load +60 W", "CV956 +5 %") for control in ("none", "lq", "pi")
    ]
