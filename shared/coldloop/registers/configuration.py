"""The configuration that a service runs, in its registers: what decides results, as a JSON text with its digest.

The text is an object of values by dotted key, as `coldloop config` lists them. Addresses, certificates, files and other
things that concern one machine alone are not in it.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, NamedTuple

from coldloop.parsing import parsed_json
from coldloop.registers.audit import EVENT_ROWS, QUERY_ROWS, Event, JournalAnswer, JournalPage, JournalQuery
from coldloop.registers.bank import RegisterBank
from coldloop.registers.declaration import Block, Role, text, u16
from coldloop.registers.text import from_words, to_words

LINE_WORDS: Final = 16
LINE_CHARACTERS: Final = 2 * LINE_WORDS
LINES: Final = 512
"""16,384 characters; the optimiser PLC, which has the longest, takes 3,000 by default."""
DIGEST_WORDS: Final = 32


class ConfigurationDigest(NamedTuple):
    """How long the text of the configuration is, and its digest."""

    length: Annotated[int, u16("Characters of the text; it is cut off if this is more than the lines hold")]
    sha256: Annotated[tuple[int, ...], text("SHA-256 of the text, in hexadecimal", DIGEST_WORDS)]


class ConfigurationLine(NamedTuple):
    """A part of the text."""

    text: Annotated[tuple[int, ...], text("Part of a JSON object: values by dotted key", LINE_WORDS)]


LAST_BLOCKS: Final = (
    Block("journal query", 45000, JournalQuery, "Selects events of the journal", Role.OPERATOR),
    Block("journal page", 45010, JournalPage, "State of the journal"),
    Block("journal answer", 45017, JournalAnswer, "The events that were selected", rows=QUERY_ROWS),
    Block("events", 45200, Event, "The last events", rows=EVENT_ROWS),
    Block("configuration", 55000, ConfigurationDigest, "Digest of the running configuration"),
    Block("configuration text", 55040, ConfigurationLine, "The running configuration", rows=LINES),
)
"""The end of every map: the service's journal and its configuration."""


def publish_configuration(bank: RegisterBank, values: Mapping[str, Any]) -> None:
    """Show values by dotted key in the registers of a service."""
    document = json.dumps(values, sort_keys=True, separators=(",", ":"))
    bank.put(ConfigurationDigest(min(len(document), 0xFFFF), to_words(_digest(document), DIGEST_WORDS)))
    for row, line in enumerate(_lines(document)):
        bank.put(ConfigurationLine(to_words(line, LINE_WORDS)), row)


def lines_of(digest: ConfigurationDigest) -> int:
    """Return the number of lines that the text takes."""
    return min(LINES, -(-digest.length // LINE_CHARACTERS))


def configuration_of(digest: ConfigurationDigest, lines: Sequence[ConfigurationLine]) -> dict[str, Any]:
    """Return the values by dotted key.

    Raises:
        ValueError: The text is not the one of the digest: it was cut off, or has arrived damaged; or it is no object of
            values.
    """
    document = "".join(from_words(line.text) for line in lines)
    if _digest(document) != from_words(digest.sha256):
        raise ValueError("the text is not the one of its digest")
    try:
        return {**parsed_json(document)}
    except TypeError:
        raise ValueError("the text is not an object") from None


def _lines(document: str) -> Iterator[str]:
    for start in range(0, min(len(document), LINES * LINE_CHARACTERS), LINE_CHARACTERS):
        yield document[start : start + LINE_CHARACTERS]


def _digest(document: str) -> str:
    return hashlib.sha256(document.encode()).hexdigest()
