"""`coldloop budget`."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.conftest import Coldloop


def row(out: str, start: str) -> list[str]:
    return next(line for line in out.splitlines() if line.startswith(start)).split()


def test_the_budget_says_what_fits_in_time_and_memory(coldloop: "Coldloop") -> None:
    out = coldloop("budget", "--power", "1", "--updating-period", "5").out
    assert row(out, "ODE  ")[1:] == ["0.250", "1", "19"]
    small, large = (int(text.replace(",", "")) for text in row(out, "total")[1:])
    assert small < 2_000_000 < large
    hessian = int(row(out, "Phi")[-1].replace(",", ""))
    assert hessian == 4 * 700**2
    gamma_alone = 4 * 1000 * 700
    assert hessian < 2_000_000 < hessian + gamma_alone


def test_a_power_that_is_not_positive_is_refused(coldloop: "Coldloop") -> None:
    assert coldloop("budget", "--power", "-1").code == 2
