"""An operator of the quadruple tank: the page, commands and alarms are those of its process, not of a cold box.

The rig and each command are programs of their own; what they did is read with nothing but a socket.
"""

import re
import struct
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import pytest

from coldloop.errors import printable
from tests.harness.processes import PROGRAM_S, Ended, Processes
from tests.harness.waiting import eventually
from tests.hmi.conftest import log_in_by_clicks, opened, read_registers
from tests.hmi.test_operating import MANUAL, MPC, confirm, view

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

TANK: Final = Path(__file__).parents[2] / "examples" / "processes" / "quadruple_tank.toml"
FACTOR: Final = 4
LADDER, PROCESS, LOAD_STATUS = 50, 100, 420
VIEWS: Final = ("overview", "trends", "why", "alarms", "commands", "detail")
FILLED: Final = ("rect[data-fill]", ".vessel-wall[width='140']")
"""What is filled in a lower tank, and the tank."""
OF_THE_COLD_BOX: Final = re.compile(r"CV15[56]|NCR22|\b[TP]\d\b|\bL1\b|\b[Ww]atts|\d W\b|bath|nitrogen|turbine|heat")


class Tank(NamedTuple):
    """A rig of the quadruple tank that is up, with its page."""

    processes: Processes
    model: Path
    base: int
    address: str
    password: str

    def coldloop(self, *words: object, process: bool = True) -> Ended:
        """Run a command to its end; its output is one text."""
        which = ("--process", self.model) if process else ()
        command = words if words[0] == "registers" else (*words, "--port-base", self.base)
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return self.processes.coldloop(*which, *command, **pipes).ended(PROGRAM_S)

    @property
    def mode(self) -> int:
        return int(struct.unpack(">H", read_registers(self.base + 1, LADDER, 1))[0])

    @property
    def load(self) -> float:
        return float(struct.unpack(">f", read_registers(self.base, LOAD_STATUS, 2))[0])

    @property
    def levels(self) -> tuple[float, float]:
        """Both levels, cm: after the tick, the load and two inputs."""
        return struct.unpack(">ff", read_registers(self.base + 1, PROCESS + 8, 4))


@pytest.fixture(scope="module")
def tank(
    shared_processes: Processes,
    tmp_path_factory: pytest.TempPathFactory,
    realtime: None,  # noqa: ARG001 a mark
) -> Iterator[Tank]:
    folder = tmp_path_factory.mktemp("tank")
    model, load = folder / "tank.json", folder / "load.csv"
    assert shared_processes.coldloop("process", TANK, "--out", model).popen.wait(PROGRAM_S) == 0
    load.write_text("time_s,load_w\n0,0\n", encoding="utf-8")
    base, page = shared_processes.three_ports(), shared_processes.free_port()
    settings = ("--set", "hmi.training=true", "--set", f"control_plc.power_up_s={PROGRAM_S:g}")
    words = ("up", "--port-base", base, "--page-port", page, "--factor", FACTOR, "--load", load, *settings)
    rig = shared_processes.coldloop("--process", model, *words, stdout=subprocess.PIPE)
    assert rig.popen.stdout is not None
    said = ""
    while "password" not in said:
        line = rig.popen.stdout.readline()
        assert line, rig.said
        said += line
    assert "read h2 (cm):" in said
    assert f"--process {model} --port-base {base}" in said
    password = re.search(r"password (\S+)", said)
    assert password is not None
    yield Tank(shared_processes, model, base, f"http://127.0.0.1:{page}", password[1])
    rig.interrupt()


@pytest.fixture
def page(browser: "Browser", tank: Tank) -> "Iterator[Page]":
    """The page with its operator, while MPC drives."""
    with opened(browser, tank.address) as one:
        log_in_by_clicks(one, ("operator", tank.password))
        eventually(lambda: tank.mode == MPC, "MPC drives")
        yield one


def reading(page: "Page", name: str) -> float:
    text = page.inner_text(f"#overview .bar[data-name='{name}'] .value")
    return float(text.split()[0])


def alarm(page: "Page", name: str, *words: str) -> Callable[[], bool]:
    """Return whether the row of an alarm has these words: in its state, or as its cause."""
    view(page, "alarms")
    row = page.locator(f"#alarm-table tr[data-alarm='{name}']")
    return lambda: all(word in row.inner_text() for word in words)


def test_the_page_has_the_signals_of_the_process_and_nothing_of_a_cold_box(page: "Page", tank: Tank) -> None:
    bars = page.locator("#overview .bar")
    assert [bars.nth(i).get_attribute("data-name") for i in range(bars.count())] == ["h1", "h2", "v1", "v2", "load"]
    ends = page.locator("#overview .bar .ends").all_inner_texts()
    # a band of 12 to 12.6 and 1.5 of it on each side; 0 V to 10 V and an eighth of it; what the load may be
    assert [text.split() for text in ends] == [
        ["11.1", "13.5"], ["11.6", "14"], ["-1.25", "11.25"], ["-1.25", "11.25"], ["-2", "2"]
    ]  # fmt: skip
    for name, level in zip(("h1", "h2"), tank.levels, strict=True):
        assert reading(page, name) == pytest.approx(level, abs=0.02)
    view(page, "trends")
    page.wait_for_selector("#chart-cost canvas")
    titles = [text.strip() for text in page.locator("#charts .title").all_inner_texts()]
    assert titles[:4] == ["h1 cm", "h2 cm", "v1v2 (V)", "load cm3/s"]
    for each in VIEWS:
        view(page, each)
        found = OF_THE_COLD_BOX.search(page.inner_text(f"#{each}"))
        assert found is None, f"{each}: {found}"


