"""What the page decides in pure functions: numbers, qualities, values at the cursor, scales. No server is needed."""

import random
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

from coldloop.text import axis_labels, number_text
from coldloop_hmi.guard import STATIC
from coldloop_hmi.process_image import Quality

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

IMPORT = """async ([name, text]) => {
  window[name] = await import(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
}"""


@pytest.fixture(scope="module")
def logic(browser: "Browser") -> "Iterator[Page]":
    page = browser.new_page()
    for name in ("numbers", "quality", "readout"):
        page.evaluate(IMPORT, [name, (STATIC / "js" / f"{name}.js").read_text(encoding="utf-8")])
    yield page
    page.close()


def test_browser_and_figures_write_the_same_numbers(logic: "Page") -> None:
    draw = random.Random(55)  # noqa: S311 numbers of a test
    numbers = [draw.uniform(-10, 10) * 10.0 ** draw.randint(-20, 20) for _ in range(500)]
    assert logic.evaluate("(all) => all.map((one) => numbers.numberText(one))", numbers) == list(
        map(number_text, numbers)
    )
    axes = []
    for _ in range(300):
        step, first = draw.choice((1, 2, 2.5, 5)) * 10.0 ** draw.randint(-9, 12), draw.randint(-10_000_000, 10_000_000)
        axes.append([step * (first + i) for i in range(6)])
    axes.append([150_000.0, 150_000.5, 150_001.0])
    assert logic.evaluate("(all) => all.map(numbers.axisLabels)", axes) == [axis_labels(marks) for marks in axes]


def test_ends_and_times_lose_nothing_that_is_seen(logic: "Page") -> None:
    assert logic.evaluate("numbers.endsText(101300.5, 101475.25)") == ["101300.5", "101475.3"]
    assert logic.evaluate("numbers.endsText(-1.25, 11.25)") == ["-1.25", "11.25"]
    assert logic.evaluate("numbers.timeText(59.999)") == "0:01:00"
    assert logic.evaluate("numbers.secondsOf('1:02:03.5')") == 3723.5
    assert logic.evaluate("['', '1:x', '-5'].map(numbers.secondsOf).map(String)") == ["null", "NaN", "NaN"]


def test_the_worst_quality_of_a_name_and_its_beginnings_counts(logic: "Page") -> None:
    assert logic.evaluate("quality.QUALITIES") == list(Quality)
    entries = {"a.": "stale", "a.y.T3": "suspect", "a.y.T1": "simulated", "b.y.T3": "held"}
    found = logic.evaluate(
        "(entries) => ['a.y.T3', 'a.y.T1', 'b.y.T3', 'b.y.T31'].map((one) => quality.qualityIn(entries, one))", entries
    )
    assert found == ["stale", "simulated", "held", "good"]


TREND = {
    "now_s": 20.0, "planned": True,
    "time": [0.0, 5.0, 5.25, 10.0, 20.0], "series": {"L1": [1.0, 2.0, None, 3.0, 4.0], "v": [5.0, 5.0, None, 5.0, 5.0]},
    "doubtful": {"L1": [[10.0, 15.0, "suspect"]]}, "bands": {"L1": [0, 9]},
    "updates": {"time": [0.0, 4.0, 4.25], "tau_u": [2.0, 2.0, None], "q": [1.0, 1.0, None]},
    "predictions": [
        {"update": 1, "time": [20.0, 30.0], "L1": [4.0, 6.0], "input_time": [20.0, 25.0, 30.0], "v": [5.0, 7.0, 9.0]}
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("time", "planned", "expected"),
    [
        (2.0, True, [("L1", 1.0, "good"), ("v", 5.0, "good"), ("tau_u", 2.0, "good"), ("q", 1.0, "good")]),
        (7.0, True, []),
        (12.0, True, [("L1", 3.0, "suspect"), ("v", 5.0, "good")]),
        (26.0, True, [("L1", 5.2, "predicted"), ("v", 7.0, "predicted")]),
        (26.0, False, []),
        (31.0, True, []),
    ],
    ids=["measured", "gap", "suspect", "ahead", "nothing planned", "beyond the horizon"],
)
def test_the_cursor_shows_what_was_and_what_is_predicted(
    logic: "Page", time: float, expected: list[tuple[Any, ...]], *, planned: bool
) -> None:
    found = logic.evaluate("([trend, time]) => readout.valuesAt(trend, time)", [TREND | {"planned": planned}, time])
    assert [(one["name"], pytest.approx(one["value"]), one["quality"]) for one in found] == expected


def test_a_scale_follows_the_data_and_a_far_band_is_left_outside(logic: "Page") -> None:
    low, high = logic.evaluate("readout.scaleOf(42, 44, [20, 60], 0.1)")
    assert (low, high) == pytest.approx((41.84, 44.16)), "2 % fill the chart"
    low, high = logic.evaluate("readout.scaleOf(59.9, 60.1, [59, 61], 2)")
    assert (low, high) == pytest.approx((58.84, 61.16))
    assert logic.evaluate("readout.scaleOf(null, null, [59, 61], 0.1)") == pytest.approx([58.84, 61.16])
