"""What the overview shows is what is in the registers, and what is not current is crossed out."""

import re
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES
from tests.harness.waiting import eventually
from tests.hmi.conftest import SERVICES, Site, Witness

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

TICKS = 60
SHOWN = ("load", *(f"u.{name}" for name in INPUT_NAMES), *(f"y.{name}" for name in OUTPUT_NAMES))
COLLECT = """() => {
  window.seen = {};
  const look = () => {
    const values = {};
    for (const one of document.querySelectorAll("#overview .tag[data-signal], #overview .bar[data-signal]"))
      values[`${one.tagName} ${one.dataset.signal}`] = one.querySelector(".reading").textContent;
    window.seen[document.body.dataset.tick] = values;
  };
  new MutationObserver(look).observe(document.body, { attributes: true, attributeFilter: ["data-tick"] });
}"""


def test_every_number_of_the_overview_is_that_of_an_independent_reading_of_the_same_tick(
    page: "Page", site: Site
) -> None:
    with Witness(site.ports["control_plc"]) as witness:
        page.evaluate(COLLECT)

        def seen_by_both() -> dict[int, dict[str, str]]:
            """Return what was shown of the ticks that were read, when there are enough."""
            shown = {int(tick): values for tick, values in page.evaluate("window.seen").items()}
            both = {tick: shown[tick] for tick in sorted(set(shown) & set(witness.seen))}
            return both if len(both) >= TICKS else {}

        shown = eventually(seen_by_both, f"{TICKS} ticks")
    compared = 0
    for tick in shown:
        registers = dict(zip(SHOWN, witness.seen[tick], strict=True))
        for name, text in shown[tick].items():
            value = registers[name.partition("control_plc.process.")[2]]
            number, _, unit = text.partition(" ")
            step = 10.0 ** -len(number.partition(".")[2])
            assert abs(float(number) - value) <= 0.501 * step + 1e-6 * abs(value), (tick, name, text, value)
            assert unit
            compared += 1
    assert compared >= TICKS * (1 + len(INPUT_NAMES) + len(OUTPUT_NAMES)), "every output, input and the load"


def tick_of(page: "Page") -> int:
    return int(page.get_attribute("body", "data-tick") or 0)


def crossed_out(page: "Page", prefix: str) -> bool:
    """Tell whether every value of a service in the overview is crossed out, if there is any."""
    return bool(
        page.evaluate(
            """(prefix) => {
              const shown = "#overview [data-signal], header [data-signal], #overview .reading";
              const own = [...document.querySelectorAll(shown)]
                .map((one) => [one, one.dataset.signal || one.closest("[data-signal]").dataset.signal])
                .filter(([one, name]) => name.startsWith(prefix) && !one.classList.contains("bar"));
              return own.length > 0 && own.every(([one]) => one.closest(".stale"));
            }""",
            prefix,
        )
    )


@pytest.mark.parametrize(
    ("how", "service"), [("killed", "control_plc"), *(("frozen", service) for service in SERVICES[:3])]
)
def test_values_of_a_service_that_is_dead_or_frozen_are_crossed_out_and_come_back(
    page: "Page", site: Site, service: str, how: str, record_property: Callable[[str, object], None]
) -> None:
    eventually(lambda: not crossed_out(page, f"{service}."), "values are current")
    (site.kill if how == "killed" else site.freeze)(service)
    begun = time.monotonic()
    try:
        eventually(lambda: crossed_out(page, f"{service}."), f"values of the {service} are crossed out")
        record_property("crossed_out_after_s", round(time.monotonic() - begun, 2))
        eventually(lambda: service in (page.text_content("#banner") or ""), "the banner names it")
        lamp = f"[data-service={service}]"
        eventually(lambda: "dead" in (page.get_attribute(lamp, "class") or ""), "its lamp is out")
    finally:
        (site.start if how == "killed" else site.thaw)(service)
    eventually(lambda: page.is_hidden("#banner"), "the banner goes")
    eventually(lambda: not crossed_out(page, f"{service}."), "values come back")


def test_when_the_page_itself_is_killed_the_browser_says_so_and_comes_back(page: "Page", site: Site) -> None:
    site.kill("hmi")
    eventually(lambda: all(crossed_out(page, f"{service}.") for service in SERVICES[:3]), "everything is crossed out")
    eventually(lambda: "own server" in (page.text_content("#banner") or ""), "it says that its server is gone")
    before = tick_of(page)
    site.start("hmi")
    eventually(lambda: tick_of(page) > before, "ticks go on")
    eventually(lambda: page.is_hidden("#banner"), "the banner goes")


def test_a_stream_on_which_nothing_comes_is_given_up_for_another(page: "Page", site: Site) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    try:
        site.freeze("hmi")
        eventually(lambda: page.is_visible("body") and any("/api/stream" in url for url in asked), "another stream")
    finally:
        site.thaw("hmi")
    eventually(lambda: page.is_hidden("#banner"), "the banner goes")


def test_a_server_that_stands_still_while_its_page_is_loading_is_told_from_one_that_answers(
    page: "Page", site: Site
) -> None:
    def answer_and_stand_still(route: "Route") -> None:
        answer = route.fetch()
        site.freeze("hmi")
        route.fulfill(response=answer)

    page.route("**/mimic*.svg", answer_and_stand_still)  # the last thing that is asked for before values are shown
    try:
        page.reload()
        eventually(lambda: "own server" in (page.text_content("#banner") or ""), "it says that its server is silent")
    finally:
        site.thaw("hmi")
    eventually(lambda: page.is_hidden("#banner"), "the banner goes")


def test_the_alarm_line_is_on_every_view(page: "Page") -> None:
    for view in ("overview", "trends", "why", "alarms", "commands", "detail"):
        page.click(f"nav a[href='#{view}']")
        page.wait_for_selector(f"#{view}", state="visible")
        assert page.is_visible("#alarm-line")


def test_a_register_of_every_block_is_in_the_detail_view(page: "Page") -> None:
    page.click("nav a[href='#detail']")
    page.fill("#detail-search", "magic")
    assert page.locator("#detail tr:visible").count() == 3
    texts = [page.locator("#detail tr:visible td.value").nth(place).text_content() for place in range(3)]
    assert all(re.fullmatch(r"123\.456", text) for text in texts)


DASH = "\N{EN DASH}"
NOT_FINITE = """async () => {
  const page = document.querySelector("script[type=module]").src;
  const { state, take } = await import(page.replace("page.js", "store.js"));
  const update = { ...state.update.update, j_effective: null, j_delivered: null, load_mismatch: null, gamma: null };
  take({ ...state, values: {}, whole: false, update: { ...state.update, update } });
  return new Promise((shown) => requestAnimationFrame(() => shown(
    ["tau-u-q", "load-facts"].map((id) => document.getElementById(id).textContent))));
}"""


def test_an_update_without_an_answer_has_dashes(page: "Page") -> None:
    eventually(lambda: "J = " in (page.text_content("#tau-u-q") or ""), "an update is shown")
    cost, facts = page.evaluate(NOT_FINITE)
    assert cost.endswith(f"J = {DASH}")
    assert f"estimated mismatch{DASH}" in facts
