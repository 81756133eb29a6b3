"""What the user is told while kernels are compiled."""

from collections.abc import Iterator

import pytest

from coldloop.kernels import cache
from coldloop.kernels.cache import Kernels, announce_with, kernels_of, needs_compiling, write_line


@pytest.fixture
def announced(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    monkeypatch.setattr(cache, "_announced", set())
    owners: list[str] = []
    announce_with(lambda kernels: owners.append(kernels.owner))
    yield owners
    announce_with(write_line)


def test_kernels_that_are_missing_are_announced_once(announced: list[str]) -> None:
    with kernels_of("the plant", 5):
        needs_compiling()
        needs_compiling()
    with kernels_of("the plant", 5):
        needs_compiling()
    assert announced == ["the plant"]


def test_parts_are_announced_as_what_they_are_parts_of(announced: list[str]) -> None:
    with kernels_of("the run", 50):
        with kernels_of("the plant", 5):
            needs_compiling()
        with kernels_of("the solver", 5):
            needs_compiling()
    assert announced == ["the run"]


def test_where_none_is_missing_or_nobody_says_whose_they_are_nothing_is_announced(announced: list[str]) -> None:
    with kernels_of("the plant", 5):
        pass
    needs_compiling()
    assert not announced


@pytest.mark.parametrize(("cores", "seconds"), [(2, 20), (1, 35), (None, 35)])
def test_several_are_one_line(
    cores: int | None, seconds: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    write_line(Kernels("the plant", 20), Kernels("the solver", 15))
    assert capsys.readouterr().err == (
        "coldloop: compiling the kernels of the plant and of the solver; "
        f"this takes about {seconds} s and happens once\n"
    )
