"""Whether the operator's page shows what is in the registers: every value and its quality, on four processes.

A rig with its page is up in real time. Registers are read three times around a look at the page, at the addresses of
`coldloop registers`. What was the same each time is compared with the drawing, bars, header, commands, the table of all
registers, the alarms, API, trend and CSV: at paused ticks under MPC, in manual and with each sensor fault; with each
service suspended, and after it was killed; with each link cut; with the page's own server killed. Then a run with
sensor faults and a kill is replayed and compared with its files. Needs chromium and playwright.

    .venv/bin/python benchmarks/page_truth.py                        # half an hour
    .venv/bin/python benchmarks/page_truth.py --only single --short  # one process, MPC and replay
"""

import argparse
import csv
import io
import json
import math
import os
import re
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import psutil
import pyarrow.parquet as pq
from page_rig import PROCESSES, SERVICES, Rig, eventually
from playwright.sync_api import Page, sync_playwright

ORDER: Final = ("good", "suspect", "held", "bad", "stale", "simulated")
STATES: Final = ("normal", "unacknowledged", "acknowledged", "returned", "shelved", "out of service")
DASH: Final = "\N{EN DASH}"
HOLD, MPC, MANUAL = 0, 1, 4
OURS: Final = frozenset(f"{service}.statistics.connections" for service in SERVICES)
"""Registers that this program changes."""
SLOW_S: Final = 1.8
"""The page reads what it reads least often once a second."""
LOOK: Final = """() => [...document.querySelectorAll("header [data-signal], main [data-signal]")].map((one) => {
  const part = one.matches(".bar") ? one.querySelector(".reading") : one;
  const text = one.matches(".tag") ? one.querySelector(".reading").textContent : part.textContent;
  const quality = part.dataset.quality || "good";
  return [one.dataset.signal, one.dataset.as || "", text, quality, part.classList.contains("stale")];
})"""
ALARMS: Final = """() => [...document.querySelectorAll("#alarm-table tbody tr[data-alarm]")]
  .map((one) => [...one.cells].map((cell) => cell.textContent))"""
CROSSED: Final = """(service) => {
  const own = [...document.querySelectorAll("main td.value[data-signal]")]
    .filter((one) => one.dataset.signal.startsWith(service));
  return own.length > 0 && own.every((one) => one.classList.contains("stale"));
}"""
GO_TO: Final = """(tick) => fetch("api/replay", { method: "POST", body: JSON.stringify({ tick }),
  headers: { "Content-Type": "application/json" } }).then((answer) => answer.json())"""
FAULT: Final = '[[faults]]\nkind = "sensor"\noutput = "{}"\nat_s = {}\nduration_s = {}\nshows = "{}"\n'
KILL: Final = '[[faults]]\nkind = "kill"\nprocess = "optimizer"\nat_s = {}\nduration_s = {}\n'


class Tally:
    """What was compared, by kind, and how much of it was wrong."""

    def __init__(self) -> None:
        self.compared: Counter[str] = Counter()
        self.wrong = self.moved = 0
        self.where = ""

    def check(self, kind: str, *what: object, is_right: bool) -> None:
        """Count a comparison; print what is wrong."""
        self.compared[kind] += 1
        if not is_right:
            self.wrong += 1
            print("WRONG", self.where, kind, *what, flush=True)


def near(one: float | None, other: float) -> bool:
    """Return whether an answer has a value of single precision; null is not a number."""
    if one is None or math.isnan(other):
        return one is None and math.isnan(other)
    return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-12)


def says(about: Mapping[str, Any], value: float, text: str, how: str, tick_s: float) -> bool:
    """Return whether a text says what a register has, to its last digit and with its unit."""
    if text == DASH or math.isnan(value):
        return text == DASH and math.isnan(value)
    if found := re.search(r"\((?:tick )?(-?\d+)(?: ticks)?\)", text):
        return int(found[1]) == value
    if re.fullmatch(r"-?\d+:\d\d:\d\d(\.\d+)?", text):
        hours, minutes, seconds = text.split(":")
        return abs(3600 * int(hours) + 60 * int(minutes) + float(seconds) - value * tick_s) <= 0.0051
    if not re.match(r"-?\d", text):
        return f"{int(value)} {text.lower()}" in about["description"].lower() or (
            how == "pace" and f"{value:g}" in text
        )
    number, _, unit = text.partition(" ")
    if how == "ticks":
        return abs(float(number) - value * tick_s) <= 0.0051
    mantissa, _, power = number.partition("e")
    half = 0.5 * 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    return abs(float(number) - value) <= 1.002 * half + 1e-6 * abs(value) and unit == about["unit"]


