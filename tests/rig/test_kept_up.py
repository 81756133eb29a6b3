"""Services of a rig that stays up: what ends is started again after a pause, and given up after five times."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from coldloop.errors import LinkError
from coldloop_rig.cosim.networked_run import PAUSES_S, end_of, keep_up

NONE = (0.0,) * len(PAUSES_S)


class Mortal:
    """A process that ends at once, and counts how often it was started."""

    name = "the plant service"

    def __init__(self, lives: int = 1_000_000) -> None:
        self.starts = 0
        self.lives_on = asyncio.Event()
        self._lives = lives

    async def ended(self) -> str:
        if self.starts >= self._lives:
            self.lives_on.set()
            await asyncio.Event().wait()
        return "was ended by SIGKILL"

    async def restart(self) -> None:
        self.starts += 1


async def kept_up(
    process: Mortal, restarted: Callable[[], Awaitable[None]] | None = None, pauses_s: tuple[float, ...] = NONE
) -> None:
    await keep_up(process.name, process.ended, process.restart, restarted, pauses_s)


async def test_what_ends_again_and_again_is_given_up_after_five(capsys: pytest.CaptureFixture[str]) -> None:
    process = Mortal()
    with pytest.raises(LinkError, match="was ended by SIGKILL; given up after 5 restarts"):
        await kept_up(process)
    assert process.starts == 5
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "coldloop: the plant service was ended by SIGKILL: started again in 0 s (1 of 5)"
    assert len(lines) == 5


async def test_what_has_run_for_long_begins_to_count_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coldloop_rig.cosim.networked_run.STEADY_S", -1.0)
    process = Mortal(lives=12)
    keeping = asyncio.create_task(kept_up(process))
    await asyncio.wait_for(process.lives_on.wait(), 60.0)
    keeping.cancel()
    assert process.starts == 12


async def test_each_start_is_followed_up() -> None:
    told: asyncio.Queue[int] = asyncio.Queue()
    process = Mortal(lives=2)
    keeping = asyncio.create_task(kept_up(process, lambda: told.put(process.starts)))
    assert [await asyncio.wait_for(told.get(), 60.0) for _ in range(2)] == [1, 2]
    keeping.cancel()


async def test_what_ends_again_while_its_start_is_followed_up_is_started_again() -> None:
    """A service that ends at each start, before anybody has reached it, is given up as any other."""
    given_up: list[int] = []
    process = Mortal()

    async def restarted() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            given_up.append(process.starts)

    with pytest.raises(LinkError, match="given up after 5 restarts"):
        await asyncio.wait_for(kept_up(process, restarted), 60.0)
    assert given_up == [1, 2, 3, 4, 5]


async def test_what_goes_wrong_after_a_start_is_not_lost() -> None:
    async def restarted() -> None:
        raise LinkError("the session could not begin")

    once = Mortal(lives=1)
    with pytest.raises(LinkError, match="could not begin"):
        await asyncio.wait_for(kept_up(once, restarted), 60.0)


def test_the_pauses_grow() -> None:
    assert len(PAUSES_S) == 5
    assert list(PAUSES_S) == sorted(PAUSES_S)
    assert PAUSES_S[0] >= 1


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (-9, "was ended by SIGKILL"),
        (-77, "was ended by signal 77"),
        (2, "has ended with exit code 2: plant: port 5020"),
        (0, "has ended with exit code 0: plant: port 5020"),
    ],
)
def test_how_a_process_has_ended_is_told(code: int, text: str) -> None:
    assert end_of(code, "plant: port 5020") == text
