"""Services that compile kernels write so to their logs: the user reads it on standard error, once."""

import asyncio
import json
from pathlib import Path

import pytest

from coldloop_rig.cosim import networked_run
from coldloop_rig.cosim.networked_run import show_compiling

SERVES = '{"event": "serving", "port": 5020}\n'


def compiles(owner: str) -> str:
    return json.dumps({"event": "compiling kernels", "kernels": owner, "about_s": 20}) + "\n"


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    monkeypatch.setattr(networked_run, "LOOK_S", 0.01)
    monkeypatch.setattr(networked_run, "TOGETHER_S", 0.05)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    paths = [tmp_path / name for name in ("plant.log", "control_plc.log", "optimizer_plc.log")]
    for path in paths:
        path.write_text("")
    return paths


def test_services_that_compile_at_once_are_one_line(logs: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    async def story() -> None:
        showing = asyncio.create_task(show_compiling(logs))
        await asyncio.sleep(0.02)
        logs[0].write_text(compiles("the refrigerator"))
        logs[1].write_text(SERVES)
        logs[2].write_text(compiles("the ode solver"))
        await showing

    asyncio.run(story())
    assert capsys.readouterr().err == (
        "coldloop: compiling the kernels of the refrigerator and of the ode solver; this takes about 20 s and happens"
        " once\n"
    )


def test_services_that_serve_at_once_are_not_mentioned(logs: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    for log in logs:
        log.write_text('no JSON\n{"no": "event"}\n[]\n' + SERVES)
    asyncio.run(show_compiling(logs))
    assert not capsys.readouterr().err