def is_unwritten(name: str, text: str, same: Mapping[str, float]) -> bool:
    """Return whether a dash is shown of a block that nobody has written yet: its check sum is 0."""
    service, block, _ = name.split(".", 2)
    return text == DASH and same.get(f"{service}.{block}.crc") == 0


def quality_of(rig: Rig, name: str, bits: Mapping[str, int], stale: frozenset[str]) -> str:
    """Return the worst quality of a signal by the registers; `stale` has beginnings of names."""
    _, block, label = name.split(".", 2)
    found = ["good"]
    found += ["stale"] * any(name.startswith(one) for one in stale)
    found += ["simulated"] * ("Simulated" in rig.about[name]["description"])
    if label.startswith("y.") and block in {"process", "measurement", "update"} and label[2:] in rig.outputs:
        bit = 1 << rig.outputs.index(label[2:])
        found += [kind for kind in ("suspect", "simulated") if bits[kind] & bit]
        found += ["held" if block == "process" else "bad"] * bool(bits["held"] & bit)
    return max(found, key=ORDER.index)


def look(rig: Rig, page: Page, tally: Tally, *silent: str) -> None:
    """Compare all that is shown with registers that were the same before, meanwhile and after; some are silent."""
    rig.silent = frozenset(silent)
    first, alarms = rig.values(), rig.alarms()
    time.sleep(SLOW_S)
    second = rig.values()
    names = ",".join(rig.outputs[:8])
    shown, rows = page.evaluate(LOOK), page.evaluate(ALARMS)
    api = json.loads(rig.ask("/api/state"))
    trend = json.loads(rig.ask(f"/api/trend?names={names}&seconds=60&points=4000"))
    table = list(csv.reader(io.StringIO(rig.ask(f"/api/trend.csv?names={names}&seconds=10"))))
    tau = page.text_content("#tau-u") or "", page.locator("#tau-u.stale").count()
    time.sleep(0.5)
    third, still = rig.values(), rig.alarms() == alarms
    same = {
        name: value
        for name, value in first.items()
        if repr(value) == repr(second[name]) == repr(third[name]) and name not in OURS
    }
    tally.moved += len(first) - len(same)
    stale = frozenset(f"{service}." for service in silent)
    is_paused = bool(same.get("plant.pace.paused"))
    if not is_paused:
        same.pop("plant.watchdog.remaining", None)  # between two values, thousands of times
    if "control_plc.process.tick" in same and not is_paused:
        stale |= {"control_plc.process."}
    bits = bits_of(rig, same)
    for name, how, text, quality, is_crossed in shown:
        if name in same:
            right = is_unwritten(name, text, same) or says(rig.about[name], same[name], text, how, rig.tick_s)
            tally.check("value", name, text, same[name], is_right=right)
        if name in rig.about and bits is not None:
            wanted = quality_of(rig, name, bits, stale)
            tally.check("quality", name, quality, wanted, bits, is_right=quality == wanted)
            is_held = name.startswith("control_plc.process.y.") and bits["held"] >> rig.outputs.index(name[22:]) & 1
            crosses = bool(is_held) or any(name.startswith(one) for one in stale)
            tally.check("crossed out", name, is_crossed, crosses, is_right=is_crossed == crosses)
    for name, value in api["values"].items():
        if name in same:
            tally.check("API", name, value, same[name], is_right=near(value, same[name]))
    if alarms and still:
        check_alarms(tally, rows, alarms)
    if is_paused and bits is not None and not silent:
        check_trend(rig, tally, same, trend, table, bits)
        check_tau(rig, tally, tau, same)
    rig.silent = frozenset()


def bits_of(rig: Rig, same: Mapping[str, float]) -> dict[str, int] | None:
    """Return which outputs are in doubt by the registers; None where these have changed meanwhile."""
    if "control_plc" in rig.silent:
        return None
    names = ("control_plc.ladder.mode", "control_plc.ladder.bad_sensors", "control_plc.plan.suspects")
    if not all(name in same for name in names):
        return None
    mode, held, suspects = (int(same[name]) for name in names)
    if "plant" not in rig.silent:
        faults = rig.rows("plant", "sensor faults")[: len(rig.outputs)]
        rig.faults = sum((row["kind"] != 0) << i for i, row in enumerate(faults))
    return {"suspect": suspects if mode in {1, 3} else 0, "held": held, "simulated": rig.faults}


def check_alarms(tally: Tally, shown: list[list[str]], rows: list[dict[str, float]]) -> None:
    """Compare states and counts of the alarms; those of outputs that a process has not may be left out."""
    known = Counter((STATES[int(row["state"])], int(row["times"])) for row in rows)
    words = ("returned", "unacknowledged", *STATES)  # what has others in it comes first
    told = Counter((next(word for word in words if word in cells[2]), int(cells[5])) for cells in shown)
    hidden = known - told
    is_right = not told - known and all(state == "normal" for state, _ in hidden)
    tally.check("alarms", dict(told), dict(known), is_right=is_right)


