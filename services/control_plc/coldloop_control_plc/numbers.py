"""What arithmetic takes that is plain Python here and compiled elsewhere: tuples and lists here, arrays there."""

from collections.abc import Iterator
from typing import Protocol


class Numbers(Protocol):
    """Numbers in a row."""

    def __getitem__(self, place: int, /) -> float:
        """Return the number at a place."""

    def __len__(self) -> int:
        """Return how many there are."""

    def __iter__(self) -> Iterator[float]:
        """Return them in turn."""


class Rows(Protocol):
    """Rows of numbers."""

    def __getitem__(self, place: int, /) -> Numbers:
        """Return the row at a place."""
