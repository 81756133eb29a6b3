"""State that survives a restart: one small file, replaced whole or not at all.

A draft is written beside it and renamed over it, so a process that is killed at any byte leaves the old state or the
new one. What cannot be trusted (torn, of another program or model) is refused, and said so.
"""

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from coldloop.errors import ColdloopError

MAGIC = "coldloop-retained"


class RetainedStateError(ColdloopError):
    """A retained state cannot be trusted, or cannot be written."""


class RetainSettings(BaseModel):
    """Where the state is kept."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    file: Path | None = None
    """None keeps nothing: after a restart the service begins anew."""


class RetainedFile:
    """The retained state of one program.

    Args:
        path: Where it is.
        owner: Name of the program and version of its state, without spaces.
        digest: 32 bits of what the state belongs to: the model.
    """

    def __init__(self, path: Path, owner: str, digest: int) -> None:
        self._path = path
        self._draft = path.with_name(f"{path.name}.draft")
        self._owner = owner
        self._digest = digest

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the state.

        Raises:
            RetainedStateError: The file cannot be written.
        """
        try:
            self._draft.write_bytes(self.encoded(state))
            self._draft.replace(self._path)
        except OSError as error:
            raise RetainedStateError(f"{self._path}: {error.strerror}; name another file in retain.file") from None

    def encoded(self, state: Mapping[str, Any]) -> bytes:
        """Return the bytes of the file: a line that describes the state, and the state as JSON."""
        content = json.dumps(state, separators=(",", ":")).encode()
        return self._description(content) + content

    def _description(self, content: bytes) -> bytes:
        fields = f"{MAGIC} {self._owner} {self._digest:08x} {len(content)} {zlib.crc32(content):08x}"
        return f"{fields} {zlib.crc32(fields.encode()):08x}\n".encode()

    def load(self) -> dict[str, Any] | None:
        """Return the state; None when there is none yet.

        Raises:
            RetainedStateError: The file is torn, or not ours.
        """
        try:
            data = self._path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise RetainedStateError(f"{self._path}: {error.strerror}") from None
        line, _, content = data.partition(b"\n")
        if line + b"\n" != self._description(content):
            raise RetainedStateError(f"{self._path}: {self._complaint(line)}; it is not used")
        state: dict[str, Any] = json.loads(content)
        return state

    def _complaint(self, line: bytes) -> str:
        words = line.decode(errors="replace").split()
        if words[:1] != [MAGIC]:
            return "not a retained state"
        if words[1:3] != [self._owner, f"{self._digest:08x}"]:
            return "the retained state of another program or model"
        return "a torn retained state"