def test_the_drawing_of_the_process_file_shows_its_signals(page: "Page", tank: Tank) -> None:
    view(page, "overview")
    drawing = page.locator("#mimic svg")
    assert drawing.locator(".tag").count() == 4
    assert drawing.locator(".tag .name").all_text_contents() == ["h1", "h2", "v1", "v2"]
    shown = float((drawing.locator(".tag .reading").first.text_content() or "").split()[0])
    assert shown == pytest.approx(tank.levels[0], abs=0.02)
    assert drawing.locator("text[data-signal='control_plc.process.load']").text_content() == "0.000 cm3/s"
    filled, whole = (float(drawing.locator(one).first.get_attribute("height") or 0.0) for one in FILLED)
    assert filled / whole == pytest.approx(tank.levels[0] / 20.0, abs=0.01), "the rectangle is full at 20 cm"


def test_an_operator_drives_a_level_out_of_its_band_and_mpc_brings_it_back(page: "Page", tank: Tank) -> None:
    view(page, "commands")
    page.click("button:has-text('Manual')")
    assert "applied" in confirm(page)
    eventually(lambda: tank.mode == MANUAL, "manual drives")
    page.fill("#setpoint-v1", "11")
    page.click(".faceplate:has-text('v1') button")
    refused = "refused because v1 = 11 V is not from 0 to 10 V"
    eventually(lambda: refused in page.inner_text("#outcome-line"), "it is refused before it is asked about")
    page.fill("#setpoint-v1", "4")
    page.click(".faceplate:has-text('v1') button")
    before = re.search(r"setpoint of v1 4 V \(was ([0-9.]+) V\)", confirm(page))
    assert before
    assert float(before[1]) == pytest.approx(3.0, abs=1e-3)
    eventually(alarm(page, "h1 outside its band", "unacknowledged"), "more voltage raises the level above its band")
    assert tank.levels[0] > 12.6
    view(page, "commands")
    page.click("button:has-text('Automatic')")
    assert "applied" in confirm(page)
    eventually(lambda: 12.0 < tank.levels[0] < 12.6, "MPC brings it back")
    eventually(alarm(page, "h1 outside its band", "returned unacknowledged"), "the alarm has returned")
    page.click("#alarm-line button")
    eventually(alarm(page, "h1 outside its band", "normal"), "it is acknowledged")
    events = tank.coldloop("events", "--kind", "alarm-raised,setpoint").out
    assert "setpoint: v1, 4 V" in events
    assert "alarm raised: h1 outside its band" in events


def test_a_load_has_its_own_name_and_unit(page: "Page", tank: Tank) -> None:
    view(page, "commands")
    page.fill("#load-number", "1.5")
    page.click("#load-set")
    eventually(lambda: page.is_visible("#confirm"), "the page asks to confirm")
    assert "Change the leak to 1.5 cm3/s from the next tick on" in page.inner_text("#confirm")
    assert "load 1.5 cm3/s now (was 0 cm3/s)" in confirm(page)
    assert tank.load == 1.5
    assert tank.coldloop("set", "load", "0").out == "load 0 cm3/s now (was 1.5 cm3/s)\n"
    assert tank.load == 0.0
    assert "live load: from one tick on, 1.5 cm3/s" in tank.coldloop("events", "--service", "plant").out


def test_a_frozen_level_is_found_among_two_and_crossed_out(page: "Page", tank: Tank) -> None:
    tank.coldloop("set", "load", "2")  # the other level and the inputs move
    assert tank.coldloop("fault", "sensor", "h1", "stuck").out == "sensor of h1: frozen\n"
    eventually(alarm(page, "sensor bad", "active", "h1"), "h1 rests while h2 moves")
    view(page, "overview")
    page.wait_for_selector("#overview .bar[data-name='h1'] .value.stale")
    assert page.locator("#overview .bar[data-name='h2'] .value.stale").count() == 0
    assert tank.coldloop("fault", "sensor", "h1", "none").out == "sensor of h1: none\n"
    tank.coldloop("set", "load", "0")
    page.wait_for_selector("#overview .bar[data-name='h1'] .value:not(.stale)")


def test_without_the_optimiser_the_ladder_acts_and_the_page_tells(page: "Page", tank: Tank) -> None:
    assert "killed the optimizer_plc" in tank.coldloop("fault", "kill", "optimizer_plc").out
    eventually(lambda: tank.mode != MPC, "the ladder leaves MPC")
    eventually(alarm(page, "optimizer lost", "unacknowledged"), "the page tells")
    eventually(lambda: tank.mode == MPC, "the one that is started again drives")


def test_commands_tell_the_process_in_words(tank: Tank) -> None:
    status = tank.coldloop("status").out
    assert re.search(r"^h1 +\d+\.\d{3} cm$", status, re.MULTILINE)
    assert re.search(r"^load +0 cm3/s$", status, re.MULTILINE)
    for words, why in (
        (("set", "setpoint", "cv155", "40"), "choose from 'v1', 'v2'"),
        (("set", "load", "absent.csv"), "neither cm3/s nor a file"),
        (("set", "acknowledge", "t5-band"), "h1-outside-its-band, h2-outside-its-band"),
        (("fault", "sensor", "T5", "dead"), "T5"),
    ):
        code, _, complaint = tank.coldloop(*words)
        assert (code, len(complaint.splitlines())) == (2, 1), complaint
        assert why in printable(complaint)
    code, _, complaint = tank.coldloop("status", process=False)
    assert code == 1
    assert "of the same process" in complaint
    tags = tank.coldloop("registers", "--format", "telegraf").out
    assert 'name = "alarms_h2_outside_its_band_state"' in tags
    assert "station" not in tags
