"""The rig with Modbus/TCP Security, as both compose files together bring it up: certificates say who may do what."""

import contextlib
import socket
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.endpoints import Endpoint
from coldloop.errors import RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.settings import TlsSettings
from coldloop.registers.common import Identity
from coldloop.registers.plant import PLANT_MAP, Actuators, LoadStep

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import ComposedRig


MAGIC = bytes.fromhex("42f6e979")


def client_of_plant(rig: "ComposedRig", site: Path, name: str) -> RegisterClient:
    tls = TlsSettings(certificate=site / f"{name}.crt", key=site / f"{name}.key", ca=site / "ca.crt")
    return RegisterClient.at(PLANT_MAP, Endpoint(port=rig.plant, timeout_s=5.0, tls=tls))


async def test_the_rig_runs_and_its_certificates_say_who_writes(secured_rig: "ComposedRig", site: Path) -> None:
    operator = client_of_plant(secured_rig, site, "operator")
    try:
        await operator.connect(5.0)
        assert (await operator.read(Identity)).session == 1
        await operator.write_rows([LoadStep(0, 385.0)])
        with pytest.raises(RequestRefusedError):
            await operator.write(Actuators(0, 50.0, 50.0, 50.0, 1))
    finally:
        operator.close()


def test_nobody_is_answered_without_tls(secured_rig: "ComposedRig") -> None:
    with socket.create_connection(("127.0.0.1", secured_rig.plant), 5) as connection:
        connection.sendall(bytes.fromhex("000100000006ff0300000002"))
        with contextlib.suppress(ConnectionResetError):
            assert MAGIC not in connection.recv(1000)


def test_no_service_has_the_keys_of_another(secured_rig: "ComposedRig") -> None:
    listed = {
        service: secured_rig.inside(service, "ls", "/run/secrets").split() for service in ("plant", "control-plc")
    }
    assert listed["plant"] == ["ca.crt", "mqtt_password", "reader.crt", "reader.key", "server.crt", "server.key"]
    assert listed["control-plc"] == sorted([*listed["plant"], "client.crt", "client.key"])


def test_a_run_attaches_with_the_certificates_of_the_site(
    secured_rig: "ComposedRig", site: Path, coldloop: "Callable[..., None]", tmp_path: Path
) -> None:
    rig = secured_rig
    endpoints = [f"127.0.0.1:{port}" for port in (rig.plant, rig.control_plc, rig.optimizer_plc)]
    scenario = ["--load", "a", "--duration", "1min", "--out", str(tmp_path / "run")]
    coldloop("--config", str(site / "tls.toml"), "--attach", *endpoints, *scenario)
