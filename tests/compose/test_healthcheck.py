"""What the containers' health check says of servers, right and wrong; needs no container."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[2] / "docker" / "healthcheck.py"


def check(port: int) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "SERVICE": "control_plc", "COLDLOOP__CONTROL_PLC__SERVER__PORT": str(port)}
    command = [sys.executable, "-I", "-S", str(PROGRAM)]
    return subprocess.run(command, env=environment, check=False, capture_output=True, text=True, timeout=30)


@pytest.fixture(params=["high-first", "low-first"])
def control_plc(request: pytest.FixtureRequest, free_port: int) -> Iterator[int]:
    settings = [f"server.port={free_port}", f"word_order={request.param}", "plant.port=1", "plant.patience_s=60"]
    command = [sys.executable, "-m", "control_plc", *[f"--set=control_plc.{setting}" for setting in settings]]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield free_port
    finally:
        process.terminate()
        process.wait(timeout=20)


def test_a_service_that_answers_is_healthy(control_plc: int) -> None:
    deadline = time.monotonic() + 20
    while (done := check(control_plc)).returncode and time.monotonic() < deadline:
        time.sleep(0.2)
    assert done.returncode == 0, done.stderr


def test_a_port_on_which_nobody_listens_is_not(free_port: int) -> None:
    done = check(free_port)
    assert done.returncode == 1
    assert "control_plc on port" in done.stderr


def test_nor_is_a_server_of_something_else() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with server.accept()[0] as connection:
                connection.recv(100)
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        done = check(server.getsockname()[1])
        thread.join()
    assert done.returncode == 1
    assert "not a register map of ours" in done.stderr
