"""The rig with Modbus/TCP Security, as both compose files together bring it up: certificates say who may do what."""

import contextlib
import socket
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.modbus.settings import TlsSettings
from coldloop.modbus.tls import tls_context
from coldloop.registers.plant import Actuators, LoadStep
from tests.compose.browser import assert_an_operator_changes_the_load
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import ComposedRig


READ_MAGIC = bytes.fromhex("000100000006ff0300000002")
MAGIC = bytes.fromhex("42f6e979")


def certificates(folder: Path, name: str) -> TlsSettings:
    return TlsSettings(certificate=folder / f"{name}.crt", key=folder / f"{name}.key", ca=folder / "ca.crt")


def function_of_answer(rig: "ComposedRig", tls: TlsSettings, request: bytes) -> int:
    """Return the function code that the plant answers a request with."""
    with (
        socket.create_connection(("127.0.0.1", rig.plant), 5) as plain,
        tls_context(tls, "test").wrap_socket(plain, server_hostname="127.0.0.1") as connection,
    ):
        connection.sendall(struct.pack(">HHHB", 1, 0, len(request) + 1, 255) + request)
        return connection.makefile("rb").read(8)[7]


def write_of(record: type[tuple[object, ...]]) -> bytes:
    """Return a request that writes zeros into the first row of a block."""
    block = PLANT_MAP.block_of(record)
    return struct.pack(">BHHB", 16, block.address, block.row_words, 2 * block.row_words) + bytes(2 * block.row_words)


@pytest.mark.parametrize(("name", "answer"), [("operator", 16), ("control", 0x90), ("reader", 0x90)])
def test_certificates_say_who_may_write_the_load(
    secured_rig: "ComposedRig", certificate_folder: Path, name: str, answer: int
) -> None:
    tls = certificates(certificate_folder, name)
    assert function_of_answer(secured_rig, tls, READ_MAGIC[7:]) == 3
    assert function_of_answer(secured_rig, tls, write_of(LoadStep)) == answer


@pytest.mark.parametrize("name", ["operator", "optimizer", "reader"])
def test_none_but_the_control_plc_may_write_outputs(
    secured_rig: "ComposedRig", certificate_folder: Path, name: str
) -> None:
    assert function_of_answer(secured_rig, certificates(certificate_folder, name), write_of(Actuators)) == 0x90


def test_nobody_is_answered_without_tls(secured_rig: "ComposedRig") -> None:
    with socket.create_connection(("127.0.0.1", secured_rig.plant), 5) as connection:
        connection.sendall(READ_MAGIC)
        with contextlib.suppress(ConnectionResetError):
            assert MAGIC not in connection.recv(1000)


def test_no_service_has_the_keys_of_another(secured_rig: "ComposedRig") -> None:
    listed = {
        service: secured_rig.inside(service, "ls", "/run/secrets").split() for service in ("plant", "control-plc")
    }
    assert listed["plant"] == ["ca.crt", "mqtt_password", "reader.crt", "reader.key", "server.crt", "server.key"]
    assert listed["control-plc"] == sorted([*listed["plant"], "client.crt", "client.key"])


def test_a_run_attaches_with_the_certificates_of_the_site(
    secured_rig: "ComposedRig", certificate_folder: Path, coldloop: "Callable[..., None]", tmp_path: Path
) -> None:
    rig = secured_rig
    endpoints = [f"127.0.0.1:{port}" for port in (rig.plant, rig.control_plc, rig.optimizer_plc)]
    scenario = ["--load", "a", "--duration", "1min", "--out", str(tmp_path / "run")]
    coldloop("--config", str(certificate_folder / "tls.toml"), "--attach", *endpoints, *scenario)


def test_the_page_reads_as_a_reader_and_commands_as_an_operator(secured_rig: "ComposedRig") -> None:
    assert_an_operator_changes_the_load(secured_rig.page)
    assert "client.key" in secured_rig.inside("page", "ls", "/run/secrets").split()
