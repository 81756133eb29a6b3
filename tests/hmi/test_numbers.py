"""Numbers as people read them: labels of neighbouring marks differ, and all can be read back."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.text import NEAR, axis_labels, number_text

STEPS = st.builds(
    lambda mantissa, power: mantissa * 10.0**power, st.sampled_from((1.0, 2.0, 2.5, 5.0)), st.integers(-9, 12)
)


@given(step=STEPS, first=st.integers(-10_000_000, 10_000_000), count=st.integers(2, 9))
def test_labels_of_marks_differ_and_parse_back(step: float, first: int, count: int) -> None:
    marks = [step * (first + i) for i in range(count)]
    labels = axis_labels(marks)
    assert all(one != other for one, other in pairwise(labels))
    for mark, label in zip(marks, labels, strict=True):
        assert abs(float(label) - mark) <= NEAR * step + 1e-15 * abs(mark)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False), st.integers(2, 9))
def test_numbers_are_as_exact_as_their_digits(value: float, digits: int) -> None:
    assert math.isclose(float(number_text(value, digits)), value, rel_tol=0.51 * 10.0 ** (1 - digits), abs_tol=0.0)


@pytest.mark.parametrize(
    ("value", "text"),
    [(150000.0, "150000"), (3.127e13, "3.127e13"), (1.4211e-14, "1.421e-14"), (-0.00012, "-0.00012"), (-0.0, "0")],
)  # fmt: skip
def test_numbers_read_as_usual(value: float, text: str) -> None:
    assert number_text(value) == text
