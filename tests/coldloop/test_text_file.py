"""What is read where a file is named: regular files and what a shell hands over, within bounds, without waiting."""

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from coldloop.errors import ConfigurationError
from coldloop.text import held_file, read_bytes, read_text

MOST: Final = 100


def sparse(place: Path) -> None:
    place.touch()
    os.truncate(place, 10 << 30)


def unreadable(place: Path) -> None:
    if os.getuid() == 0:
        pytest.skip("an administrator reads everything")
    place.touch(mode=0)


def listening(place: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(os.path.relpath(place))


def link(target: str) -> Callable[[Path], None]:
    return lambda place: place.symlink_to(target)


def to_fifo(place: Path) -> None:
    os.mkfifo(place.with_name("fifo"))
    place.symlink_to("fifo")


NO_FILES: Final[dict[str, tuple[Callable[[Path], object], str]]] = {
    "nothing": (lambda _: None, "No such file or directory"),
    "folder": (Path.mkdir, "not a regular file"),
    "FIFO": (os.mkfifo, "not a regular file"),
    "link to a FIFO": (to_fifo, "not a regular file"),
    "device": (link("/dev/zero"), "not a regular file"),
    "terminal": (link("/dev/tty"), "not a regular file|No such device or address"),
    "socket": (listening, "No such device or address"),
    "loop of links": (link("given"), "Too many levels of symbolic links"),
    "link to nothing": (link("missing"), "No such file or directory"),
    "10 GB": (sparse, f"more than {MOST} bytes"),
    "one byte too much": (lambda place: place.write_bytes(bytes(MOST + 1)), f"more than {MOST} bytes"),
    "unreadable": (unreadable, "Permission denied"),
}


@pytest.mark.parametrize("what", NO_FILES)
def test_what_is_no_file_is_one_line(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make, reason = NO_FILES[what]
    make(tmp_path / "given")
    with pytest.raises(ConfigurationError, match=rf"^{tmp_path}/given: ({reason}); name another$"):
        read_bytes(tmp_path / "given", "name another", ConfigurationError, MOST)


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "/dev/fd/9999", "/dev/fd/x", "/proc/self/mem"])
def test_a_name_that_no_file_has_is_one_line(name: str) -> None:
    with pytest.raises(ConfigurationError, match=r"; name another$"):
        read_text(Path(name), "name another", ConfigurationError, MOST)


def test_a_file_that_grows_is_read_up_to_its_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its size is asked for before it has grown."""
    (tmp_path / "log").write_bytes(bytes(MOST + 1))
    monkeypatch.setattr(os, "fstat", lambda _: os.stat_result((0o100644, *[0] * 9)))
    with pytest.raises(ConfigurationError, match=f"more than {MOST} bytes"):
        read_bytes(tmp_path / "log", "", ConfigurationError, MOST)


def test_what_a_shell_hands_over_is_read() -> None:
    assert read_bytes(Path(os.devnull), "") == b""
    ours, theirs = os.pipe()
    with os.fdopen(ours, "rb"), os.fdopen(theirs, "wb") as pipe:
        pipe.write("ä,1\n".encode())
        pipe.close()
        assert read_text(Path(f"/dev/fd/{ours}"), "") == "ä,1\n"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("../outside", "outside the folder"), ("/etc/passwd", "outside the folder"), ("away", "outside the folder"),
        ("inner/../../outside", "outside the folder"), (".", "not a regular file"), ("", "not a regular file"),
        ("inner", "not a regular file"), ("fifo", "not a regular file"), ("a\0b", "null byte"),
        ("loop", "Too many levels|Symlink loop"), ("missing", "No such file"),
    ],
)  # fmt: skip
def test_a_name_in_a_folder_of_others_is_a_regular_file_in_it(name: str, reason: str, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    (folder / "inner").mkdir(parents=True)
    (tmp_path / "outside").touch()
    (folder / "away").symlink_to("../outside")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "fifo")
    with pytest.raises(ConfigurationError, match=f"({reason}).*; restore it$"):
        held_file(folder, name, "restore it", ConfigurationError)
