"""A state that survives: the old one or the new one, never neither, and never another's."""

from pathlib import Path
from typing import Any

import pytest

from coldloop.retained import RetainedFile, RetainedStateError

OLD = {"session": 3, "tick": 1000, "applied": [43.0, 75.0, 36.0]}
NEW = {"session": 3, "tick": 1001, "applied": [43.1, 76.0, 36.0]}


def kept(path: Path, owner: str = "control_plc/1", digest: int = 0xC01D) -> RetainedFile:
    return RetainedFile(path, owner, digest)


def test_what_is_saved_is_read_back_and_nothing_is_nothing(tmp_path: Path) -> None:
    file = kept(tmp_path / "state")
    assert file.load() is None
    file.save(OLD)
    file.save(NEW)
    assert file.load() == NEW
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


class KilledError(Exception):
    """The process is killed here."""


def test_a_kill_at_each_byte_of_its_writing_leaves_the_old_state_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state"
    whole = kept(path).encoded(NEW)
    write, replace = Path.write_bytes, Path.replace
    found: list[Any] = []

    for survived in range(len(whole) + 2):

        def torn_write(self: Path, data: bytes, *, survived: int = survived) -> int:
            write(self, data[:survived])
            if survived <= len(data):
                raise KilledError
            return len(data)

        def killed_after(self: Path, target: Path) -> Path:
            replace(self, target)
            raise KilledError

        kept(path).save(OLD)
        with monkeypatch.context() as patch:
            patch.setattr(Path, "write_bytes", torn_write)
            patch.setattr(Path, "replace", killed_after)
            with pytest.raises(KilledError):
                kept(path).save(NEW)
        found.append(kept(path).load())
    assert found == [OLD] * (len(whole) + 1) + [NEW]


@pytest.mark.parametrize("wrong", ["cut", "flipped"])
def test_a_torn_or_damaged_file_is_refused_wherever_the_damage_is(tmp_path: Path, wrong: str) -> None:
    path = tmp_path / "state"
    whole = kept(path).encoded(NEW)
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
