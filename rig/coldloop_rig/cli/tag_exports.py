"""The register maps as configurations of other programs: Telegraf, Node-RED, FUXA, Ignition.

All is made from the declarations: registers of blocks with one row, and the rows of the alarms. What only some client
writes (sequences, sessions, queries) is left out, so that these programs read and do not command.
"""

import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple

from coldloop.modbus.requests import MAX_READ_WORDS
from coldloop.registers.control_plc import Operator
from coldloop.registers.declaration import Block, Kind, Register, RegisterMap
from coldloop.registers.safety import Alarm, alarms_of
from coldloop.service.event_text import alarm_word
from coldloop_rig.cli.commands.options import HostPort
from coldloop_rig.cli.grafana_board import board

Places = Mapping[str, HostPort]
"""Where each service is."""

POLL_S: Final = 1
_NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9_]+")


class Tag(NamedTuple):
    """One register under a name that all these programs take."""

    name: str
    block: str
    register: Register


def exported(register_map: RegisterMap) -> Iterator[Tag]:
    """Yield the tags of a service, in the order of their addresses; names that would be the same end with these."""
    tags = list(_named(register_map))
    count = Counter(tag.name.lower() for tag in tags)
    for tag in tags:
        yield tag._replace(name=f"{tag.name}_{tag.register.address}") if count[tag.name.lower()] > 1 else tag


def _named(register_map: RegisterMap) -> Iterator[Tag]:
    for block in register_map.shown:
        if block.writer is not None and block.record is not Operator:
            continue
        if block.record is Alarm:
            for kind in alarms_of(register_map.process):
                yield from _tags(block, int(kind), f"{block.name}_{alarm_word(kind, register_map.process)}")
        elif block.rows == 1:
            yield from _tags(block, 0, block.name)


def _tags(block: Block, row: int, prefix: str) -> Iterator[Tag]:
    texts = {name for name, field in block.fields.items() if field.is_text}
    for register in block.registers(row):
        if register.name.partition(".")[0] not in texts:
            yield Tag(_NOT_IN_NAMES.sub("_", f"{prefix}_{register.name}"), block.name, register)


def runs(tags: Sequence[Tag]) -> Iterator[list[Tag]]:
    """Yield tags that one request reads: neighbours without a gap, of one block, as many as fit."""
    for _, group in groupby(tags, key=lambda tag: tag.block):
        run: list[Tag] = []
        for tag in group:
            words = sum(one.register.kind.words for one in run)
            adjoins = run and run[-1].register.address + run[-1].register.kind.words == tag.register.address
            if run and (not adjoins or words + tag.register.kind.words > MAX_READ_WORDS):
                yield run
                run = []
            run.append(tag)
        if run:
            yield run


def as_telegraf(maps: Sequence[RegisterMap], places: Places) -> str:
    """Return inputs for Telegraf's Modbus plugin, a request a block."""
    types = {Kind.U16: "UINT16", Kind.U32: "UINT32", Kind.F32: "FLOAT32"}
    lines = ["# Made by `coldloop registers --format telegraf` from the register declarations."]
    for register_map in maps:
        place = places[register_map.service]
        lines += [
            "[[inputs.modbus]]",
            f'  name = "{register_map.service}"',
            f'  controller = "tcp://{place.host}:{place.port}"',
            '  configuration_type = "request"',
            '  timeout = "2s"',
        ]
        for run in runs(list(exported(register_map))):
            lines += [
                "  [[inputs.modbus.request]]",
                "    slave_id = 1",
                '    byte_order = "ABCD"',
                '    register = "holding"',
                f'    measurement = "coldloop_{register_map.service}"',
                "    fields = [",
            ]
            for tag in run:
                kind = types[tag.register.kind]
                lines.append(f'      {{ address = {tag.register.address}, name = "{tag.name}", type = "{kind}" }},')
            lines.append("    ]")
    return "\n".join(lines) + "\n"


_DECODER: Final = """\
const words = msg.payload, tags = {tags};
const buffer = Buffer.alloc(2 * words.length);
words.forEach((word, place) => buffer.writeUInt16BE(word, 2 * place));
msg.payload = {{}};
for (const [name, type, word] of tags) {{
  if (type === "f") msg.payload[name] = buffer.readFloatBE(2 * word);
  else if (type === "I") msg.payload[name] = buffer.readUInt32BE(2 * word);
  else msg.payload[name] = buffer.readUInt16BE(2 * word);
}}
msg.topic = {topic};
return msg;"""


