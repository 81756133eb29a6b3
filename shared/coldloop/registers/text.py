"""Texts in registers: two ASCII characters a word, the first in the high byte, padded with zeros.

What is not a printable ASCII character is a "?" on both sides: a text may come from a certificate, or from a peer, and
is shown on terminals.
"""

from functools import lru_cache


@lru_cache(maxsize=256)
def to_words(text: str, words: int) -> tuple[int, ...]:
    """Return a text as `words` register values; what is too long is cut off."""
    raw = _printable(text).encode("ascii")[: 2 * words].ljust(2 * words, b"\0")
    return tuple(int.from_bytes(raw[place : place + 2], "big") for place in range(0, 2 * words, 2))


def from_words(words: tuple[int, ...]) -> str:
    """Return the text that register values hold."""
    raw = b"".join(word.to_bytes(2, "big") for word in words).rstrip(b"\0")
    return _printable(raw.decode("ascii", errors="replace"))


def _printable(text: str) -> str:
    return "".join(character if " " <= character <= "~" else "?" for character in text)
