"""Something that a solver, a rule or an estimator has to keep."""

from typing import NamedTuple


class Requirement(NamedTuple):
    """A requirement, and in how many cases it was not kept."""

    text: str
    failures: int
    cases: int

    @property
    def outcome(self) -> str:
        """Yes, or how often not."""
        return "yes" if not self.failures else f"NO, in {self.failures} of {self.cases}"
