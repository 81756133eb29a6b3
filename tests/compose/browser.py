"""The page of a composed rig, asked as a browser on this machine asks it."""

import json
import time
import urllib.error
import urllib.request
from typing import Any

OPERATOR = {"user": "operator", "password": "test-site-operator"}
PATIENCE_S = 60.0


class Browser:
    """Asks the page as a browser on this machine does, logged in or not."""

    def __init__(self, port: int) -> None:
        self._address = f"http://127.0.0.1:{port}"
        self._cookie = ""

    def ask(self, path: str, body: object = None) -> tuple[int, Any]:
        request = urllib.request.Request(self._address + path)  # noqa: S310 our own page
        if body is not None:
            request.data = json.dumps(body).encode()
            request.add_header("Content-Type", "application/json")
            request.add_header("Origin", self._address)
        if self._cookie:
            request.add_header("Cookie", self._cookie)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:  # noqa: S310
                self._cookie = (answer.headers["Set-Cookie"] or self._cookie).partition(";")[0]
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as refusal:
            with refusal:
                return refusal.code, json.loads(refusal.read())

    def values(self) -> dict[str, Any]:
        """Return what the page shows now, by name."""
        status, state = self.ask("/api/state")
        assert status == 200
        values: dict[str, Any] = state["values"]
        return values

    def command(self, **command: object) -> Any:  # noqa: ANN401 JSON
        """Carry a command out in its two steps; return how it ended."""
        status, proposal = self.ask("/api/commands", command)
        assert status == 200, proposal
        _, outcome = self.ask(f"/api/commands/{proposal['token']}", {})
        return outcome


def eventually_shows(browser: Browser, name: str, wanted: float) -> None:
    """Wait for the page to show a value."""
    deadline = time.monotonic() + PATIENCE_S
    while browser.values().get(name) != wanted:
        assert time.monotonic() < deadline, f"{name} is {browser.values().get(name)}, not {wanted}"
        time.sleep(0.2)


def assert_an_operator_changes_the_load(port: int) -> None:
    """The page shows all services to everybody; who is logged in as an operator can write to them."""
    browser = Browser(port)
    assert browser.ask("/healthz")[0] == 200
    assert browser.ask("/api/commands", {"kind": "load", "watts": 450})[0] in {401, 403}, "nobody is logged in"
    assert browser.ask("/api/login", {**OPERATOR, "password": "test-site"})[0] == 401
    assert browser.ask("/api/login", OPERATOR)[0] == 200
    outcome = browser.command(kind="load", watts=440)
    assert outcome["applied"], outcome
    eventually_shows(browser, "control_plc.process.load", 440)
