"""Texts in registers: two ASCII characters a word, the first in the high byte, padded with zeros."""


def to_words(text: str, words: int) -> tuple[int, ...]:
    """Return a text as `words` register values; what is too long is cut off, what is not ASCII becomes "?"."""
    raw = text.encode("ascii", errors="replace")[: 2 * words].ljust(2 * words, b"\0")
    return tuple(int.from_bytes(raw[place : place + 2], "big") for place in range(0, 2 * words, 2))


def from_words(words: tuple[int, ...]) -> str:
    """Return the text that register values hold."""
    return b"".join(word.to_bytes(2, "big") for word in words).rstrip(b"\0").decode("ascii", errors="replace")
