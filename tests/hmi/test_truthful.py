"""What the page draws is what was read and what is so: gaps, other modes, replays, and commands that wait."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from coldloop.process.cold_box import COLD_BOX
from coldloop_hmi.process_image import TrendStore
from tests.harness.processes import Processes
from tests.harness.waiting import eventually
from tests.hmi.conftest import RECORDED_S, Served, Site, log_in_by_clicks, opened
from tests.hmi.test_operating import MANUAL, MPC, confirm, mode, view
from tests.hmi.test_sceptical_operator import operated, outcome

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

__all__ = ["operated"]  # a fixture


def trend_of_level(site: Site) -> Any:  # noqa: ANN401 - JSON
    return site.ask("/api/trend?names=L1").document


def test_a_time_in_which_nothing_was_read_is_a_gap_and_no_line(page: "Page", site: Site) -> None:
    view(page, "trends")
    frozen_at = trend_of_level(site)["now_s"]
    site.freeze("control_plc")
    try:
        eventually(lambda: not site.is_live("control_plc"), "the page notices")
    finally:
        site.thaw("control_plc")
    eventually(lambda: any(end > frozen_at for _, end in trend_of_level(site)["gaps"]), "a gap")
    trend = trend_of_level(site)
    start, end = trend["gaps"][-1]
    inside = [value for time, value in zip(trend["time"], trend["series"]["L1"], strict=True) if start < time < end]
    assert inside == [None], "the line is interrupted once"
    eventually(lambda: page.evaluate("document.querySelector('#chart-L1')?.dataset.gaps > 0"), "it is drawn")
    assert "nothing read" in page.inner_text("#trend-legend")
    eventually(lambda: mode(site) == MPC, "MPC drives again")


def test_in_manual_nothing_of_mpc_looks_current_and_the_button_says_who_drives(operated: "Page", site: Site) -> None:
    pressed = "[...document.querySelectorAll('[data-mode][aria-pressed=true]')].map((one) => one.dataset.mode)"
    eventually(lambda: operated.evaluate(pressed) == ["auto"], "automatic is pressed")
    operated.click("[data-mode=manual]")
    confirm(operated)
    eventually(lambda: mode(site) == MANUAL, "manual")
    try:
        eventually(lambda: operated.evaluate(pressed) == ["manual"], "manual is pressed")
        eventually(lambda: operated.locator("#tau-u.stale").count() == 1, "the updating period is crossed out")
        assert operated.title().endswith("MANUAL · Coldloop")
        assert not trend_of_level(site)["planned"]
        view(operated, "trends")
        eventually(lambda: "mode manual" in operated.inner_text("#trend-legend"), "its colour has a name")
        assert "expected" not in operated.inner_text("#trend-legend")
    finally:
        view(operated, "commands")
        operated.click("[data-mode=auto]")
        confirm(operated)
    eventually(lambda: mode(site) == MPC, "MPC drives again")
    eventually(lambda: operated.locator("#tau-u.stale").count() == 0, "it is current again")


PLACES = """() => JSON.stringify([...document.querySelectorAll("#trends .toolbar, #charts .chart, #trend-legend")]
  .map((one) => one.getBoundingClientRect()))"""


def test_nothing_moves_by_hovering_and_a_click_finds_the_update(page: "Page", site: Site) -> None:
    eventually(lambda: len(site.ask("/api/trend?names=L1").document["updates"]["time"]) > 2, "updates")
    view(page, "trends")
    page.click("#hold")
    page.wait_for_selector("#chart-tau canvas")
    before, box = page.evaluate(PLACES), page.locator("#chart-tau .u-over").bounding_box()
    assert box is not None
    for share in (0.2, 0.5, 0.79):
        page.mouse.move(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
        eventually(lambda: page.inner_text("#readout"), "values at the cursor")
        assert page.evaluate(PLACES) == before
    page.mouse.click(box["x"] + 0.79 * box["width"], box["y"] + box["height"] / 2)
    page.wait_for_selector("#why:visible")


def test_a_value_of_the_drawing_opens_its_trend_with_what_belongs_to_it(page: "Page") -> None:
    page.focus("#overview .tag[data-name=CV156]")
    page.keyboard.press("Enter")
    eventually(lambda: "operator's setpoint" in page.inner_text("#point-facts"), "setpoint and output")
    page.wait_for_selector("#point-chart canvas")
    page.click("#point-close")
    page.click("#overview .bar[data-name=T5]")
    eventually(lambda: "output of its loop, CV156" in page.inner_text("#point-facts"), "band and loop")
    page.click("#point-close")


def test_why_shows_the_trajectory_that_was_predicted_for_the_update(page: "Page", site: Site) -> None:
    eventually(lambda: mode(site) == MPC, "MPC drives")
    view(page, "why")
    eventually(lambda: page.locator("#why-charts .chart[data-ahead=true]").count() == 2, "both outputs")


@pytest.fixture
def held(operated: "Page") -> "Iterator[list[Route]]":
    """Requests to prepare a command, held until somebody lets them go."""
    routes: list[Route] = []
    operated.route("**/api/commands", lambda route: routes.append(route))  # noqa: PLW0108 no builtin
    yield routes
    operated.unroute("**/api/commands")


def test_a_second_command_waits_with_a_word_until_the_first_is_over(operated: "Page", held: "list[Route]") -> None:
    operated.click("button:has-text('Pause')")
    operated.fill("#load-number", "444")
    operated.click("#load-set")
    operated.click("#load-set")
    eventually(lambda: "load: waits until the command before it is over" in outcome(operated), "it says so")
    for text in ("Pause plant time", "444"):
        eventually(lambda: operated.evaluate("1") and held, "it is prepared")
        held.pop().continue_()
        operated.wait_for_selector("#confirm[open]")
        assert text in operated.inner_text("#confirm-text")
        operated.click("#confirm-no")
        operated.wait_for_selector("#confirm[open]", state="detached")
    operated.wait_for_selector("body:not(.commanding)")
    assert not held, "the same one again is none"


def test_every_signal_of_the_trends_can_be_a_pen(page: "Page") -> None:
    view(page, "trends")
    page.wait_for_selector("#chart-L1")
    offered = set(page.eval_on_selector_all("#pen-add option", "all => all.map((one) => one.value)")) - {""}
    assert offered | {"L1", "T5", "load", "CV155", "CV156", "NCR22_A"} == set(TrendStore(COLD_BOX, 1).names)
    page.select_option("#pen-add", "T4")
    page.wait_for_selector("#chart-pen-T4")
    assert "T4 K" in page.inner_text("#chart-pen-T4 .title")
    page.click("button[aria-label='Remove T4']")
    page.wait_for_selector("#chart-pen-T4", state="detached")


def test_a_small_screen_shows_the_whole_drawing(browser: "Browser", site: Site) -> None:
    with opened(browser, site.address, viewport={"width": 1024, "height": 600}) as page:
        view(page, "overview")
        box = page.locator("#mimic svg").bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 1024
        lines = page.locator("#alarm-line").bounding_box()
        assert lines is not None
        assert box["y"] + box["height"] <= lines["y"]
        log_in_by_clicks(page)
        page.evaluate("document.querySelector('#drive-chip .value').textContent = 'REST OF A SEQUENCE'")
        assert page.evaluate(
            "(({ scrollWidth, clientWidth }) => scrollWidth <= clientWidth)(document.querySelector('.status'))"
        )


def test_a_replay_begins_at_its_beginning_and_knows_since_when_and_which_alarms(
    processes: Processes, recorded_run: Path
) -> None:
    served = Served(processes, recorded_run)
    assert served.ask("/api/replay")["tick"] == 0
    served.ask("/api/replay", {"tick": 4 * RECORDED_S - 1})
    state = served.ask("/api/state")
    events = served.ask("/api/events?service=control_plc")["events"]
    changes = [event["tick"] for event in events if event["kind"] == "mode"]
    assert state["values"]["control_plc.ladder.since"] == max(changes, default=0)
    raised = {event["subject"] for event in events if event["kind"] == "alarm raised"}
    assert {alarm["name"] for alarm in state["alarms"] if alarm["times"]} == raised
