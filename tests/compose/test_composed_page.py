"""The operator's page among the containers, of the whole refrigerator."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from tests.compose.browser import Browser, assert_an_operator_changes_the_load

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import ComposedRig


def test_an_operator_changes_the_load(refrigerator_rig: "ComposedRig") -> None:
    assert_an_operator_changes_the_load(refrigerator_rig.page)


def test_the_page_reaches_the_operators_network_only(refrigerator_rig: "ComposedRig") -> None:
    networks = refrigerator_rig.inspect("page")["NetworkSettings"]["Networks"]
    assert [name.rpartition("_")[2] for name in networks] == ["operators"]


def test_the_page_can_do_no_harm(refrigerator_rig: "ComposedRig") -> None:
    host = refrigerator_rig.inspect("page")["HostConfig"]
    assert (host["ReadonlyRootfs"], host["CapDrop"]) == (True, ["ALL"])
    assert [binding["HostIp"] for port in host["PortBindings"].values() for binding in port] == ["127.0.0.1"]
    probe = "import os; print(os.getuid(), os.access('/opt/coldloop', os.W_OK))"
    assert refrigerator_rig.inside("page", "python", "-c", probe) == "10001 False"
    probe = "from importlib.util import find_spec; print(any(map(find_spec, ['numba', 'scipy', 'pyarrow', 'pip'])))"
    assert refrigerator_rig.inside("page", "/opt/coldloop/bin/python", "-c", probe) == "False"


def test_the_user_of_the_project_is_for_one_machine(refrigerator_rig: "ComposedRig") -> None:
    assert "warning: the page's user is the one that comes with the project" in refrigerator_rig.compose("logs", "page")
    elsewhere = ("-e", "PUBLISHED_ON=0.0.0.0")
    started = refrigerator_rig.compose(
        "exec", "-T", *elsewhere, "page", "sh", "/opt/coldloop/entrypoint.sh", check=False
    )
    assert "error: the page's user is the one that comes with the project" in started


def test_the_page_shows_the_compression_station_and_the_nitrogen(refrigerator_rig: "ComposedRig") -> None:
    values = Browser(refrigerator_rig.page).values()
    assert any(name.startswith("plant.station") for name in values)


def test_the_refrigerator_in_lock_step_is_that_of_one_process(
    refrigerator_rig: "ComposedRig", coldloop: "Callable[..., None]", tmp_path: Path
) -> None:
    rig = refrigerator_rig
    endpoints = [f"127.0.0.1:{port}" for port in (rig.plant, rig.control_plc, rig.optimizer_plc)]
    scenario = ["--load", "a", "--duration", "20min"]
    coldloop("--attach", *endpoints, *scenario, "--out", str(tmp_path / "composed"))
    coldloop("--in-process", "--set", "plant.kind=refrigerator", *scenario, "--out", str(tmp_path / "one process"))
    composed, one_process = (
        json.loads((tmp_path / name / "summary.json").read_text()) for name in ("composed", "one process")
    )
    assert composed["ticks"] == 4 * 1200
    assert composed["trace_sha256"] == one_process["trace_sha256"]
