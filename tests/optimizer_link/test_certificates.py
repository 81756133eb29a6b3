"""Certificates of the link: one that is not trusted is waited out, and a renewed one is taken without a restart."""

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.modbus.settings import TlsSettings
from coldloop.registers.optimizer_plc import ControlLinkState, ControlLinkStatus
from coldloop_optimizer_plc.runtime import OptimizerPlc
from coldloop_optimizer_plc.settings import OptimizerSettings
from coldloop_rig.cli.certificates import Authority, Pair

if TYPE_CHECKING:
    from tests.optimizer_link.conftest import Listen, PlayedControlPlc, Until


def keep(folder: Path, name: str, pair: Pair, authority: Authority) -> TlsSettings:
    """Write the files of one end; its authority is the one that it trusts."""
    files = {"certificate": pair.certificate_pem, "key": pair.key_pem, "ca": authority.pair.certificate_pem}
    for kind, content in files.items():
        (folder / f"{name}.{kind}").write_bytes(content)
    return TlsSettings(**{kind: folder / f"{name}.{kind}" for kind in files})


def reasons(log: pytest.LogCaptureFixture) -> list[str]:
    return [vars(record)["reason"] for record in log.records if record.message == "control PLC lost"]


async def test_a_certificate_that_is_renewed_is_taken_without_a_restart(
    listen: "Listen",
    until: "Until",
    control: "PlayedControlPlc",
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    ours, strangers = Authority.new("site", 1), Authority.new("elsewhere", 1)
    there = keep(tmp_path, "there", ours.issue_server("there", ["127.0.0.1"]), ours)
    here = keep(tmp_path, "here", ours.issue_client("here", "optimizer"), strangers)
    async with listen(control.bank, control.on_write, tls=there) as server:
        endpoint = {"host": "127.0.0.1", "port": server.port, "tls": here}
        optimizer = OptimizerPlc(OptimizerSettings.model_validate({"optimizer_plc": {"control_plc": endpoint}}))
        running = asyncio.create_task(optimizer.run())
        await until(lambda: "control PLC lost" in caplog.messages)
        (reason,) = reasons(caplog)
        assert "cannot be trusted" in reason
        assert not running.done()

        (tmp_path / "here.ca").write_bytes(b"half a file")
        await until(lambda: "no PEM certificate" in reasons(caplog)[-1])
        (tmp_path / "here.ca").write_bytes(ours.pair.certificate_pem)
        control.latch()
        shown = optimizer.publication.bank
        await until(lambda: len(control.headers) > 1)
        assert shown.get(ControlLinkStatus).state >= ControlLinkState.WAITING
        running.cancel()
        await asyncio.wait({running})
        optimizer.close()
