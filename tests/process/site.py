"""A rig of another process that is up, seen through the registers that are listed for it."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from coldloop.registers.control_plc import Mode
from tests.harness.processes import Process, Processes
from tests.harness.waiting import eventually
from tests.process.outside_client import ACCEPTED, BEGIN_AGAIN, Blocks, Loop, Optimiser, Plant, Service, blocks_of
from tests.process.runs import started

EXAMPLES: Final = Path(__file__).parents[2] / "examples" / "processes"
TICK_S: Final = 0.05
"""Real time of a tick."""
PERIOD: Final = 20
"""The updating period, ticks."""
ROUNDING: Final = 1e-5
"""Of single precision, share of the range."""


Kind = TypeVar("Kind", bound=Optimiser)


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
    """A rig of a process that is up, and clients of it that know its listed registers alone."""

    case: Case
    control_blocks: Blocks
    port: int
    """Of the control PLC."""
    plant: Plant
    control: Service
    rig: Process

    def optimiser(self, kind: type[Kind] = Optimiser) -> Kind:  # type: ignore[assignment] # the default is one
        return kind(self.control_blocks, self.port, self.case.loops, self.case.tick_s, PERIOD)

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

        def arrived() -> bool:
            if self.looked() and (mode := self.mode()) != modes[-1]:
                modes.append(mode)
            return modes[-1] == last

        eventually(arrived, f"mode {last.name}")
        return modes

    def looked(self) -> bool:
        """Look at the plant, so that no tick is missed."""
        self.plant.look()
        return True

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
def up(
    case: Case, processes: Processes, folder: Path, *options: object, more: Mapping[str, str] | None = None
) -> Iterator[Site]:
    """Keep a rig up whose rack limits nothing, so that it shows what the control PLC does."""
    base, process = processes.three_ports(), ("--process", case.file)
    code, listing, complaints = started(processes, *process, "registers", "--format", "json")
    assert code == 0, complaints
    shortened = ("--set", "plant.rate_limited=false", "--set", f"control_plc.ladder.hold_s={2 * PERIOD * case.tick_s}")
    words = ("up", "--port-base", base, "--load", "a", "--factor", case.tick_s / TICK_S, *shortened, *options)
    rig = processes.coldloop(*process, *words, more={"XDG_RUNTIME_DIR": str(folder), **(more or {})})
    eventually(lambda: "the rig is up" in rig.said or not rig.alive, "the rig is up")
    assert rig.alive, rig.said
    plant, control = Plant(blocks_of(listing, "plant"), base), Service(blocks_of(listing, "control_plc"), base + 1)
    with plant, control:
        yield Site(case, control.blocks, base + 1, plant, control, rig)
    assert rig.interrupt() in {0, 130}
