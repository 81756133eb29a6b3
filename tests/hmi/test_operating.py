"""Commands by clicks alone; what they did is read from the registers."""

import struct
from typing import TYPE_CHECKING

import pytest

from tests.harness.waiting import eventually
from tests.hmi.conftest import OPERATOR, VIEWER, Site, log_in_by_clicks, read_registers

if TYPE_CHECKING:
    from playwright.sync_api import Page

LADDER, OPERATOR_BLOCK, ALARMS, ALARM_WORDS, LOAD = 50, 470, 2000, 11, 420
ACKNOWLEDGED, SHELVED, OUT_OF_SERVICE, NORMAL = 2, 4, 5, 0
MPC, MANUAL = 1, 4
SENSOR_BAD, ACCESS_REFUSED = 8, 11


def mode(site: Site) -> int:
    return int(struct.unpack(">H", read_registers(site.ports["control_plc"], LADDER, 1))[0])


def setpoints(site: Site) -> tuple[float, ...]:
    return struct.unpack(">Hfff", read_registers(site.ports["control_plc"], OPERATOR_BLOCK, 7))[1:]


def alarm_state(site: Site, alarm: int) -> int:
    return int(struct.unpack(">H", read_registers(site.ports["control_plc"], ALARMS + ALARM_WORDS * alarm, 1))[0])


def load(site: Site) -> float:
    return float(struct.unpack(">f", read_registers(site.ports["plant"], LOAD, 2))[0])


def view(page: "Page", name: str) -> None:
    page.click(f"nav a[href='#{name}']")
    page.wait_for_selector(f"#{name}", state="visible")


def confirm(page: "Page") -> str:
    """Confirm the command that is asked about; return what came of it."""
    eventually(lambda: page.is_visible("#confirm"), "the page asks to confirm")
    before = page.locator("#outcome-table tbody tr").count()
    page.click("#confirm-yes")
    eventually(lambda: page.locator("#outcome-table tbody tr").count() > before, "the outcome is shown")
    page.wait_for_selector("body:not(.commanding)")
    return page.locator("#outcome-table tbody tr").first.inner_text()


@pytest.fixture
def operated(page: "Page", site: Site) -> "Page":
    log_in_by_clicks(page)
    eventually(lambda: mode(site) == MPC, "MPC drives")
    return page


def test_manual_is_taken_without_a_bump_and_given_back(operated: "Page", site: Site) -> None:
    view(operated, "commands")
    operated.click("button:has-text('Manual')")
    assert "applied" in confirm(operated)
    eventually(lambda: mode(site) == MANUAL, "manual drives")
    taken = setpoints(site)
    applied = struct.unpack(">fff", read_registers(site.ports["control_plc"], 104, 6))
    assert taken == pytest.approx(applied, abs=1e-3), "nothing moves when manual is taken"
    target = round(taken[0] + 1.0, 1)
    operated.fill("#setpoint-CV155", str(target))
    operated.click(".faceplate:has-text('CV155') button")
    assert f"setpoint of CV155 {target:g} %" in confirm(operated)
    assert setpoints(site)[0] == pytest.approx(target)
    assert setpoints(site)[1:] == pytest.approx(taken[1:])
    operated.click("button:has-text('Automatic')")
    confirm(operated)
    eventually(lambda: mode(site) == MPC, "MPC drives again")
    assert site.audited()[-1]["who"] == OPERATOR[0]
    assert "Hand over to automatic" in site.audited()[-1]["detail"]


def test_a_refused_command_says_why(operated: "Page") -> None:
    view(operated, "commands")
    operated.fill("#setpoint-CV155", "45")
    operated.click(".faceplate:has-text('CV155') button")
    operated.wait_for_selector("#outcome-line.refused")
    assert "take over in manual first" in (operated.text_content("#outcome-line") or "")


def test_an_empty_field_is_not_a_zero(operated: "Page") -> None:
    view(operated, "commands")
    for field, button in (("load-number", "load-set"), ("factor", "factor-set")):
        operated.fill(f"#{field}", "")
        operated.click(f"#{button}")
        assert operated.evaluate("document.activeElement.id") == field, "nothing is asked for: a number is missing"


@pytest.mark.parametrize("width", [821, 1280])
def test_the_header_of_an_operator_fits(operated: "Page", width: int) -> None:
    operated.set_viewport_size({"width": width, "height": 720})
    fits = "document.documentElement.scrollWidth <= innerWidth"
    eventually(lambda: operated.evaluate(fits), "the header fits")  # the policy forbids wait_for_function
    assert operated.evaluate("document.querySelector('#logout').getBoundingClientRect().right") <= width


