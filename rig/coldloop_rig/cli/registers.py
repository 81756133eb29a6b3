"""Register maps as listings and as configurations of other programs: Telegraf, Node-RED, FUXA, Ignition, Grafana.

All is made from the declarations. What only some client writes (sequences, sessions, queries) is left out of the files
for other programs, so that these read and do not command.
"""

import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple

from coldloop.modbus.requests import MAX_READ_WORDS
from coldloop.modbus.settings import CONTROL_PORT, OPTIMIZER_PORT, PLANT_PORT
from coldloop.process.declaration import Process
from coldloop.registers import common, control_plc
from coldloop.registers.declaration import Block, Kind, Register, RegisterMap
from coldloop.service.journal import alarm_word
from coldloop_rig.cli.commands.options import HostPort
from coldloop_rig.text_tables import aligned, markdown_table

PORTS: Final = {"plant": PLANT_PORT, "control_plc": CONTROL_PORT, "optimizer_plc": OPTIMIZER_PORT}

COLUMNS: Final = (
    "service", "block", "name", "address", "modicon", "rows", "row_words", "type", "unit", "low", "high", "writer",
    "description", "values",
)  # fmt: skip


def modicon(address: int) -> str:
    """Return the 4xxxx-style address of a 0-based one: five digits, or six beyond 49999."""
    return f"{40001 + address}" if address < 9999 else f"{400001 + address}"


Entry = dict[str, str | int | float | dict[str, str] | None]


def _entries(maps: Sequence[RegisterMap]) -> Iterator[Entry]:
    """Yield one entry a register, the first row of each block."""
    for register_map in maps:
        for block in register_map.shown:
            for register in block.registers():
                meanings = None
                if register.values is not None:
                    meanings = {str(value.value): value.word for value in register.meanings}
                values = (
                    register_map.service, block.name, register.name, register.address, modicon(register.address),
                    block.rows, block.row_words, register.kind.label, register.unit, register.low, register.high,
                    register.writer.value if register.writer else "read-only", register.description, meanings,
                )  # fmt: skip
                yield dict(zip(COLUMNS, values, strict=True))


def _text(value: str | float | dict[str, str] | None) -> str:
    if value is None:
        return ""
    if isinstance(value, dict):
        return " ".join(f"{number}={name}" for number, name in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)


def as_json(maps: Sequence[RegisterMap]) -> str:
    """Return an array of objects; a bound that does not exist is null, `values` has the meaning of enumerations."""
    return json.dumps(list(_entries(maps)), indent=1, ensure_ascii=False) + "\n"


def as_csv(maps: Sequence[RegisterMap]) -> str:
    """Return comma-separated values with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _text(value) for name, value in entry.items()} for entry in _entries(maps))
    return text.getvalue()


def as_table(maps: Sequence[RegisterMap]) -> str:
    """Return aligned columns for a terminal."""
    shown = ("service", "block", "name", "address", "modicon", "type", "unit", "writer")
    return aligned([shown, *(tuple(_text(entry[column]) for column in shown) for entry in _entries(maps))])


def as_markdown(maps: Sequence[RegisterMap]) -> str:
    """Return the register map's documentation."""
    parts = []
    for one in maps:
        parts += [
            f"## {one.service} (port {PORTS[one.service]}, map version {one.version}, digest {one.digest:08x})\n",
            f"Addresses 0 to {one.end - 1}; those in no table read 0 and are not written.\n",
        ]
        for block in one.shown:
            writer = f"written by the {block.writer.value}" if block.writer else "read-only"
            many = f"; {block.rows} rows of {block.row_words} words, the first one shown" if block.rows > 1 else ""
            caption = f"### {block.name}: {block.description} ({writer}{many})\n\n`{mbpoll_line(one.service, block)}`"
            header = ("address", "4xxxx", "name", "type", "unit", "range", "description")
            rows = [
                (r.address, modicon(r.address), r.name, r.kind.label, r.unit,
                 "" if r.low is r.high is None else f"{_text(r.low)}..{_text(r.high)}", r.description)
                for r in block.registers()
            ]  # fmt: skip
            parts.append(markdown_table(header, rows, caption) + "\n")
    return "\n".join(parts)


