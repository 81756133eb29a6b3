"""`coldloop registers`, `coldloop config`, `coldloop model`."""

import csv
import io
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from coldloop.process.lti_model import load
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_rig.cli.registers import COLUMNS
from tests.harness.records import MAPS

if TYPE_CHECKING:
    from tests.conftest import Coldloop

WORDS = {"uint16": 1, "uint32": 2, "float32": 2}


@pytest.fixture
def listed(coldloop: "Coldloop") -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads(coldloop("registers", "--format", "json").out)
    return rows


def test_every_register_of_every_map_is_listed(listed: list[dict[str, Any]]) -> None:
    declared = {
        (service, register.address)
        for service, one in MAPS.items()
        for block in one.blocks
        for register in block.registers()
    }
    assert {(row["service"], int(row["address"])) for row in listed} == declared
    assert all(row["description"] and row["name"] for row in listed)


def test_json_and_csv_say_the_same(coldloop: "Coldloop", listed: list[dict[str, Any]]) -> None:
    reader = csv.DictReader(io.StringIO(coldloop("registers", "--format", "csv").out))
    assert tuple(reader.fieldnames or ()) == COLUMNS

    def text(value: object) -> str:
        if isinstance(value, dict):
            return " ".join(f"{number}={meaning}" for number, meaning in value.items())
        return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)

    assert list(reader) == [{name: text(value) for name, value in row.items()} for row in listed]


def test_enumerations_have_their_meaning_in_json(listed: list[dict[str, Any]]) -> None:
    meanings = {(row["service"], row["block"], row["name"]): row["values"] for row in listed}
    assert meanings["control_plc", "ladder", "mode"] == {
        "0": "hold", "1": "mpc", "2": "classical", "3": "rest", "4": "manual",
    }  # fmt: skip
    assert meanings["plant", "sensor faults", "kind"]["2"] == "frozen"
    assert meanings["plant", "identity", "tick"] is None
    for row in listed:
        for number in row["values"] or ():
            assert row["low"] <= int(number) <= row["high"], row


def test_modicon_addresses_are_one_more_and_six_digits_where_five_do_not_suffice(listed: list[dict[str, Any]]) -> None:
    for row in listed:
        address, modicon = int(row["address"]), row["modicon"]
        assert modicon.startswith("4")
        assert int(modicon[1:]) == address + 1
        assert len(modicon) == (5 if address + 1 <= 9999 else 6)
    assert {len(row["modicon"]) for row in listed} == {5, 6}


def test_the_table_has_a_line_for_each_register(coldloop: "Coldloop", listed: list[dict[str, Any]]) -> None:
    head, *lines = coldloop("registers").out.splitlines()
    assert head.split()[:3] == ["service", "block", "name"]
    assert len(lines) == len(listed)
    for line, row in zip(lines, listed, strict=True):
        assert re.search(rf"\b{row['address']}\s+{row['modicon']}\b", line)


def test_the_markdown_tables_are_whole(coldloop: "Coldloop", listed: list[dict[str, Any]]) -> None:
    lines = coldloop("registers", "--format", "markdown").out.splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in table} == {8}
    blocks = sum(len(one.blocks) for one in MAPS.values())
    assert len(table) == len(listed) + 2 * blocks
    assert sum(line.startswith("`mbpoll ") for line in lines) == blocks


@pytest.mark.parametrize("service", MAPS)
def test_one_service_can_be_listed_alone(service: str, coldloop: "Coldloop", listed: list[dict[str, Any]]) -> None:
    alone = json.loads(coldloop("registers", "--format", "json", "--service", service).out)
    assert alone == [row for row in listed if row["service"] == service]


def test_an_mbpoll_line_reads_registers_of_one_type_inside_its_block(
    coldloop: "Coldloop", listed: list[dict[str, Any]]
) -> None:
    kinds = {"4:float -B": "float32", "4:int -B": "uint32", "4": "uint16"}
    out = coldloop("registers", "--format", "markdown").out
    lines = re.findall(r"^`mbpoll -0 -1 -m tcp -p (\d+) -t (.+?) -r (\d+) -c (\d+) 127.0.0.1`$", out, re.MULTILINE)
    assert len(lines) == sum(len(one.blocks) for one in MAPS.values())
    services = dict(zip(("5020", "5021", "5022"), MAPS, strict=True))
    for port, option, first, count in lines:
        width = WORDS[kinds[option]]
        assert int(count) * width <= 125
        addresses = range(int(first), int(first) + int(count) * width, width)
        found = [row for row in listed if row["service"] == services[port] and int(row["address"]) in addresses]
        assert [int(row["address"]) for row in found] == list(addresses)
        assert {row["type"] for row in found} == {kinds[option]}


def test_the_configuration_is_shown_with_the_source_of_each_value(coldloop: "Coldloop", tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text('[plant]\nseed = 5\nload = "b"\n[session]\nfactor = 2.0\n')
    outcome = coldloop(
        "config", "--config", file, "--set", "session.factor=4",
        environment={"COLDLOOP__PLANT__LOAD": "c", "COLDLOOP__SESSION__FACTOR": "3"},
    )  # fmt: skip
    assert outcome.code == 0
    shown = dict(line.split(" = ", 1) for line in outcome.out.splitlines())
    assert shown["plant.seed"].split("  # ") == [shown["plant.seed"].split("  # ")[0], str(file)]
    assert shown["plant.seed"].startswith("5 ")
    assert re.fullmatch(r'"c" +# COLDLOOP__PLANT__LOAD', shown["plant.load"])
    assert re.fullmatch(r"4(\.0)? +# --set session.factor", shown["session.factor"])
    assert re.fullmatch(r"1883 +# default", shown["telemetry.port"])


@pytest.mark.usefixtures("compiles")
@pytest.mark.usefixtures("undrawn")
def test_a_model_written_is_the_model_in_use_and_can_be_run(coldloop: "Coldloop", tmp_path: Path) -> None:
    file = tmp_path / "model.json"
    outcome = coldloop("model", "--out", file)
    assert outcome.code == 0
    made = load(file)
    shipped = load(DEFAULT_MODEL_FILE)
    assert f"sha256 {made.digest}\n" in outcome.out
    assert f"sha256 {shipped.digest} ({DEFAULT_MODEL_FILE})" in outcome.out
    assert made.parameters_digest == shipped.parameters_digest
    assert made.x0 == pytest.approx(shipped.x0, rel=1e-6)

    results = tmp_path / "results"
    run = coldloop("run", "--in-process", "--duration", "2s", "--set", f"model.file={file}", "--out", results)
    assert run.code == 0
    assert json.loads((results / "manifest.json").read_text())["hashes"]["model_sha256"] == made.digest


@pytest.mark.usefixtures("compiles")
def test_a_model_that_cannot_be_written_is_told(coldloop: "Coldloop", tmp_path: Path) -> None:
    outcome = coldloop("model", "--out", tmp_path / "absent" / "model.json")
    assert outcome.code == 2
    assert len(outcome.complaints) == 1
    assert "--out" in outcome.complaints[0]


def test_without_a_command_the_help_is_shown(coldloop: "Coldloop") -> None:
    outcome = coldloop()
    assert outcome.code == 0
    assert "registers" in outcome.out
    assert coldloop("version").out.startswith("coldloop 0")
