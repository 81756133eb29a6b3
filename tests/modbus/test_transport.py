"""Which parts of pymodbus are used, and where: an upgrade that moves one of them fails here."""

import ast
import asyncio
import inspect
from pathlib import Path

import pytest
from pymodbus import client as pymodbus_client
from pymodbus.pdu import DecodePDU, ModbusPDU

from coldloop.modbus import transport
from coldloop.modbus.raw_pdu import RawDecoder, RawPdu
from coldloop.modbus.transport import INSIDES

ROOT = Path(__file__).parents[2]
SOURCES = [file for folder in ("shared", "services", "rig", "benchmarks") for file in (ROOT / folder).rglob("*.py")]


def imports_of(file: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
    return {name for name in names if name.split(".")[0] == "pymodbus"}


def test_pymodbus_is_used_in_three_modules_and_its_client_in_one() -> None:
    users = {str(file.relative_to(ROOT)): imports for file in SOURCES if (imports := imports_of(file))}
    assert users == {
        "shared/coldloop/modbus/transport.py": {"pymodbus.client", "pymodbus.exceptions"},
        "shared/coldloop/modbus/raw_pdu.py": {"pymodbus.pdu"},
        "shared/coldloop/modbus/identification.py": {"pymodbus.constants", "pymodbus.pdu.mei_message"},
    }


def test_what_is_used_of_its_insides_is_what_the_list_says() -> None:
    tree = ast.parse(inspect.getsource(transport))
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "ctx"
    }
    assert used == set(INSIDES)
    assert not [file for file in SOURCES if ".ctx." in file.read_text(encoding="utf-8") and file.stem != "transport"]


async def test_they_are_where_they_are_expected() -> None:
    client = pymodbus_client.AsyncModbusTcpClient("127.0.0.1", port=1, retries=0, reconnect_delay=0, timeout=2.5)
    manager = client.ctx
    assert [name for name in INSIDES if not hasattr(manager, name)] == []
    assert manager.comm_params.timeout_connect == 2.5
    assert isinstance(manager.framer.decoder, DecodePDU)
    assert isinstance(manager.max_buffer_size, int)
    assert isinstance(manager.response_future, asyncio.Future)
    assert inspect.iscoroutinefunction(manager.call_create) or callable(manager.call_create)
    assert isinstance(manager.handle_new_connection(), asyncio.BaseProtocol)
    assert list(inspect.signature(client.execute).parameters) == ["no_response_expected", "request"]


def test_the_pdus_fit_theirs() -> None:
    assert issubclass(RawPdu, ModbusPDU)
    answer = RawDecoder(is_server=False).decode(b"\x55\x01\x02")
    assert isinstance(answer, RawPdu)
    assert (answer.function_code, answer.payload, answer.encode()) == (0x55, b"\x01\x02", b"\x01\x02")


@pytest.mark.parametrize("module", ["raw_pdu", "identification"])
def test_the_others_use_no_names_that_begin_with_an_underscore(module: str) -> None:
    tree = ast.parse((ROOT / f"shared/coldloop/modbus/{module}.py").read_text(encoding="utf-8"))
    private = [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr.startswith("_")]
    assert [name for name in private if not name.startswith("__")] == []
