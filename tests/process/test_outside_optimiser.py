"""An optimiser that is not ours drives another process by its register map; one that breaks off does no harm."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from coldloop.registers.control_plc import Mode
from tests.harness.processes import Processes
from tests.process.outside_client import ACCEPTED, BEGIN_AGAIN, Blocks, Loop, Optimiser, Plant, Service, blocks_of
from tests.process.runs import started

EXAMPLES: Final = Path(__file__).parents[2] / "examples" / "processes"
PATIENCE_S: Final = 120.0
TICK_S: Final = 0.05
"""Real time of a tick."""
PERIOD: Final = 20
"""The updating period, ticks."""
ROUNDING: Final = 1e-5
"""Of single precision, share of the range."""


class Case(NamedTuple):
    """A shipped process and its PI controllers, with what its file says of bounds and rates."""

    file: Path
    tick_s: float
    loops: tuple[Loop, ...]


TANK: Final = Case(
    EXAMPLES / "quadruple_tank.toml",
    0.25,
    (Loop("v1", "h1", 2.0, 60.0, 12.3, 0.0, 10.0, 0.5), Loop("v2", "h2", 2.0, 60.0, 12.8, 0.0, 10.0, 0.5)),
)
COLUMN: Final = Case(
    EXAMPLES / "wood_berry.toml",
    3.0,
    (
        Loop("reflux", "xD", 0.2, 300.0, 96.25, 1.2, 2.7, 0.05),
        Loop("steam", "xB", -0.04, 240.0, 0.5, 1.0, 2.4, 0.05),
    ),
)


class Site(NamedTuple):
    """A rig of a process that is up without an optimiser, and clients of it that know its listed registers alone."""

    case: Case
    control_blocks: Blocks
    port: int
    """Of the control PLC."""
    plant: Plant
    control: Service

    def optimiser(self) -> Optimiser:
        return Optimiser(self.control_blocks, self.port, self.case.loops, self.case.tick_s, PERIOD)

    def drives(self, optimiser: Optimiser, sequences: int) -> None:
        """Answer updates until so many sequences have been accepted and one is being played; on time is expected."""
        verdicts: list[int] = []
        while verdicts.count(ACCEPTED) < sequences or self.mode() != Mode.MPC:
            verdicts.append(optimiser.answer())
            self.plant.look()
        assert set(verdicts) <= {ACCEPTED, *BEGIN_AGAIN}

    def mode(self) -> int:
        return int(self.control.read("ladder")["mode"])

    def modes_until(self, last: Mode) -> list[int]:
        """Watch the ladder and the plant; return the modes until one, each once."""
        modes = [self.mode()]
        end = time.monotonic() + PATIENCE_S
        while modes[-1] != last:
            assert time.monotonic() < end, modes
            time.sleep(TICK_S)
            self.plant.look()
            if (mode := self.mode()) != modes[-1]:
                modes.append(mode)
        return modes

    def assert_no_step(self) -> None:
        """Every tick was seen; all inputs were within their bounds, and moved by a rate at most in any two ticks."""
        applied = self.plant.applied
        first, last = min(applied), max(applied)
        assert sorted(applied) == list(range(first, last + 1))
        for place, loop in enumerate(self.case.loops):
            u = [applied[tick][place] for tick in range(first, last + 1)]
            allowed = loop.rate + ROUNDING * (loop.high - loop.low)
            assert loop.low <= min(u) <= max(u) <= loop.high
            assert max(abs(later - u[tick]) for tick, later in enumerate(u[2:])) <= allowed


@contextmanager
def up(case: Case, processes: Processes, folder: Path) -> Iterator[Site]:
    """Keep a rig up whose rack limits nothing, so that it shows what the control PLC does."""
    base, files = processes.three_ports(), {"XDG_RUNTIME_DIR": str(folder)}
    process = ("--process", case.file)
    code, listing, complaints = started(processes, *process, "registers", "--format", "json")
    assert code == 0, complaints
    shortened = ("--set", "plant.rate_limited=false", "--set", f"control_plc.ladder.hold_s={2 * PERIOD * case.tick_s}")
    words = ("--without", "optimizer", "--load", "a", "--factor", case.tick_s / TICK_S, *shortened, "--detach")
    rig = processes.coldloop(*process, "up", "--port-base", base, *words, more=files)
    assert rig.popen.wait(PATIENCE_S) == 0, rig.said
    plant, control = Plant(blocks_of(listing, "plant"), base), Service(blocks_of(listing, "control_plc"), base + 1)
    try:
        with plant, control:
            yield Site(case, control.blocks, base + 1, plant, control)
    finally:
        assert processes.coldloop("down", "--port-base", base, more=files).popen.wait(PATIENCE_S) == 0


@pytest.mark.usefixtures("realtime")
@pytest.mark.parametrize("case", [TANK, COLUMN], ids=["tank", "column"])
def test_pi_controllers_by_registers_drive_a_process(case: Case, processes: Processes, tmp_path: Path) -> None:
    with up(case, processes, tmp_path) as site, site.optimiser() as optimiser:
        optimiser.introduce()
        site.drives(optimiser, 4)
        site.assert_no_step()
        measured = site.control.read("process")
    assert [measured[f"y.{loop.output}"] for loop in case.loops] == pytest.approx(
        [loop.setpoint for loop in case.loops], abs=0.3
    )


def closes(optimiser: Optimiser, rows: bytes) -> None:  # noqa: ARG001 it does not come to the header
    """Lose the connection when all rows have been written."""
    optimiser.client.close()  # type: ignore[no-untyped-call]


def closes_in_a_request(optimiser: Optimiser, rows: bytes) -> None:
    """Lose the connection within the request that would commit them."""
    optimiser.send_half_a_request(optimiser.next_update(), rows)
    optimiser.client.close()  # type: ignore[no-untyped-call]


def falls_silent(optimiser: Optimiser, rows: bytes) -> None:
    """Keep the connection, and say no more within that request."""
    optimiser.send_half_a_request(optimiser.next_update(), rows)


@pytest.mark.usefixtures("realtime")
@pytest.mark.parametrize("breaks_off", [closes, closes_in_a_request, falls_silent])
def test_one_that_breaks_off_in_a_sequence_leaves_the_ladder_to_act_without_a_step(
    breaks_off: Callable[[Optimiser, bytes], None], processes: Processes, tmp_path: Path
) -> None:
    with up(TANK, processes, tmp_path) as site, ExitStack() as first:
        optimiser = first.enter_context(site.optimiser())
        optimiser.introduce()
        site.drives(optimiser, 3)
        accepted = site.control.read("status")["accepted"]
        optimiser.plan(optimiser.next_update())
        breaks_off(optimiser, optimiser.send_rows([loop.high for loop in TANK.loops]))
        modes = site.modes_until(Mode.CLASSICAL)
        assert modes == [Mode.MPC, Mode.REST, Mode.HOLD, Mode.CLASSICAL]
        assert site.control.read("status")["accepted"] == accepted
        with site.optimiser() as second:
            second.introduce()
            site.drives(second, 2)
        site.assert_no_step()
