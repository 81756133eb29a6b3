"""A state that survives: the old one or the new one, never neither, and never another's."""

import errno
import os
import stat
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any, Self

import pytest

from coldloop.safety.retained import RetainedFile, RetainedStateError, _description, encoded

OLD = {"session": 3, "tick": 1000, "applied": [43.0, 75.0, 36.0]}
NEW = {"session": 3, "tick": 1001, "applied": [43.1, 76.0, 36.0]}


OURS = ("control_plc/1", 0xC01D)


def kept(path: Path, owner: str = OURS[0], digest: int = OURS[1]) -> RetainedFile:
    return RetainedFile(path, owner, digest)


def test_what_is_saved_is_read_back_and_nothing_is_nothing(tmp_path: Path) -> None:
    file = kept(tmp_path / "state")
    assert file.load() is None
    file.save(OLD)
    file.save(NEW)
    assert file.load() == NEW
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def sealed_nonsense(content: bytes) -> bytes:
    """Return a file whose description is right for a content that is no state."""
    return _description(content, *OURS) + content


@pytest.mark.parametrize(
    "content", [b"", b"no JSON", b"\xff\xfe", b"[1, 2]", b"7", b"[" * 100_000, b"9" * 5000, b'{"a":' * 50_000], ids=len
)
def test_what_is_sealed_and_no_state_is_refused(tmp_path: Path, content: bytes) -> None:
    file = kept(tmp_path / "state")
    file.path.write_bytes(sealed_nonsense(content))
    with pytest.raises(RetainedStateError, match="no valid state"):
        file.load()
    assert file.set_aside() == "set aside as state.refused"
    assert file.load() is None


@pytest.mark.parametrize("kind", ["fifo", "link", "folder"])
def test_what_is_no_ordinary_file_is_neither_waited_for_nor_followed(tmp_path: Path, kind: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    kept(elsewhere).save(OLD)
    file = kept(tmp_path / "state")
    for place in (file.path, tmp_path / ".state.draft"):
        if kind == "fifo":
            os.mkfifo(place)
        elif kind == "link":
            place.symlink_to(elsewhere)
        elif place == file.path:
            place.mkdir()
    with pytest.raises(RetainedStateError):
        file.load()
    assert file.set_aside() == "set aside as state.refused"
    file.save(NEW)
    assert file.load() == NEW
    assert kept(elsewhere).load() == OLD, "nothing was written through a link"


class KilledError(BaseException):
    """The process is killed here."""


class Disk:
    """Stands between the program and its disk: notes what is done, and kills the process, or fails, on the way.

    Args:
        killed_after: How many bytes are written, then steps done, before the process is killed.
        full_after: How many bytes are written before the disk is full.
    """

    def __init__(
        self, patch: pytest.MonkeyPatch, *, killed_after: int | None = None, full_after: int | None = None
    ) -> None:
        self.steps: list[str] = []
        self._life = killed_after
        self._room = full_after
        opened, replace, fsync = Path.open, Path.replace, os.fsync

        def sync(descriptor: int) -> None:
            is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
            self._step("sync folder" if is_folder else "sync file", lambda: fsync(descriptor))

        patch.setattr(Path, "open", lambda path, *mode, **how: SlowFile(opened(path, *mode, **how), self))
        patch.setattr(Path, "replace", lambda path, target: self._step("rename", lambda: replace(path, target)))
        patch.setattr(os, "fsync", sync)

    def write(self, file: Any, data: memoryview) -> int:  # noqa: ANN401 - a file
        """Write one byte."""
        if self._room is not None:
            if not self._room:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._room -= 1
        self._step("write", lambda: file.write(data[:1]))
        return 1

    def _step(self, name: str, do: Callable[[], object]) -> None:
        if self._life is not None:
            if not self._life:
                raise KilledError
            self._life -= 1
        self.steps.append(name)
        do()


class SlowFile:
    """A file that takes a byte at a time."""

    def __init__(self, file: Any, disk: Disk) -> None:  # noqa: ANN401 - a file
        self._file = file
        self._disk = disk
        self.fileno = file.fileno

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, data: memoryview) -> int:
        return self._disk.write(self._file, data)


def test_a_kill_at_each_byte_and_step_leaves_the_old_state_or_the_new(tmp_path: Path) -> None:
    file = kept(tmp_path / "state")
    size = len(encoded(NEW, *OURS))
    found: list[Any] = []
    for survived in range(size + 3):
        file.save(OLD)
        with pytest.MonkeyPatch.context() as patch:
            Disk(patch, killed_after=survived)
            with pytest.raises(KilledError):
                file.save(NEW)
        found.append(file.load())
    assert found == [OLD] * (size + 2) + [NEW]


def test_the_content_is_on_the_disk_before_its_name_and_the_name_before_the_call_returns(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(patch)
        kept(tmp_path / "state").save(NEW)
    assert [step for step, _ in groupby(disk.steps)] == ["write", "sync file", "rename", "sync folder"]


def test_a_disk_that_fills_leaves_the_old_state_and_no_draft(tmp_path: Path) -> None:
    file = kept(tmp_path / "state")
    file.save(OLD)
    with pytest.MonkeyPatch.context() as patch:
        Disk(patch, full_after=10)
        with pytest.raises(RetainedStateError, match="No space left"):
            file.save(NEW)
    assert file.load() == OLD
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def test_drafts_of_processes_that_were_killed_do_not_pile_up(tmp_path: Path) -> None:
    file = kept(tmp_path / "state")
    draft = tmp_path / ".state.draft"
    draft.write_text("of a process that was killed, on another host or with another number")
    file.save(NEW)
    assert file.load() == NEW
    assert not draft.exists()


@pytest.mark.parametrize("wrong", ["cut", "flipped"])
def test_a_torn_or_damaged_file_is_refused_wherever_the_damage_is(tmp_path: Path, wrong: str) -> None:
    path = tmp_path / "state"
    whole = encoded(NEW, *OURS)
    for position in range(len(whole)):
        damaged = bytearray(whole)
        damaged[position] ^= 0x04
        path.write_bytes(whole[:position] if wrong == "cut" else bytes(damaged))
        with pytest.raises(RetainedStateError, match="not used"):
            kept(path).load()


@pytest.mark.parametrize(
    ("other", "complaint"),
    [
        ({"owner": "plant/1"}, "another program or model"),
        ({"digest": 0xBAD}, "another program or model"),
    ],
)
def test_the_state_of_another_is_refused(tmp_path: Path, other: dict[str, Any], complaint: str) -> None:
    path = tmp_path / "state"
    kept(path, **other).save(OLD)
    with pytest.raises(RetainedStateError, match=complaint):
        kept(path).load()


def test_a_foreign_file_is_refused_and_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    path = tmp_path / "state"
    path.write_text("[control_plc]\nport = 5021\n")
    with pytest.raises(RetainedStateError, match="not a retained state"):
        kept(path).load()
    with pytest.raises(RetainedStateError, match="No such file"):
        kept(tmp_path / "missing" / "state").save(OLD)


def test_a_device_is_neither_read_nor_replaced(tmp_path: Path) -> None:
    """An administrator, as in a container, could replace /dev/null for everybody."""
    place = tmp_path / "null"
    try:
        os.mknod(place, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only an administrator makes devices")
    file = kept(place)
    with pytest.raises(RetainedStateError):
        file.load()
    assert file.set_aside() == "left where it is: a device"
    with pytest.raises(RetainedStateError, match=r"a device; name another file in retain\.file"):
        file.save(NEW)
    assert stat.S_ISCHR(place.lstat().st_mode)
