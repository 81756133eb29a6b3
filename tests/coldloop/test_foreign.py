"""The guard of calls into code that is not ours."""

import asyncio
import sys

import pytest

from coldloop.errors import ColdloopError, ConfigurationError, ModelFileError, RunInterruptedError, foreign


def test_what_it_raises_is_one_line_that_names_it_and_says_what_happens() -> None:
    line = r"^tank\.py: ZeroDivisionError: no flow; the plant ends here$"
    with pytest.raises(ModelFileError, match=line), foreign("tank.py", "the plant ends here"):
        raise ZeroDivisionError("no\n  flow")


def test_what_it_has_reported_itself_is_told_instead() -> None:
    said = ["solver", "diverged"]
    with pytest.raises(ModelFileError, match=r"^tank\.fmu: solver diverged$"), foreign("tank.fmu", said=said):
        raise RuntimeError("status 3")


def test_it_does_not_end_the_process_but_an_interruption_does() -> None:
    with pytest.raises(ColdloopError, match=r"^rule: SystemExit: 0$"), foreign("rule", kind=ColdloopError):
        sys.exit(0)
    with pytest.raises(KeyboardInterrupt), foreign("rule"):
        raise KeyboardInterrupt


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


@pytest.mark.parametrize(
    ("raised", "line"),
    [
        (SpeechlessError(), "rule: SpeechlessError"),
        (asyncio.CancelledError(), "rule: CancelledError"),
        (GeneratorExit(), "rule: GeneratorExit"),
        (BaseExceptionGroup("both", [SystemExit(1)]), r"rule: BaseExceptionGroup: both \(1 sub-exception\)"),
        (ValueError("x" * 10_000_000), "rule: ValueError: x{1988}"),
        (ValueError("\x1b[2J\r"), r"rule: ValueError: \\x1b\[2J"),
        (MemoryError(), "rule: MemoryError"),
        (StopIteration(3), "rule: StopIteration: 3"),
        (ModuleNotFoundError("No module named 'rig'", name="rig"), ".*: its name is coldloop_rig since version 0.4"),
    ],
    ids=lambda one: type(one).__name__ if isinstance(one, BaseException) else "",
)
def test_whatever_it_raises_is_a_short_line(raised: BaseException, line: str) -> None:
    with pytest.raises(ConfigurationError, match=f"^{line}$"), foreign("rule", kind=ConfigurationError):
        raise raised


def test_a_signal_is_not_what_it_raises() -> None:
    with pytest.raises(RunInterruptedError), foreign("rule", kind=ConfigurationError):
        raise RunInterruptedError("SIGTERM", 15)


def test_an_error_of_the_kind_passes_and_another_one_is_named() -> None:
    mine = ConfigurationError("the library is not installed")
    with pytest.raises(ConfigurationError) as passed, foreign("solver", kind=ConfigurationError):
        raise mine
    assert passed.value is mine
    other = "^solver: ModelFileError: x$"
    with pytest.raises(ConfigurationError, match=other), foreign("solver", kind=ConfigurationError):
        raise ModelFileError("x")
