"""`coldloop budget`."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.conftest import Coldloop

PAGE = Path(__file__).parents[2] / "docs" / "budget.md"


def row(out: str, start: str) -> list[str]:
    return next(line for line in out.splitlines() if line.startswith(start)).split()


def test_the_budget_says_what_fits_in_time_and_memory(coldloop: "Coldloop") -> None:
    out = coldloop("budget", "--power", "1", "--updating-period", "5").out
    assert row(out, "ode  ")[-5:] == ["0.25", "paper", "19", "19", "12.7"]
    small, large = (int(text.replace(",", "")) for text in row(out, "total")[1:])
    assert small < 2_000_000 < large
    hessian = int(row(out, "Phi")[-1].replace(",", ""))
    assert hessian == 4 * 700**2
    gamma_alone = 4 * 1000 * 700
    assert hessian < 2_000_000 < hessian + gamma_alone


def test_the_page_has_the_tables_that_the_command_prints(coldloop: "Coldloop") -> None:
    printed = [re.split(r"  +", line) for line in coldloop("budget").out.splitlines()]
    sections = re.findall(
        r"^## (?:An iteration|Memory)\n(.*?)(?=^## )", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE
    )
    lines = [line for section in sections for line in section.splitlines() if line.startswith("| ")]
    assert len(lines) == (1 + 7) + (1 + 8)
    for line in lines:
        assert [cell for cell in map(str.strip, line.split("|")) if cell] in printed


def test_a_power_that_is_not_positive_is_refused(coldloop: "Coldloop") -> None:
    assert coldloop("budget", "--power", "-1").code == 2