def check_trend(
    rig: Rig,
    tally: Tally,
    same: Mapping[str, float],
    trend: dict[str, Any],
    table: list[list[str]],
    bits: Mapping[str, int],
) -> None:
    """Compare the newest sample of trend and CSV, and what is said of its quality."""
    header, last = table[0], table[-1]
    doubts = dict(one.split("=") for one in last[-1].split())
    for name in rig.outputs[:8]:
        value = same[f"control_plc.process.y.{name}"]
        tally.check("trend", name, trend["series"][name][-1], value, is_right=near(trend["series"][name][-1], value))
        tally.check("CSV", name, last, value, is_right=near(float(last[header.index(name)]), value))
        wanted = quality_of(rig, f"control_plc.process.y.{name}", bits, frozenset())
        tally.check("CSV quality", name, doubts, wanted, is_right=doubts.get(name, "good") == wanted)
        now = [one[2] for one in trend["doubtful"].get(name, []) if one[1] >= trend["now_s"]] or ["good"]
        tally.check("trend quality", name, now, wanted, is_right=now[-1] == wanted)


def check_tau(rig: Rig, tally: Tally, tau: tuple[str, int], same: Mapping[str, float]) -> None:
    """Compare the newest updating period, and whether it is in use."""
    newest = max(rig.rows("optimizer_plc", "history"), key=lambda row: row["tick"])
    shown = float(tau[0].split()[0])
    tally.check("tau_u", tau, newest, is_right=abs(shown - newest["tau_u"] * rig.tick_s) < 0.0051)
    tally.check("tau_u in use", tau, is_right=bool(tau[1]) == (same["control_plc.ladder.mode"] != MPC))


def paused(rig: Rig, page: Page, tally: Tally, where: str) -> None:
    """Look while plant time is paused."""
    tally.where = f"{rig.name}, {where}"
    rig.tell("set", "pause")
    time.sleep(SLOW_S)
    look(rig, page, tally)
    rig.tell("set", "resume")


def live(rig: Rig, page: Page, tally: Tally, *, is_short: bool) -> None:
    """Go through modes, sensor faults, and services and links that fail; in short, look once."""
    first, last = rig.outputs[0], rig.outputs[-1]
    rig.drives(MPC)
    eventually(lambda: int(page.get_attribute("body", "data-tick") or 0) > 200, "some ticks")
    paused(rig, page, tally, "MPC")
    if is_short:
        return
    rig.tell("set", "mode", "manual")
    rig.drives(MANUAL)
    paused(rig, page, tally, "manual")
    rig.tell("set", "mode", "auto")
    rig.drives(MPC)
    near_value = 1.02 * rig.rows("control_plc", "process")[0][f"y.{last}"]
    for output, shows, wait_s in ((first, "dead", 4), (first, "stuck", 4), (first, "0", 4), (first, "none", 4),
                                  (last, f"{near_value:.6g}", 8)):  # fmt: skip
        rig.tell("fault", "sensor", output, shows)
        time.sleep(wait_s)
        paused(rig, page, tally, f"{output} {shows}")
    rig.tell("fault", "sensor", last, "none")
    rig.faults = 0
    for service in SERVICES:
        rig.drives(MPC)
        tally.where = f"{rig.name}, {service} suspended"
        fault = rig.start("fault", "pause", service, 12)
        eventually(lambda: page.evaluate(CROSSED, f"{service}."), f"{service} is crossed out")  # noqa: B023 called at once
        time.sleep(SLOW_S)
        look(rig, page, tally, service)
        fault.communicate()
        eventually(rig.is_live, "all answer")
    for service in SERVICES:
        rig.drives(MPC)
        begun = time.monotonic()
        rig.tell("fault", "kill", service)
        eventually(lambda: page.evaluate(CROSSED, f"{service}."), f"{service} is crossed out")  # noqa: B023
        print(f"{rig.name}: {service} killed, crossed out after {time.monotonic() - begun:.1f} s, a command included")
        eventually(rig.is_live, "all answer")
        eventually(lambda: not page.evaluate(CROSSED, f"{service}."), "it is current again")  # noqa: B023
        paused(rig, page, tally, f"after {service} was killed")
    for link in ("plant", "optimizer"):
        rig.drives(MPC)
        tally.where = f"{rig.name}, link {link} cut"
        fault = rig.start("fault", "cut", link, 12)
        time.sleep(7.0)
        look(rig, page, tally)
        fault.communicate()
        rig.drives(MPC)
        paused(rig, page, tally, f"after link {link} was cut")
    tally.where = f"{rig.name}, the page's own server killed"
    port = rig.base + 9
    own = next(one for one in psutil.net_connections("tcp") if one.laddr.port == port and one.status == "LISTEN")
    os.kill(own.pid or 0, signal.SIGKILL)
    eventually(lambda: all(page.evaluate(CROSSED, f"{one}.") for one in SERVICES), "all is crossed out")


