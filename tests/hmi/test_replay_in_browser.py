"""A recorded run on the page, in a browser; two side by side."""

from pathlib import Path
from typing import TYPE_CHECKING

from tests.harness.waiting import PATIENCE_S, eventually
from tests.hmi.conftest import Served, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from tests.harness.processes import Processes


def test_a_replay_looks_like_a_rig_and_has_a_bar_of_its_own(browser: "Browser", served: Served) -> None:
    with opened(browser, served.address) as page:
        assert page.inner_text("#replay-name") == "a run"
        assert page.locator("nav a[href='#commands']").is_hidden()
        page.select_option("#replay-speed", "100")
        served.ask("/api/replay", {"tick": 0})
        page.click("#replay-play")
        eventually(lambda: int(page.get_attribute("body", "data-tick") or 0) > 100, "it plays")


def test_two_runs_are_replayed_side_by_side(browser: "Browser", processes: "Processes", recorded_run: Path) -> None:
    both = Served(processes, recorded_run, recorded_run)
    try:
        page = browser.new_page()
        page.set_default_timeout(1000 * PATIENCE_S)
        page.goto(both.address + "/")
        frames = [page.frame_locator(f"#run-{number}") for number in (1, 2)]
        for frame in frames:
            frame.locator("body[data-tick]").wait_for()
        page.click("#play")
        eventually(lambda: both.ask("/run/2/api/replay")["tick"] > 0, "both play")
        page.select_option("#view", "trends")
        for frame in frames:
            frame.locator("#trends").wait_for(state="visible")
        page.close()
    finally:
        both.end()
