"""A rig with its page for `page_truth.py`: its processes, and its registers read with nothing but a socket."""

import json
import re
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

SERVICES: Final = ("plant", "control_plc", "optimizer_plc")
FORMATS: Final = {"float32": "f", "uint32": "I", "uint16": "H", "int16": "h", "int32": "i"}
PATIENCE_S: Final = 90.0
_INPUT: Final = '[[inputs]]\nname = "{}"\nunit = "{}"\nat = {}\nlow = {}\nhigh = {}\nrate = {}\n'
_OUTPUT: Final = '[[outputs]]\nname = "{}"\nunit = "{}"\nat = {}\nrange = [{}, {}]\nnoise = {}\n{}\n'
_LAG: Final = '[[plant.transfer_functions]]\noutput = "{}"\nsource = "{}"\ngain = {}\ntime_constant_s = {}\n'
_VESSEL: Final = "".join([
    'name = "vessel"\n', _INPUT.format("feed", "%", 50, 0, 100, 2), _INPUT.format("vent", "%", 40, 0, 100, 2),
    _OUTPUT.format("p1", "Pa", 150000, 0, 400000, 20, "band = [149000, 151000]"),
    _OUTPUT.format("p2", "Pa", 101300, 0, 200000, 5, "band = [101200, 101400]"),
    _OUTPUT.format("T", "K", 300, 0, 500, 0.05, ""),
    '[load]\nname = "draw"\nunit = "g/s"\nat = 0\nspan = [-5, 5]\n[plant]\n',
    _LAG.format("p1", "feed", 800, 60), _LAG.format("p1", "draw", -300, 60), _LAG.format("p2", "vent", -40, 30),
    _LAG.format("p2", "draw", -10, 30), _LAG.format("T", "feed", 0.2, 90),
])  # fmt: skip
_SINGLE: Final = "".join([
    'name = "single"\n', _INPUT.format("drive", "V", 2, 0, 4, 0.2),
    _OUTPUT.format("gap", "mm", 20, -10, 60, 0.01, "setpoint = 20.5\ntolerance = 0.2"), "[plant]\n",
    _LAG.format("gap", "drive", 3, 20),
])  # fmt: skip
PROCESSES: Final = {"cold box": "", "refrigerator": "", "Pa": _VESSEL, "single": _SINGLE}
"""Process files by name; none is the cold box's own."""


def eventually(condition: Callable[[], Any], what: str, seconds: float = PATIENCE_S) -> None:
    """Wait until a condition holds.

    Raises:
        TimeoutError: It does not.
    """
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(what)
        time.sleep(0.05)


def read(port: int, address: int, words: int) -> bytes:
    """Read holding registers.

    Raises:
        OSError: Nobody answers.
    """
    with socket.create_connection(("127.0.0.1", port), 5.0) as bus:
        bus.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 255, 3, address, words))
        answer = b""
        while len(answer) < 9 + 2 * words:
            part = bus.recv(1024)
            if not part:
                raise ConnectionError
            answer += part
    return answer[9:]


