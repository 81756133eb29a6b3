"""The whole refrigerator on the page: its drawing, and values, alarms and limits of the station."""

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import pytest

from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES, STATION_SIGNAL_NAMES, STATION_VALVE_NAMES
from coldloop.registers.plant import StationAlarm, StationStatus
from coldloop_hmi.documents import plant_document, signals_of
from coldloop_hmi.guard import STATIC
from coldloop_hmi.process_image import Model
from tests.harness.records import MAPS
from tests.harness.waiting import eventually
from tests.hmi.conftest import Served, Site, opened, record, write_registers

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

    from tests.harness.processes import Processes

SURROUNDINGS = 760
SHOWN = [f"signals.{name}" for name in STATION_SIGNAL_NAMES] + [f"commands.{name}" for name in STATION_VALVE_NAMES]


@pytest.fixture(scope="module")
def refrigerator(start_site: Callable[..., Site]) -> Site:
    return start_site(kind="refrigerator")


@pytest.fixture
def page(browser: "Browser", refrigerator: Site) -> "Iterator[Page]":
    with opened(browser, refrigerator.address) as one:
        yield one


def give(site: Site, *, nc1: int) -> None:
    write_registers(site.ports["plant"], SURROUNDINGS, struct.pack(">HHHff", nc1, 1, 1, 0.0, 300.0))


def test_a_tripped_compressor_is_seen_on_the_drawing_and_in_the_alarm_line(page: "Page", refrigerator: Site) -> None:
    assert page.locator(".compressor.tripped").count() == 0
    assert page.text_content("#mimic text[data-station]") == "pressure control: automatic"
    give(refrigerator, nc1=0)
    try:
        eventually(lambda: page.locator(".compressor.tripped").count() == 1, "NC1 is marked")
        assert page.is_visible(".compressor.tripped .trip"), "by a word too, not by colour alone"
        eventually(lambda: "station: nc1 tripped" in page.inner_text("#alarm-line"), "the alarm line has it")
        low = "#mimic .tag[data-signal='plant.station.signals.P12'].abnormal"
        eventually(lambda: page.locator(low).count() == 1, "the high pressure leaves its band")
        page.click("nav a[href='#alarms']")
        assert "nc1 tripped" in page.inner_text("#station-note")
    finally:
        give(refrigerator, nc1=1)
    eventually(lambda: page.locator(".compressor.tripped").count() == 0, "it runs again")


def test_both_pressures_are_drawn_over_time(page: "Page", refrigerator: Site) -> None:
    trend = refrigerator.ask("/api/trend?names=P12,P11&seconds=20").document["series"]
    drawn = {name: [value for value in trend[name] if value is not None] for name in ("P12", "P11")}  # None is a gap
    assert all(5 < value < 20 for value in drawn["P12"][-10:]), "in bar, on the way back from the trip"
    assert all(0.8 < value < 2 for value in drawn["P11"][-10:])
    assert all(map(len, drawn.values()))
    page.click("nav a[href='#trends']")
    for name in ("P12", "P11", "L1", "cost"):
        page.wait_for_selector(f"#chart-{name} canvas")


def test_the_drawing_is_that_of_the_plant(browser: "Browser", site: Site, refrigerator: Site) -> None:
    for one, names in ((site, 0), (refrigerator, len(SHOWN))):
        with opened(browser, one.address) as page:
            assert page.locator("#mimic .tag[data-signal^='plant.station']").count() <= names
            assert (page.locator("#mimic .compressor").count() == 2) is (names > 0)
            assert page.locator("#mimic .tag[data-signal='control_plc.process.y.T5']").count() == 1


def test_a_recorded_refrigerator_is_replayed_with_its_station(
    browser: "Browser", processes: "Processes", tmp_path: Path
) -> None:
    folder = record(tmp_path / "cold and warm", "--duration", "60s", "--set", "plant.kind=refrigerator")
    served = Served(processes, folder)
    try:
        with opened(browser, served.address) as page:
            assert page.locator("#mimic .compressor").count() == 2
            pressures = served.ask("/api/trend?names=P12&seconds=60")["series"]["P12"]
            assert all(15 < value < 17 for value in pressures)
            readings = page.locator("#mimic .tag[data-signal='plant.station.signals.P12'] .reading")
            assert re.fullmatch(r"1[56]\.\d+ bar", readings.text_content() or "")
            asked = page.locator("#mimic .tag[data-signal='plant.station.commands.CV956'] .reading")
            assert asked.text_content() == "\u2013", "what its controller asked for is not recorded"
    finally:
        served.end()


# -- the parts, by themselves ------------------------------------------------------------------------------------------


def drawn(name: str) -> list[str]:
    return [one.get("data-signal", "") for one in ET.parse(STATIC / name).iter() if one.get("data-signal")]  # noqa: S314 our own


def test_every_tag_of_a_drawing_is_a_signal_and_drawn_once() -> None:
    signals = {signal.name for one in MAPS.values() for signal in signals_of(one)}
    for name in ("mimic.svg", "mimic-refrigerator.svg"):
        tags = drawn(name)
        assert set(tags) <= signals
        assert len(tags) == len(set(tags))
        assert {f"control_plc.process.y.{output}" for output in OUTPUT_NAMES} <= set(tags)


def test_the_refrigerator_shows_all_that_the_station_measures() -> None:
    measured = {f"plant.station.signals.{name}" for name in STATION_SIGNAL_NAMES if name != "CV167"}
    assert measured <= set(drawn("mimic-refrigerator.svg"))


def test_limits_and_words_are_those_of_the_plants_registers() -> None:
    model = Model(COLD_BOX, lambda: 0.0, 300)
    assert plant_document(model) == {"kind": ""}
    model.configuration = {
        "plant.kind": "refrigerator", "plant.station.alarms.hp_low_bar": 14.0, "plant.station.alarms.hp_high_bar": 17
    }  # fmt: skip
    model.put("plant", StationStatus(7, 3, StationAlarm.NC1_TRIPPED | StationAlarm.HP_LOW))
    told = plant_document(model)
    assert (told["mode"], told["alarms"]) == ("one compressor", ["hp low", "nc1 tripped"])
    assert told["bands"]["plant.station.signals.P12"] == [14.0, 17.0]
    assert told["bands"]["plant.station.signals.L_N2"] == [None, None]
