"""The register maps as other programs import them, read by a reader of each format and held against the registers."""

import csv
import io
import json
import re
import struct
import tomllib
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import pytest

from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import IDENTITY_BLOCK, AlarmKind
from coldloop.registers.declaration import Block, RegisterMap, f32
from coldloop.registers.plant import Measurement
from coldloop.service.journal import alarm_word
from coldloop.service.monitoring import metric_name
from coldloop_rig.cli.registers import exported, runs
from tests.conftest import Coldloop
from tests.harness.records import CONTROL_MAP, MAPS, PLANT_MAP

T5_ADDRESS = 216
GRAFANA = Path(__file__).parents[2] / "docs" / "grafana.json"


def made(coldloop: Coldloop, kind: str) -> str:
    outcome = coldloop("registers", "--format", kind, "--host", "10.0.0.7", "--port-base", "6000")
    assert outcome.code == 0, outcome.complaints
    return outcome.out


def test_telegraf_is_given_every_tag_with_its_address_and_type(coldloop: Coldloop) -> None:
    document = tomllib.loads(made(coldloop, "telegraf"))
    inputs = {one["name"]: one for one in document["inputs"]["modbus"]}
    assert [inputs[service]["controller"] for service in MAPS] == [f"tcp://10.0.0.7:600{i}" for i in range(3)]
    for service, register_map in MAPS.items():
        fields = {field["name"]: field for request in inputs[service]["request"] for field in request["fields"]}
        tags = list(exported(register_map))
        assert len(fields) == len(tags), "no name is used twice"
        assert all(fields[tag.name]["address"] == tag.register.address for tag in tags)
    assert fields_of(inputs["plant"])["measurement_y_T5"] == {
        "address": T5_ADDRESS, "name": "measurement_y_T5", "type": "FLOAT32"
    }  # fmt: skip


def fields_of(one: dict[str, Any]) -> dict[str, Any]:
    return {field["name"]: field for request in one["request"] for field in request["fields"]}


def test_names_that_would_be_the_same_end_with_their_addresses() -> None:
    """Letters of other alphabets, and capitals, which some of these programs do not tell apart."""

    States = NamedTuple(
        "States", [(name, Annotated[float, f32("a state")]) for name in ("\u03b1", "\u03b2", "level", "Level", "T")]
    )
    tags = exported(RegisterMap("plant", 1, (IDENTITY_BLOCK, Block("x", 100, States, ""))))
    names = [tag.name for tag in tags if tag.block == "x"]
    assert names == ["x___100", "x___102", "x_level_104", "x_Level_106", "x_T"]


def test_fuxa_counts_addresses_from_one(coldloop: Coldloop) -> None:
    devices = json.loads(made(coldloop, "fuxa"))["devices"].values()
    plant = next(one for one in devices if one["property"]["address"] == "10.0.0.7:6000")
    tags = {tag["name"]: tag for tag in plant["tags"].values()}
    assert (tags["measurement_y_T5"]["address"], tags["measurement_y_T5"]["type"]) == (str(T5_ADDRESS + 1), "Float32")


def test_ignition_is_given_an_item_path_for_each_tag(coldloop: Coldloop) -> None:
    rows = list(csv.DictReader(io.StringIO(made(coldloop, "ignition"))))
    assert len(rows) == sum(len(list(exported(one))) for one in MAPS.values())
    paths = {(row["Path"], row["Name"]): row["OPCItemPath"] for row in rows}
    assert paths["coldloop/plant", "measurement_y_T5"] == f"[plant]HRF{T5_ADDRESS + 1}"
    assert paths["coldloop/plant", "identity_state"] == "[plant]HRUS6"


def test_a_node_red_flow_is_whole_and_its_tables_decode_what_the_server_sends(coldloop: Coldloop) -> None:
    nodes = {node["id"]: node for node in json.loads(made(coldloop, "node-red"))}
    assert len(nodes) == len(json.loads(made(coldloop, "node-red"))), "no id is used twice"
    for node in nodes.values():
        for targets in node.get("wires", []):
            assert set(targets) <= set(nodes)
    readers = [node for node in nodes.values() if node["type"] == "modbus-read"]
    reader = next(node for node in readers if node["name"] == "measurement" and int(node["adr"]) <= T5_ADDRESS)
    bank = RegisterBank(PLANT_MAP, WordOrder.HIGH_FIRST)
    y = tuple(float(value) for value in range(22))
    bank.put(Measurement(7, 400.0, y, (0.0,) * 28, 1, (0.0,) * 3))
    raw = bank.read(int(reader["adr"]), int(reader["quantity"]))
    code = nodes[reader["wires"][0][0]]["func"]
    table = json.loads(code[code.index("tags = ") + 7 : code.index(";\n")])
    name, letter, word = next(row for row in table if row[0] == "measurement_y_T5")
    (value,) = struct.unpack_from(f">{letter}", raw, 2 * word)
    assert (name, value) == ("measurement_y_T5", 6.0)


@pytest.mark.parametrize("service", MAPS)
def test_each_request_reads_neighbours_of_one_block_that_fit(service: str) -> None:
    for run in runs(list(exported(MAPS[service]))):
        words = sum(tag.register.kind.words for tag in run)
        assert words <= 125
        assert run[-1].register.address + run[-1].register.kind.words - run[0].register.address == words
        assert len({tag.block for tag in run}) == 1


def test_a_new_alarm_is_exported_by_itself() -> None:
    names = {tag.name for tag in exported(CONTROL_MAP)}
    assert {f"alarms_{alarm_word(kind, COLD_BOX)}_state".replace(" ", "_") for kind in AlarmKind} <= names


def test_the_dashboard_of_the_docs_is_the_one_that_is_made_and_its_metrics_are_there(coldloop: Coldloop) -> None:
    text = made(coldloop, "grafana")
    assert text == GRAFANA.read_text(encoding="utf-8")
    panels = json.loads(text)["panels"]
    places = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in panels]
    assert len(set(places)) == len(panels)
    asked = set(re.findall(r"coldloop_(?:control|optimizer)_plc_\w+", text))
    served = {
        metric_name(service, block.name, field)
        for service, register_map in MAPS.items()
        for block in register_map.blocks
        for field in block.fields
    }
    assert asked <= served
    assert len(asked) == 9