class Rig:
    """A rig that is up, with its page.

    Args:
        name: One of `PROCESSES`.
        folder: For its files.
        base: First of ten ports.
    """

    def __init__(self, name: str, folder: Path, base: int) -> None:
        self.name, self.base, self.folder = name, base, folder
        self.address = f"http://127.0.0.1:{base + 9}"
        self.kind = ("--set", "plant.kind=refrigerator") if name == "refrigerator" else ()
        self.silent: frozenset[str] = frozenset()
        """Services that are not asked."""
        self.faults = 0
        """Outputs with a sensor fault, a bit for each, as read last."""
        self._process: tuple[str, ...] = ()
        if PROCESSES[name]:
            (folder / "process.toml").write_text(PROCESSES[name], encoding="utf-8")
            self.run("process", folder / "process.toml", "--out", folder / "model.json")
            self._process = ("--process", str(folder / "model.json"))
        self.blocks: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for one in json.loads(self.run("registers", "--format", "json")):
            if one["type"] in FORMATS:
                self.blocks.setdefault((one["service"], one["block"]), []).append(one)
        rows = [one for fields in self.blocks.values() for one in fields if one["rows"] == 1]
        self.about = {f"{one['service']}.{one['block']}.{one['name']}": one for one in rows}
        process = [one["name"] for one in self.blocks["control_plc", "process"]]
        self.outputs = [each.removeprefix("y.") for each in process if each.startswith("y.")]
        options = ("--page-port", base + 9, "--factor", 4, "--cuttable", "--set", "hmi.training=true", *self.kind)
        self._up = self.start("up", *options)
        said, found = "", None
        while found is None:
            line = self._up.stdout.readline() if self._up.stdout else ""
            if not line:
                raise RuntimeError(said)
            said += line
            found = re.search(r"to operate ", said)
        self.tick_s: float = json.loads(self.ask("/api/catalog"))["tick_s"]

    def run(self, *words: object) -> str:
        """Run a command of Coldloop to its end; return what it printed."""
        command = [sys.executable, "-m", "coldloop_rig", *self._process_of(words), *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode not in {0, 3}:
            raise RuntimeError(f"{words}: {done.stdout} {done.stderr}")
        return done.stdout

    def start(self, *words: object, ports: bool = True) -> subprocess.Popen[str]:
        """Start a command, by default on the ports of this rig."""
        more = ("--port-base", str(self.base)) if ports else ()
        command = [sys.executable, "-m", "coldloop_rig", *self._process_of(words), *map(str, words), *more]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def _process_of(self, words: tuple[object, ...]) -> tuple[str, ...]:
        return () if words[0] == "process" else self._process

    def tell(self, *words: object) -> None:
        """Give a command to this rig."""
        self.run(*words, "--port-base", self.base)

    def rows(self, service: str, block: str) -> list[dict[str, float]]:
        """Return the rows of a block.

        Raises:
            OSError: The service does not answer.
        """
        fields = self.blocks[service, block]
        start, words, count = fields[0]["address"], fields[0]["row_words"], fields[0]["rows"]
        at_once, found = max(1, 125 // words), []
        for first in range(0, count, at_once):
            some = min(at_once, count - first)
            raw = read(self.base + SERVICES.index(service), start + first * words, some * words)
            for row in range(some):
                places = [(one, 2 * (row * words + one["address"] - start)) for one in fields]
                found.append({a["name"]: struct.unpack_from(">" + FORMATS[a["type"]], raw, at)[0] for a, at in places})
        return found

    def values(self) -> dict[str, float]:
        """Return all registers of blocks with one row, of the services that are asked."""
        found: dict[str, float] = {}
        for (service, block), fields in self.blocks.items():
            if fields[0]["rows"] == 1 and service not in self.silent:
                found |= {f"{service}.{block}.{name}": one for name, one in self.rows(service, block)[0].items()}
        return found

    def alarms(self) -> list[dict[str, float]]:
        """Return the rows of the alarms; none where the control PLC is not asked."""
        return [] if "control_plc" in self.silent else self.rows("control_plc", "alarms")

    def ask(self, path: str) -> str:
        """Ask the page's server."""
        with urllib.request.urlopen(self.address + path, timeout=20) as answer:  # noqa: S310 our own page
            return str(answer.read().decode())

    def is_live(self) -> bool:
        """Return whether all services answer the page."""
        try:
            return "false" not in self.ask("/healthz")
        except OSError:
            return False

    def drives(self, mode: int) -> None:
        """Wait until a mode drives."""
        eventually(lambda: self.rows("control_plc", "ladder")[0]["mode"] == mode, f"mode {mode}")

    def end(self) -> None:
        """End it."""
        self._up.send_signal(signal.SIGINT)
        self._up.wait(30)
