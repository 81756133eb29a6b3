"""One-bit changes of an exported program's tables that its self-test misses, in the image that a linker makes."""

import ctypes
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any, Final, TypedDict

from coldloop.errors import UsageError

PARTS: Final = {"solver": "", "optimizer": "optimizer/", "output_guard": "output_guard/"}
"""Programs with a self-test, and where they are in an export."""
LEVELS: Final = ("-O0", "-O2")
PER_TABLE: Final = 8
"""Bits that are changed in each table, one at a time."""
FLAGS: Final = ("-std=c99", "-ffp-contract=off", "-fno-pie", "-no-pie")
PATIENCE_S: Final = 60.0
"""Time after which a self-test counts as hanging, s; a change that makes it hang is noticed."""
SCALARS: Final = {"float": ctypes.c_float, "double": ctypes.c_double, "int32_t": ctypes.c_int32, "bool": ctypes.c_bool}
_SECTION: Final = re.compile(r"\[ *(\d+)\] (\.rodata|\.data\.rel\.ro)\S* +\S+ +([0-9a-f]+) ([0-9a-f]+) ")
_OBJECT: Final = re.compile(r": ([0-9a-f]+) +(\w+) OBJECT +\w+ +\w+ +(\d+) ([A-Za-z]\w*)")


class Flips(TypedDict):
    """Result of changing each bit in turn: how many changes there were, and which were missed."""

    changes: int
    missed: dict[str, list[int]]
    """Bytes in which one was missed, by table."""
    padding: dict[str, list[int]]
    """Bytes of padding in which a change was missed, by table: they lie between the members of a structure, and no code
reads them."""


def require_compiler() -> None:
    """Check that programs can be compiled and looked into.

    Raises:
        UsageError: There is no gcc, or no readelf.
    """
    if not (shutil.which("gcc") and shutil.which("readelf")):
        raise UsageError("--score: needs gcc and readelf: on Debian, install gcc")


def scored(texts: Mapping[str, str]) -> dict[str, dict[str, Flips]]:
    """Return what the self-tests of an export in C find, by program and level of optimisation.

    Raises:
        UsageError: A self-test fails without a change.
    """
    with tempfile.TemporaryDirectory() as made:
        found = {}
        for part, inside in PARTS.items():
            sources = [each for each in texts if each.startswith(inside) and "/" not in each.removeprefix(inside)]
            if not sources:
                continue  # for a process with a forecast
            folder = Path(made) / part
            folder.mkdir()
            for name in sources:
                (folder / name.removeprefix(inside)).write_text(texts[name], encoding="ascii")
            found[part] = {level: flipped(folder, ("gcc", level)) for level in LEVELS}
        return found


def flipped(folder: Path, compiler: Sequence[str], runner: Sequence[str] = (), count: int = PER_TABLE) -> Flips:
    """Return what the self-test of the sources in a folder finds.

    Args:
        folder: Sources; the program is put there.
        compiler: Command of a compiler for ELF, with options.
        runner: What runs its programs here.
        count: Bits for each table.

    Raises:
        UsageError: The self-test fails without a change.
        subprocess.CalledProcessError: It cannot be compiled.
    """
    image = folder / "image"
    subprocess.run([*compiler, *FLAGS, *sorted(folder.glob("*.c")), "-lm", "-o", image], check=True)  # noqa: S603 ours
    if not _passes([*runner, str(image)]):
        raise UsageError(f"--score: the self-test of {folder.name}, compiled by {' '.join(compiler)}, fails as it is")
    data, random = image.read_bytes(), Random(1)  # noqa: S311 no secret
    members = _members("\n".join(each.read_text("ascii") for each in folder.glob("*.h")), 32 * data[4])
    found = Flips(changes=0, missed={}, padding={})
    for name, offset, size in _tables(image):
        for bit in random.sample(range(8 * size), min(count, 8 * size)):
            changed = bytearray(data)
            changed[offset + bit // 8] ^= 1 << bit % 8
            image.write_bytes(changed)
            found["changes"] += 1
            if _passes([*runner, str(image)]):
                used = members.get(name.rpartition("_kernel_")[2])
                padding = used is not None and not used[bit // 8 % len(used)]
                found["padding" if padding else "missed"].setdefault(name, []).append(bit // 8)
    return found


def _passes(command: Sequence[str]) -> bool:
    try:
        return subprocess.run(command, capture_output=True, check=False, timeout=PATIENCE_S).returncode == 0  # noqa: S603
    except subprocess.TimeoutExpired:
        return False


def _tables(image: Path) -> Iterator[tuple[str, int, int]]:
    """Yield name, place in the file and bytes of each constant array or structure of an ELF program."""
    text = subprocess.run(["readelf", "-SWs", image], capture_output=True, text=True, check=True).stdout  # noqa: S603, S607
    sections = {number: int(place, 16) - int(at, 16) for number, _, at, place in _SECTION.findall(text)}
    for at, size, section, name in _OBJECT.findall(text):
        if section in sections and int(size, 0):
            yield name, sections[section] + int(at, 16), int(size, 0)


def _members(headers: str, bits: int) -> dict[str, list[bool]]:
    """Return of each constant structure that headers declare which of its bytes belong to a member."""
    known: dict[str, Any] = dict(SCALARS)
    pointer = ctypes.c_uint32 if bits == ctypes.sizeof(ctypes.c_uint32) * 8 else ctypes.c_uint64
    for body, name in re.findall(r"^typedef struct \{\n(.*?)^\} (\w+);", headers, re.MULTILINE | re.DOTALL):
        fields = re.findall(r"^    (?:const )?(\w+) (\*?)(\w+)(?:\[(\d+)\])?;", body, re.MULTILINE)
        kinds = ((field, pointer if star else known[kind], int(length or 0)) for kind, star, field, length in fields)
        listed = [(field, kind * length if length else kind) for field, kind, length in kinds]
        known[name] = type(name, (ctypes.Structure,), {"_fields_": listed})
    return {name: _used(known[kind]) for kind, name in re.findall(r"^extern const (\w+) (\w+)", headers, re.MULTILINE)
            if issubclass(known[kind], ctypes.Structure)}  # fmt: skip


def _used(kind: Any) -> list[bool]:  # noqa: ANN401 a type of ctypes
    found = [not hasattr(kind, "_fields_")] * ctypes.sizeof(kind)
    for name, part in getattr(kind, "_fields_", ()):
        at = getattr(kind, name).offset
        found[at : at + ctypes.sizeof(part)] = _used(part)
    return found