def as_node_red(maps: Sequence[RegisterMap], places: Places) -> str:
    """Return a flow for Node-RED with node-red-contrib-modbus: a tab a service, a reader a request, values by name."""
    nodes: list[dict[str, Any]] = []
    for register_map in maps:
        service, place = register_map.service, places[register_map.service]
        tab, client = _id(service, "tab"), _id(service, "client")
        link = _id(service, "out")
        nodes += [
            {"id": tab, "type": "tab", "label": f"Coldloop {service}"},
            {
                "id": client, "type": "modbus-client", "name": service, "clienttype": "tcp", "bufferCommands": True,
                "stateLogEnabled": False, "queueLogEnabled": False, "tcpHost": place.host, "tcpPort": str(place.port),
                "tcpType": "DEFAULT", "serialPort": "", "unit_id": 1, "commandDelay": 1, "clientTimeout": 2000,
                "reconnectOnTimeout": True, "reconnectTimeout": 2000, "parallelUnitIdsAllowed": True,
            },
            {"id": link, "type": "link out", "z": tab, "name": f"coldloop {service}", "mode": "link", "links": [],
             "x": 720, "y": 60},
        ]  # fmt: skip
        for place_on_tab, run in enumerate(runs(list(exported(register_map)))):
            reader, decoder = _id(service, f"read{place_on_tab}"), _id(service, f"decode{place_on_tab}")
            first, last = run[0].register, run[-1].register
            table = [[tag.name, tag.register.kind.letter, tag.register.address - first.address] for tag in run]
            code = _DECODER.format(tags=json.dumps(table), topic=json.dumps(f"{service}/{run[0].block}"))
            y = 120 + 60 * place_on_tab
            nodes += [
                {
                    "id": reader, "type": "modbus-read", "z": tab, "name": run[0].block, "topic": "",
                    "showStatusActivities": False, "logIOActivities": False, "showErrors": True, "unitid": "1",
                    "dataType": "HoldingRegister", "adr": str(first.address),
                    "quantity": str(last.address + last.kind.words - first.address), "rate": str(POLL_S),
                    "rateUnit": "s", "delayOnStart": False, "server": client, "useIOFile": False, "ioFile": "",
                    "useIOForPayload": False, "emptyMsgOnFail": False, "x": 160, "y": y, "wires": [[decoder], []],
                },
                {
                    "id": decoder, "type": "function", "z": tab, "name": f"{run[0].block} by name", "func": code,
                    "outputs": 1, "x": 420, "y": y, "wires": [[link]],
                },
            ]  # fmt: skip
    return json.dumps(nodes, indent=1) + "\n"


def _id(*parts: str) -> str:
    return hashlib.sha256("/".join(parts).encode()).hexdigest()[:16]


def as_fuxa(maps: Sequence[RegisterMap], places: Places) -> str:
    """Return a FUXA project with a device a service; its addresses are counted from 1."""
    types = {Kind.U16: "UInt16", Kind.U32: "UInt32", Kind.F32: "Float32"}
    devices: dict[str, Any] = {}
    for register_map in maps:
        place, device = places[register_map.service], f"d_{_id(register_map.service, 'fuxa')}"
        tags = {}
        for tag in exported(register_map):
            key = f"t_{_id(register_map.service, tag.name)}"
            tags[key] = {
                "id": key, "name": tag.name, "label": tag.name, "type": types[tag.register.kind],
                "memaddress": "400000", "address": str(tag.register.address + 1), "divisor": 1,
                "description": tag.register.description,
            }  # fmt: skip
        devices[device] = {
            "id": device, "name": f"coldloop {register_map.service}", "type": "ModbusTCP", "enabled": True,
            "polling": POLL_S * 1000, "tags": tags,
            "property": {
                "address": f"{place.host}:{place.port}", "slaveid": "1", "connectionOption": "TcpPort",
                "socketReuse": None, "forceFC16": False,
            },
        }  # fmt: skip
    project = {"version": "1.01", "name": "coldloop", "devices": devices, "hmi": {"views": [], "layout": {}}}
    return json.dumps(project, indent=1, ensure_ascii=False) + "\n"


def as_ignition(maps: Sequence[RegisterMap], places: Places) -> str:
    """Return tags for Ignition, of Modbus TCP devices that are called like the services."""
    designators = {Kind.U16: ("HRUS", "Int4"), Kind.U32: ("HRUI", "Int8"), Kind.F32: ("HRF", "Float4")}
    text = io.StringIO()
    columns = (
        "Path", "Name", "TagType", "DataType", "OPCServer", "OPCItemPath", "AccessRights", "EngUnit", "Documentation",
    )  # fmt: skip
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for register_map in maps:
        place = places[register_map.service]
        for tag in exported(register_map):
            designator, data_type = designators[tag.register.kind]
            writer.writerow(
                (
                    f"coldloop/{register_map.service}", tag.name, "OPC", data_type, "Ignition OPC UA Server",
                    f"[{register_map.service}]{designator}{tag.register.address + 1}", "Read_Only", tag.register.unit,
                    f"{tag.register.description} ({place.host}:{place.port})",
                )
            )  # fmt: skip
    return text.getvalue()


EXPORTS: Final[Mapping[str, Callable[[Sequence[RegisterMap], Places], str]]] = {
    "telegraf": as_telegraf,
    "node-red": as_node_red,
    "fuxa": as_fuxa,
    "ignition": as_ignition,
    "grafana": lambda maps, _places: board(maps[0].process),  # of metrics, which have the names of the registers
}
