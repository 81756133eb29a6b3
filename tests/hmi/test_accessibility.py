"""Every view, dark and light, wide and narrow: axe-core finds nothing of any impact, nothing is cut off sideways."""

from typing import TYPE_CHECKING, Any

import pytest

from tests.harness.waiting import eventually
from tests.hmi.conftest import Site, log_in_by_clicks, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

VIEWS = ("overview", "trends", "why", "alarms", "commands", "detail")


def findings(page: "Page") -> list[dict[str, Any]]:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    found = axe.Axe().run(page).response["violations"]
    return [{"rule": one["id"], "nodes": [node["html"][:160] for node in one["nodes"][:3]]} for one in found]


WIDE, PHONE = (1280, 720), (390, 844)


@pytest.mark.parametrize(
    ("size", "scheme"),
    [
        pytest.param(WIDE, "light", id="wide-light"),
        pytest.param(PHONE, "dark", id="phone-dark"),
        pytest.param(WIDE, "dark", id="wide-dark", marks=pytest.mark.night),
        pytest.param(PHONE, "light", id="phone-light", marks=pytest.mark.night),
    ],
)
def test_no_view_has_a_finding(browser: "Browser", site: Site, scheme: str, size: tuple[int, int]) -> None:
    with opened(
        browser, site.address, viewport={"width": size[0], "height": size[1]}, color_scheme=scheme, bypass_csp=True
    ) as page:  # axe is put into the page from outside, which the policy forbids
        log_in_by_clicks(page)
        for view in VIEWS:
            page.click(f"nav a[href='#{view}']")
            eventually(lambda: page.is_visible(f"#{view}"), view)  # noqa: B023 called at once
            eventually(lambda: not findings(page), f"no finding in {view}")  # what is stale fades
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), (
                f"{view} is wider than the screen"
            )


def test_the_page_is_used_with_the_keyboard_alone(page: "Page") -> None:
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    for _ in range(3):
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    eventually(lambda: page.is_visible("#why"), "the third link leads to its view")