def mbpoll_line(service: str, block: Block) -> str:
    """Return the mbpoll command that reads a run of equal types in a block's first row: of floats where it has any."""
    runs = [(kind, list(group)) for kind, group in groupby(block.registers(), key=lambda register: register.kind)]
    kind, run = max(runs, key=lambda item: (item[0] is Kind.F32, len(item[1])))
    options = {Kind.F32: "4:float -B", Kind.U32: "4:int -B", Kind.U16: "4"}[kind]
    count = min(len(run), MAX_READ_WORDS // kind.words)
    return f"mbpoll -0 -1 -m tcp -p {PORTS[service]} -t {options} -r {run[0].address} -c {count} 127.0.0.1"


FORMATS: Final = {"table": as_table, "markdown": as_markdown, "csv": as_csv, "json": as_json}


UNITS: Final = {"%": "percent", "K": "kelvin", "W": "watt"}
"""Grafana's names of units; others are in the title of the panel."""


class Panel(NamedTuple):
    """A panel of a board."""

    title: str
    unit: str
    curves: tuple[tuple[str, str], ...]
    """Expression and legend of each."""


STATE: Final = (
    Panel("Services", "short", (("coldloop_up", "{{service}}"),)),
    Panel("Mode (0 hold, 1 MPC, 2 classical, 3 rest, 4 manual)", "short",
          (("coldloop_control_plc_ladder_mode", "mode"),)),
    Panel("Alarms that wait", "short",
          (("count(coldloop_alarm_state == 1) + count(coldloop_alarm_state == 3) or vector(0)", "waiting"),)),
    Panel("Deadlines missed", "short", (("coldloop_control_plc_status_deadline_misses", "missed"),)),
)  # fmt: skip
OPTIMISER: Final = (
    Panel("Cost", "short",
          (("coldloop_update_j_effective", "J reached"), ("coldloop_update_j_delivered", "J predicted"))),
    Panel("Lateness of scans", "ms",
          (("coldloop_control_plc_status_lateness_p99", "99th percentile"),
           ("coldloop_control_plc_status_lateness_max", "largest"))),
    Panel("Age of what is known", "s", (("coldloop_age_seconds", "{{service}}"),)),
)  # fmt: skip


def board(process: Process) -> str:
    """Return the dashboard of a process, as JSON to import."""
    period = Panel(f"Updating period, ticks of {process.tick_unit}", "short",
                   (("coldloop_update_tau_u", "tau_u"), ("coldloop_update_iterations", "iterations")))  # fmt: skip
    prefix, limits = "coldloop_control_plc_process", "coldloop_optimizer_plc_operating_limits_output"
    named = []  # outputs with their bands, then the inputs by unit, those in the unit of the load with it
    for one in process.banded:
        element = f'{{element="{one.name}"}}'
        bounds = ((f"{limits}_{end}{element}", end) for end in ("low", "high"))
        named.append((one.name, one.unit, [(f"{prefix}_y{element}", one.name), *bounds]))
    curves = {process.load.unit: [(f"{prefix}_load", "load")]}
    for each in sorted(process.inputs, key=lambda each: each.unit):
        curves.setdefault(each.unit, []).append((f'{prefix}_u{{element="{each.name}"}}', each.name))
    with_load = curves.pop(process.load.unit)
    named += [*(("Inputs", unit, pairs) for unit, pairs in curves.items()), ("Load", process.load.unit, with_load)]
    plots = [
        Panel(title if unit in UNITS or not unit else f"{title} ({unit})", UNITS.get(unit, "short"), tuple(pairs))
        for title, unit, pairs in named
    ]
    panels = [*_laid_out(STATE, "stat", 0, 4, 4), *_laid_out((*plots, period, *OPTIMISER), "timeseries", 4, 2, 7)]
    document = {
        "title": "Coldloop", "uid": "coldloop", "schemaVersion": 39, "version": 1, "editable": True, "refresh": "5s",
        "time": {"from": "now-30m", "to": "now"}, "tags": ["coldloop"],
        "templating": {"list": [{"name": "datasource", "type": "datasource", "query": "prometheus",
                                 "label": "Prometheus"}]},
        "panels": [{"id": number, **panel} for number, panel in enumerate(panels, 1)],
    }  # fmt: skip
    return json.dumps(document, indent=1) + "\n"


def _laid_out(panels: Sequence[Panel], kind: str, top: int, across: int, height: int) -> Iterable[dict[str, Any]]:
    """Yield panels in rows of so many."""
    width = 24 // across  # in Grafana's units
    for place, panel in enumerate(panels):
        yield {
            "type": kind, "title": panel.title,
            "gridPos": {"x": place % across * width, "y": top + place // across * height, "w": width, "h": height},
            "datasource": {"type": "prometheus", "uid": "${datasource}"},
            "fieldConfig": {
                "defaults": {"unit": panel.unit, "custom": {"lineInterpolation": "stepAfter", "fillOpacity": 0}},
                "overrides": [],
            },
            "targets": [
                {"refId": chr(ord("A") + number), "expr": expression, "legendFormat": legend}
                for number, (expression, legend) in enumerate(panel.curves)
            ],
        }  # fmt: skip


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
    process, tags = register_map.process, list[Tag]()
    for block in register_map.shown:
        if block.writer is not None and block.record is not control_plc.Operator:
            continue
        rows = {0: block.name} if block.rows == 1 else {}
        if block.record is common.Alarm:
            rows = {int(kind): f"{block.name}_{alarm_word(kind, process)}" for kind in common.alarms_of(process)}
        texts = {name for name, field in block.fields.items() if field.is_text}
        tags += [
            Tag(_NOT_IN_NAMES.sub("_", f"{prefix}_{register.name}"), block.name, register)
            for row, prefix in rows.items()
            for register in block.registers(row)
            if register.name.partition(".")[0] not in texts
        ]
    count = Counter(tag.name.lower() for tag in tags)
    for tag in tags:
        yield tag._replace(name=f"{tag.name}_{tag.register.address}") if count[tag.name.lower()] > 1 else tag


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
            "[[inputs.modbus]]", f'  name = "{register_map.service}"',
            f'  controller = "tcp://{place.host}:{place.port}"', '  configuration_type = "request"', '  timeout = "2s"',
        ]  # fmt: skip
        for run in runs(list(exported(register_map))):
            lines += [
                "  [[inputs.modbus.request]]", "    slave_id = 1", '    byte_order = "ABCD"',
                '    register = "holding"', f'    measurement = "coldloop_{register_map.service}"', "    fields = [",
            ]  # fmt: skip
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
        tab, client, link = (_id(service, what) for what in ("tab", "client", "out"))
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
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["Path", "Name", "TagType", "DataType", "OPCServer", "OPCItemPath", "AccessRights", "EngUnit", "Documentation"]
    )
    for register_map in maps:
        place = places[register_map.service]
        for tag in exported(register_map):
            designator, data_type = designators[tag.register.kind]
            writer.writerow((
                f"coldloop/{register_map.service}", tag.name, "OPC", data_type, "Ignition OPC UA Server",
                f"[{register_map.service}]{designator}{tag.register.address + 1}", "Read_Only", tag.register.unit,
                f"{tag.register.description} ({place.host}:{place.port})",
            ))  # fmt: skip
    return text.getvalue()


EXPORTS: Final[Mapping[str, Callable[[Sequence[RegisterMap], Places], str]]] = {
    "telegraf": as_telegraf,
    "node-red": as_node_red,
    "fuxa": as_fuxa,
    "ignition": as_ignition,
    "grafana": lambda maps, _places: board(maps[0].process),  # metrics have the names of the registers
}
