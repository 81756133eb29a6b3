"""Files that appear whole or not at all; only a regular file is replaced."""

import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from coldloop.errors import UsageError


def require_regular_file(path: Path) -> None:
    """Refuse to replace a device, a folder or a pipe by a file.

    Raises:
        UsageError: The path exists and is something else than a regular file.
    """
    if path.exists() and not path.is_file():
        raise UsageError(f"{path}: exists and is not a regular file; name another one")


def whole_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make the file under another name, then give it its own; others may do so at the same time."""
    require_regular_file(path)
    writer = f"{socket.gethostname()}.{os.getpid()}.{threading.get_native_id()}"
    draft = path.with_name(f".{path.name}.{writer}.draft")
    try:
        write(draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def whole_text(path: Path, text: str, *, synced: bool = False) -> None:
    """Write a text; `synced`: the disk has it when it gets its name, also if power fails."""

    def write(draft: Path) -> None:
        draft.write_text(text, encoding="utf-8")
        if synced:
            with draft.open("r+b") as file:
                os.fsync(file.fileno())

    whole_file(path, write)