def test_the_load_slider_reaches_register_and_trend(operated: "Page", site: Site) -> None:
    view(operated, "commands")
    operated.locator("#load-slider").fill("431")
    operated.click("#load-set")
    assert "load 431 W" in confirm(operated)
    assert load(site) == 431.0
    newest = "() => fetch('api/trend?names=load&seconds=10').then((a) => a.json()).then((a) => a.series.load.at(-1))"
    eventually(lambda: operated.evaluate(newest) == 431.0, "the trend has the new load")
    view(operated, "trends")
    eventually(lambda: operated.get_attribute("#charts", "data-now") is not None, "the trends are drawn")


def test_alarms_are_acknowledged_shelved_and_put_out_of_service_by_clicks(operated: "Page", site: Site) -> None:
    view(operated, "commands")
    operated.select_option("#fault-output", "T3")
    operated.select_option("#fault-kind", "1")
    operated.click("#fault-set")
    assert "applied" in confirm(operated)
    eventually(lambda: alarm_state(site, SENSOR_BAD) == 1, "the alarm is raised")
    view(operated, "alarms")
    row = "#alarm-table tr[data-alarm='sensor bad']"
    operated.click(f"{row} button:has-text('Acknowledge')")
    eventually(lambda: alarm_state(site, SENSOR_BAD) == ACKNOWLEDGED, "it is acknowledged")
    for label, state in (
        ("Shelve", SHELVED),
        ("Unshelve", None),
        ("Out of service", OUT_OF_SERVICE),
        ("In service", None),
    ):
        operated.click(f"{row} button:text-is('{label}')")
        confirm(operated)
        eventually(lambda: alarm_state(site, SENSOR_BAD) == (1 if state is None else state), label)  # noqa: B023 called at once
        eventually(lambda: operated.locator(f"{row} button:text-is('{label}')").count() == 0, "the row follows")  # noqa: B023
    assert "sensor bad" in operated.inner_text("#alarm-line")
    view(operated, "commands")
    operated.select_option("#fault-kind", "0")
    operated.click("#fault-set")
    confirm(operated)
    eventually(lambda: alarm_state(site, SENSOR_BAD) == 3, "the condition ends")
    view(operated, "alarms")
    operated.click(f"{row} button:has-text('Acknowledge')")
    eventually(lambda: alarm_state(site, SENSOR_BAD) == NORMAL, "nothing is left")
    operated.fill("#event-search", "sensor bad")
    eventually(lambda: "alarm shelved" in operated.inner_text("#event-table"), "the history has it")


def test_time_is_paused_and_goes_on(operated: "Page", site: Site) -> None:
    view(operated, "commands")
    operated.click("button:text-is('Pause')")
    assert "paused" in confirm(operated)
    tick = operated.get_attribute("body", "data-tick")
    operated.click("button:text-is('Resume')")
    assert "running" in confirm(operated)
    eventually(lambda: operated.get_attribute("body", "data-tick") != tick, "time goes on")
    eventually(lambda: mode(site) == MPC, "MPC drives")


def test_who_may_only_look_has_no_buttons(page: "Page") -> None:
    log_in_by_clicks(page, VIEWER)
    view(page, "commands")
    assert page.is_disabled("button:has-text('Manual')")
    assert page.is_visible(".view-only")
    view(page, "alarms")
    assert page.locator("#alarm-table tbody button").count() == 0


def test_a_login_that_has_ended_is_told(operated: "Page") -> None:
    view(operated, "commands")
    with operated.expect_response("**/api/me"):  # it asks every 15 s, and shows no buttons without a login
        pass
    operated.context.clear_cookies()
    operated.click("button:text-is('Pause')")
    operated.wait_for_selector("#outcome-line.refused")
    assert "log in first" in (operated.text_content("#outcome-line") or "")
    eventually(lambda: operated.is_visible("#login-open"), "the page offers to log in")


def test_a_wrong_password_is_told_in_the_dialog(page: "Page") -> None:
    page.click("#login-open")
    page.fill("#login-user", OPERATOR[0])
    page.fill("#login-password", "not this one")
    page.click("#login-form button[type=submit]")
    eventually(lambda: "wrong name or password" in (page.text_content("#login-error") or ""), "the reason is shown")
