"""What if I click this twice; what if the link dies between the two steps; what if two of us operate: in a browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.harness.waiting import eventually
from tests.hmi.conftest import OPERATOR, Site, log_in_by_clicks, opened
from tests.hmi.test_operating import MPC, SENSOR_BAD, alarm_state, confirm, load, mode, view

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route


@pytest.fixture
def operated(page: "Page", site: Site) -> "Page":
    log_in_by_clicks(page)
    eventually(lambda: mode(site) == MPC, "MPC drives")
    view(page, "commands")
    eventually(lambda: page.input_value("#load-number") != "385", "the fields follow")
    return page


@pytest.fixture
def second(browser: "Browser", site: Site) -> "Iterator[Page]":
    """Another operator, in a browser of their own."""
    with opened(browser, site.address) as page:
        log_in_by_clicks(page)
        yield page


def outcome(page: "Page") -> str:
    return page.text_content("#outcome-line") or ""


def asked_twice(page: "Page", watts: str) -> None:
    page.fill("#load-number", watts)
    page.click("#load-set")
    page.wait_for_selector("#confirm[open]")


def test_a_double_click_on_a_command_asks_once_and_does_nothing_by_itself(operated: "Page", site: Site) -> None:
    before = load(site)
    operated.fill("#load-number", "444")
    operated.dblclick("#load-set")
    operated.wait_for_selector("#confirm[open]")
    operated.click("#confirm-no")
    operated.wait_for_selector("#confirm[open]", state="detached")
    operated.wait_for_selector("body:not(.commanding)")
    assert operated.locator("#confirm[open]").count() == 0, "it was asked once"
    assert load(site) == before


def test_enter_that_is_held_down_confirms_nothing(operated: "Page", site: Site) -> None:
    before = load(site)
    operated.fill("#load-number", "444")
    operated.focus("#load-set")
    for _ in range(8):
        operated.keyboard.press("Enter")

    def is_given_up() -> bool:
        operated.keyboard.press("Escape")
        return operated.locator("body.commanding").count() == 0

    eventually(is_given_up, "no command is under way")
    assert load(site) == before


def test_a_double_click_on_confirm_does_it_once_and_reaches_nothing_behind(operated: "Page", site: Site) -> None:
    sent: list[str] = []
    operated.on("request", lambda one: sent.append(one.url) if one.method == "POST" else None)
    asked_twice(operated, "433")
    operated.dblclick("#confirm-yes")
    eventually(lambda: "applied: load 433 W" in outcome(operated), "it is applied")
    assert len(sent) == 2, "prepared once, confirmed once"
    assert load(site) == 433.0


def test_a_field_that_nobody_has_touched_asks_for_what_there_is(operated: "Page", site: Site) -> None:
    eventually(lambda: abs(float(operated.input_value("#load-number")) - load(site)) < 0.1, "it shows the load")
    operated.click("#load-set")
    operated.wait_for_selector("#confirm[open]")
    assert f"{load(site):g} W" in (operated.text_content("#confirm-text") or "")
    operated.click("#confirm-no")


def test_a_service_that_dies_between_the_two_steps_has_not_taken_the_command(operated: "Page", site: Site) -> None:
    operated.click("button:has-text('Classical loops')")
    operated.wait_for_selector("#confirm[open]")
    site.kill("control_plc")
    try:
        operated.click("#confirm-yes")
        eventually(lambda: "refused because" in outcome(operated), "it is told")
        assert "uncertain" not in (operated.get_attribute("#outcome-line", "class") or "")
        eventually(lambda: not site.is_live("control_plc"), "the page knows that it is gone")
    finally:
        site.start("control_plc")
    eventually(site.is_live, "all services answer the page")
    eventually(lambda: mode(site) == MPC, "MPC drives as before")


def test_a_plant_that_freezes_while_it_is_written_to_is_not_told_as_what_it_has_not_done(
    operated: "Page", site: Site
) -> None:
    asked_twice(operated, "437")

    def freeze(route: "Route") -> None:
        route.continue_()
        site.freeze("plant")

    operated.route("**/api/commands/*", freeze)
    try:
        operated.click("#confirm-yes")
        eventually(lambda: outcome(operated).count("437") > 0, "it is told")
    finally:
        site.thaw("plant")
    told = outcome(operated)
    assert any(word in told for word in ("applied: load 437 W", "UNCERTAIN", "refused because")), told
    if "applied" in told:
        assert load(site) == 437.0
    if "refused" in told:
        assert load(site) != 437.0


def test_the_page_that_dies_between_the_two_steps_says_that_nobody_knows(operated: "Page", site: Site) -> None:
    before = load(site)
    asked_twice(operated, "438")
    site.kill("hmi")
    try:
        operated.click("#confirm-yes")
        eventually(lambda: "UNCERTAIN: the page's own server did not answer" in outcome(operated), "it is told")
    finally:
        site.start("hmi")
    eventually(site.is_live, "the page answers")
    assert load(site) == before


def test_a_confirmation_is_asked_anew_when_somebody_else_came_between(
    operated: "Page", second: "Page", site: Site
) -> None:
    asked_twice(operated, "444")
    view(second, "commands")
    asked_twice(second, "446")
    assert "446 W" in confirm(second)
    operated.click("#confirm-yes")
    eventually(lambda: "now 446 W" in (operated.text_content("#confirm-changed") or ""), "it says what has changed")
    assert operated.is_visible("#confirm")
    assert load(site) == 446.0
    assert operated.text_content("#confirm-now") == "Now: heat load 446 W."
    operated.click("#confirm-no")
    operated.reload()
    eventually(lambda: "446 W" in operated.inner_text("#last-command"), "the log is the server's")
    assert f"Last command: {OPERATOR[0]}" in operated.inner_text("#last-command")


def test_enter_in_a_field_prepares_and_never_confirms(operated: "Page", site: Site) -> None:
    before = load(site)
    operated.fill("#load-number", "447")
    operated.keyboard.press("Enter")
    operated.wait_for_selector("#confirm[open]")
    operated.keyboard.press("Enter")
    operated.wait_for_selector("#confirm[open]", state="detached")
    eventually(lambda: "not confirmed" in outcome(operated), "a second Enter cancels")
    assert load(site) == before


def test_manual_that_somebody_else_has_ended_takes_no_setpoint(operated: "Page", second: "Page", site: Site) -> None:
    operated.click("button:has-text('Manual')")
    assert "applied" in confirm(operated)
    operated.fill("#setpoint-CV155", "41")
    operated.click(".faceplate:has-text('CV155') button")
    operated.wait_for_selector("#confirm[open]")
    view(second, "commands")
    second.click("button:has-text('Automatic')")
    confirm(second)
    operated.click("#confirm-yes")
    eventually(lambda: "take over in manual first" in outcome(operated), "it is refused, and why")
    eventually(lambda: mode(site) == MPC, "MPC drives")


def test_an_alarm_that_somebody_else_has_put_out_of_service_is_not_told_as_shelved(
    operated: "Page", second: "Page"
) -> None:
    row = "#alarm-table tr[data-alarm='clock skew']"
    for one in (operated, second):
        view(one, "alarms")
    operated.click(f"{row} button:text-is('Shelve')")
    operated.wait_for_selector("#confirm[open]")
    second.click(f"{row} button:text-is('Out of service')")
    confirm(second)
    operated.click("#confirm-yes")
    eventually(lambda: "the control PLC did not take it" in outcome(operated), "it is refused")
    second.click(f"{row} button:text-is('In service')")
    confirm(second)


def test_a_login_that_ends_between_the_two_steps_is_told_and_nothing_is_done(operated: "Page", site: Site) -> None:
    before = load(site)
    asked_twice(operated, "439")
    operated.context.clear_cookies()
    operated.click("#confirm-yes")
    eventually(lambda: "log in first" in outcome(operated), "it is told")
    assert load(site) == before


def test_a_file_that_cannot_be_read_any_more_and_no_file_are_told(operated: "Page", tmp_path: Path) -> None:
    operated.click("#load-play")
    eventually(lambda: "no file is chosen" in outcome(operated), "it is told")
    file = tmp_path / "a.csv"
    file.write_text("0,400\n", encoding="utf-8")
    operated.set_input_files("#load-file", file)
    file.unlink()
    operated.click("#load-play")
    eventually(lambda: "a.csv cannot be read any more" in outcome(operated), "it is told")


def test_a_load_file_at_a_high_factor_begins_in_time(operated: "Page", site: Site) -> None:
    try:
        operated.fill("#factor", "20")
        operated.click("#factor-set")
        assert "factor 20" in confirm(operated)
        content = "time_s,load_w\n0,401\n" + "".join(f"{600 + i},{402 + i % 2}\n" for i in range(60))
        operated.set_input_files("#load-file", {"name": "a.csv", "mimeType": "text/csv", "buffer": content.encode()})
        operated.click("#load-play")
        assert "last value is held: load of 61 steps" in confirm(operated)
        eventually(lambda: load(site) in {401.0, 402.0, 403.0}, "the load follows")
    finally:
        cookie = site.log_in()
        token = site.ask("/api/commands", {"kind": "factor", "factor": 2.0}, cookie=cookie).document["token"]
        assert site.ask(f"/api/commands/{token}", {}, cookie=cookie).document["applied"]
    eventually(lambda: mode(site) == MPC, "MPC drives")


# -- what is shown -----------------------------------------------------------------------------------------------------


def test_what_came_of_a_command_covers_nothing(operated: "Page") -> None:
    operated.click(".faceplate:has-text('CV155') button")
    operated.fill("#setpoint-CV155", "999")
    operated.click(".faceplate:has-text('CV155') button")
    operated.wait_for_selector("#outcome-line.refused")
    for width, height in ((1280, 720), (390, 844)):
        operated.set_viewport_size({"width": width, "height": height})
        for name in ("overview", "alarms", "commands"):
            view(operated, name)
            overlaps = operated.evaluate(OVERLAPS)
            assert not overlaps, (name, width)


OVERLAPS = """() => {
  const place = (one) => document.querySelector(one).getBoundingClientRect();
  const main = place("main"), line = place("#outcome-line"), foot = place("footer");
  return main.bottom > line.top + 1 || line.bottom > foot.top + 1;
}"""


def test_tables_are_not_wider_than_a_phone(operated: "Page") -> None:
    operated.set_viewport_size({"width": 390, "height": 844})
    for name in ("alarms", "commands", "detail"):
        view(operated, name)
        if name == "detail":
            operated.fill("#detail-search", "e")
        assert operated.evaluate(WIDE) == [], name


def test_what_is_shown_above_does_not_move_the_links_of_a_phone_away_under_a_finger(page: "Page") -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    before, after = page.evaluate("""() => {
      const place = () => document.querySelector("nav a[href='#commands']").getBoundingClientRect().top;
      const before = place();
      for (const one of document.querySelectorAll(".status .value")) one.textContent = "as long as it ever gets";
      return [before, place()];
    }""")
    assert before == after


WIDE = """() => [...document.querySelectorAll("main .scroll, main details")].filter((one) => one.offsetParent)
  .filter((one) => one.scrollWidth > one.clientWidth + 1).map((one) => one.innerText.slice(0, 40))"""


def test_the_updating_period_is_crossed_out_when_the_control_plc_is_silent(page: "Page", site: Site) -> None:
    eventually(lambda: page.locator("#tau-u.stale").count() == 0, "it is current")
    site.freeze("control_plc")
    try:
        for name in ("#tau-u", "#tau-u-q", "#tau-u-sentence"):
            eventually(lambda: page.locator(f"{name}.stale").count() == 1, f"{name} is crossed out")  # noqa: B023
    finally:
        site.thaw("control_plc")
    eventually(lambda: page.locator("#tau-u.stale").count() == 0, "it is current again")


def test_a_substituted_value_is_no_line_like_others(operated: "Page", site: Site) -> None:
    operated.select_option("#fault-output", "T5")
    operated.select_option("#fault-kind", "1")
    operated.click("#fault-set")
    confirm(operated)
    eventually(lambda: alarm_state(site, SENSOR_BAD) == 1, "the alarm is raised")
    try:
        asked = "() => fetch('api/trend?names=T5&seconds=60').then((a) => a.json()).then((a) => a.doubtful.T5 || [])"
        eventually(lambda: operated.evaluate(asked), "the trend says it")
        view(operated, "overview")
        for kind in ("tag", "bar"):
            at = f"#overview .{kind}[data-name=T5]"
            eventually(lambda: operated.locator(f"{at} .stale, {at}.stale").count(), f"{kind}: crossed out")  # noqa: B023
            now = f"{at}[data-quality=simulated], {at} [data-quality=simulated]"
            eventually(lambda: operated.locator(now).count(), f"{kind}: its quality")  # noqa: B023
        assert operated.text_content("#overview .tag[data-name=T5] .mark") == "S"
        view(operated, "trends")
        eventually(lambda: operated.evaluate(BLANK), "the line is interrupted")
    finally:
        view(operated, "commands")
        operated.select_option("#fault-kind", "0")
        operated.click("#fault-set")
        confirm(operated)
    eventually(lambda: alarm_state(site, SENSOR_BAD) == 3, "the condition ends")
    view(operated, "alarms")
    operated.click("#alarm-table tr[data-alarm='sensor bad'] button:has-text('Acknowledge')")


BLANK = "document.querySelector('#chart-T5')?.dataset.doubtful > 0"


def test_shelving_says_that_it_counts_plant_time(operated: "Page") -> None:
    view(operated, "alarms")
    assert "at factor 2, 15 min are over in 450 s" in operated.inner_text("#shelving-note")
    operated.click("#alarm-table tr[data-alarm='clock skew'] button:text-is('Shelve')")
    operated.wait_for_selector("#confirm[open]")
    assert "15 min of plant time, 7 min 30 s by the clock at factor 2" in (operated.text_content("#confirm-text") or "")
    operated.click("#confirm-no")
