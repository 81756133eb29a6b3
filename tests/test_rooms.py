"""Rooms within a package: which may use which. So each can be read without those above it."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = {
    "shared/coldloop": [
        ["process"], ["kernels"], ["registers"], ["safety", "modbus"], ["service"], ["operating"],
    ],
    "services/plant/coldloop_plant": [["helium"], ["components"], ["cold_box"]],
    "services/optimizer_plc/coldloop_optimizer_plc": [["qp"], ["solvers"]],
    "rig/coldloop_rig": [
        ["results"], ["figures", "cosim"], ["plc_sizing"], ["runs"], ["process_file"], ["live"], ["testing"],
        ["cli"],
    ],
}  # fmt: skip
"""Rooms from the ground up. A room uses those below it; files beside the rooms are not looked at."""


def imported(source: Path) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield node.module, node.lineno
        elif isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)


@pytest.mark.parametrize("package", FLOORS)
def test_a_room_uses_only_rooms_below_it(package: str) -> None:
    folder = ROOT / package
    floor_of = {room: floor for floor, rooms in enumerate(FLOORS[package]) for room in rooms}
    assert set(floor_of) == {path.parent.name for path in folder.glob("*/__init__.py")}
    trespasses = [
        f"{source.relative_to(ROOT)}:{line} imports {name}"
        for room, floor in floor_of.items()
        for source in sorted((folder / room).rglob("*.py"))
        for name, line in imported(source)
        for top, _, rest in [name.partition(".")]
        for other in [rest.partition(".")[0]]
        if top == folder.name and other != room and floor_of.get(other, -1) >= floor
    ]
    assert not trespasses


def test_each_room_says_what_is_in_it() -> None:
    for package in FLOORS:
        for file in (ROOT / package).glob("*/__init__.py"):
            said = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))
            assert said, file
            assert "\n" not in said.partition("\n\n")[0], file
