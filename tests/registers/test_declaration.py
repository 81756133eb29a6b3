from typing import Annotated, NamedTuple

import pytest

from coldloop.modbus.requests import MAX_READ_WORDS, MAX_READ_WRITE_WORDS
from coldloop.registers.common import IDENTITY_BLOCK, Identity
from coldloop.registers.declaration import Block, Kind, RegisterMap, Role, f32, fields_of, u16, u32
from coldloop.registers.plant import Measurement
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP, PLANT_MAP

MAPS = (PLANT_MAP, CONTROL_MAP, OPTIMIZER_MAP)
each_map = pytest.mark.parametrize("register_map", MAPS, ids=lambda register_map: register_map.service)


class Oven(NamedTuple):
    switch: Annotated[int, u16("On", high=1)]
    clock: Annotated[int, u32("Clock", unit="s")]
    walls: Annotated[tuple[float, ...], f32("Temperature", elements=("left", "right"), units=("K", "C"))]
    target: Annotated[float, f32("Setpoint", unit="K", low=4, high=400)]


OVEN = Block("oven", 10, Oven, "An oven", Role.OPERATOR, rows=3)


class TestABlock:
    def test_measures_itself_in_words(self) -> None:
        assert OVEN.row_words == 1 + 2 + 4 + 2
        assert OVEN.end == 10 + 3 * 9
        assert OVEN.letters == "HIfff"

    def test_lists_its_registers_with_addresses_and_units(self) -> None:
        listed = [(register.name, register.address, register.kind, register.unit) for register in OVEN.registers()]
        assert listed == [
            ("switch", 10, Kind.U16, ""),
            ("clock", 11, Kind.U32, "s"),
            ("walls.left", 13, Kind.F32, "K"),
            ("walls.right", 15, Kind.F32, "C"),
            ("target", 17, Kind.F32, "K"),
        ]

    def test_lists_a_later_row_behind_the_first(self) -> None:
        assert [register.address for register in OVEN.registers(row=2)] == [28, 29, 31, 33, 35]

    def test_needs_a_declaration_for_each_field(self) -> None:
        class Undeclared(NamedTuple):
            value: int

        with pytest.raises(TypeError, match=r"Undeclared\.value needs exactly one register declaration"):
            fields_of(Undeclared)


class TestAMap:
    def test_refuses_blocks_that_overlap(self) -> None:
        with pytest.raises(ValueError, match="overlaps"):
            RegisterMap("oven", 1, (OVEN, Block("other", 36, Identity, "")))

    def test_refuses_a_block_beyond_the_last_address(self) -> None:
        with pytest.raises(ValueError, match="end of the map"):
            RegisterMap("oven", 1, (Block("other", 0x10000 - 5, Identity, ""),))

    def test_finds_the_block_of_a_record(self) -> None:
        assert PLANT_MAP.block_of(Measurement).name == "measurement"

    @pytest.mark.parametrize(
        "changed",
        [
            RegisterMap("stove", 1, (OVEN,)),
            RegisterMap("oven", 2, (OVEN,)),
            RegisterMap("oven", 1, (Block("oven", 11, Oven, "An oven", Role.OPERATOR, rows=3),)),
            RegisterMap("oven", 1, (Block("oven", 10, Oven, "An oven", Role.OPERATOR, rows=2),)),
            RegisterMap("oven", 1, (Block("oven", 10, Oven, "An oven", rows=3),)),
        ],
    )
    def test_has_another_digest_when_something_that_clients_depend_on_changes(self, changed: RegisterMap) -> None:
        assert changed.digest != RegisterMap("oven", 1, (OVEN,)).digest

    def test_keeps_its_digest_when_only_a_description_changes(self) -> None:
        described = Block("oven", 10, Oven, "Said otherwise", Role.OPERATOR, rows=3)
        assert RegisterMap("oven", 1, (described,)).digest == RegisterMap("oven", 1, (OVEN,)).digest


class TestEveryMapOfTheHouse:
    @each_map
    def test_begins_with_the_same_corner(self, register_map: RegisterMap) -> None:
        assert register_map.blocks[0] == IDENTITY_BLOCK

    @each_map
    def test_has_rows_that_one_request_reads_or_writes(self, register_map: RegisterMap) -> None:
        for block in register_map.blocks:
            assert block.row_words <= (MAX_READ_WORDS if block.writer is None else MAX_READ_WRITE_WORDS)

    def test_has_a_digest_of_its_own(self) -> None:
        assert len({register_map.digest for register_map in MAPS}) == len(MAPS)