def replay(rig: Rig, page: Page, tally: Tally) -> None:
    """Compare a recorded run, at sixty of its ticks, with its files."""
    first, t = rig.outputs[0], rig.tick_s
    plan, out = rig.folder / "plan.toml", rig.folder / "run"
    shown = ("nan", "frozen", "value")
    faults = [FAULT.format(first, (200 + 160 * i) * t, 80 * t, one) for i, one in enumerate(shown)]
    text = [f'name = "truth"\ndescription = "Sensors and a kill"\nload = "a"\nduration_s = {900 * t}\n', *faults]
    plan.write_text("".join([*text, "value = 0\n", KILL.format(680 * t, 60 * t)]), encoding="utf-8")
    rig.run("chaos", plan, "--out", out, *rig.kind)
    run = next(one.parent for one in out.rglob("trace.parquet"))
    trace = pq.read_table(run / "trace.parquet").to_pylist()
    events = sorted(pq.read_table(run / "events.parquet").to_pylist(), key=lambda one: one["tick"])
    served = rig.start("page", run, "--page-port", rig.base + 8, ports=False)
    rig.address = (served.stdout.readline() if served.stdout else "").strip().rstrip("/")
    page.goto(rig.address + "/")
    page.wait_for_selector("body[data-tick]")
    for tick in range(5, len(trace), len(trace) // 60):
        tally.where = f"{rig.name}, replay at {tick}"
        page.evaluate(GO_TO, tick)
        eventually(lambda: page.get_attribute("body", "data-tick") == str(tick), "the replay is there")  # noqa: B023
        row, doubts = trace[tick], of_events(events, tick)
        for name, how, text_, quality, _ in page.evaluate(LOOK):
            label = name.removeprefix("control_plc.process.")
            column = next((one for one in ("load_w", "load") if one in row), "") if label == "load" else label[2:]
            if label == name or column not in row:
                continue
            right = says(rig.about[name], row[column], text_, how, t)
            tally.check("replay value", name, text_, row[column], is_right=right)
            if label.startswith("y."):
                found = ["good", *doubts.get(column, [])] + ["bad"] * (column in (row["bad_sensors"] or "").split())
                wanted = max(found, key=ORDER.index)
                tally.check("replay quality", name, quality, wanted, is_right=quality == wanted)
        table = rig.ask(f"/api/trend.csv?names={first}&seconds={t:g}").splitlines()[-1].split(",")
        tally.check("replay CSV", table, row[first], is_right=near(float(table[1]), row[first]))
    served.send_signal(signal.SIGINT)
    served.wait(30)


def of_events(events: list[dict[str, Any]], tick: int) -> dict[str, list[str]]:
    """Return which outputs are suspect or faulty at a tick, by the journals of the run."""
    state: dict[str, dict[str, bool]] = {}
    for one in (each for each in events if each["tick"] <= tick):
        known = state.setdefault(one["subject"], {})
        if one["kind"] == "sensor":
            known["suspect"] = one["cause"] == "suspect"
        elif one["kind"] == "sensor fault":
            known["simulated"] = one["cause"] != "none"
    return {name: [kind for kind, holds in known.items() if holds] for name, known in state.items()}


def main(options: argparse.Namespace) -> None:
    """Go through the processes; print what was compared."""
    with sync_playwright() as playwright:
        path = os.environ.get("COLDLOOP_BROWSER") or shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        for place, name in enumerate(PROCESSES):
            if options.only not in {"", name}:
                continue
            tally = Tally()
            with tempfile.TemporaryDirectory() as folder:
                rig = Rig(name, Path(folder), options.port_base + 20 * place)
                page = browser.new_page(viewport={"width": 1280, "height": 720})
                try:
                    page.goto(rig.address + "/")
                    page.wait_for_selector("body[data-tick]")
                    live(rig, page, tally, is_short=options.short)
                finally:
                    rig.end()
                replay(rig, page, tally)
                page.close()
            counts = ", ".join(f"{count} {what}" for what, count in sorted(tally.compared.items()))
            print(f"{name}: {tally.compared.total()} compared ({counts}), {tally.wrong} wrong; "
                  f"{tally.moved} readings of registers that moved were left out", flush=True)  # fmt: skip
        browser.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", choices=tuple(PROCESSES), metavar="PROCESS", help="one of the processes")
    parser.add_argument("--short", action="store_true", help="MPC and replay only")
    parser.add_argument("--port-base", type=int, default=7100, help="20 ports for each process from there on")
    main(parser.parse_args())
