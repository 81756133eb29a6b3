"""A record that is written in part is judged as the record that results: valid, or exception 03 and nothing happens."""

from typing import TYPE_CHECKING

from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import Status
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.optimizer_plc import OptimizerSession
from coldloop.registers.plant import LoadStep, PlantSession
from tests.harness.records import OPTIMIZER_MAP, PLANT_MAP

if TYPE_CHECKING:
    from tests.harness.processes import Processes
    from tests.link.conftest import FieldAt, WireTo

ILLEGAL_VALUE = 3
START_S = PATIENCE_S = 90.0


def address_of(register_map: RegisterMap, record: type[tuple[object, ...]], field: str) -> int:
    registers = {register.name: register.address for register in register_map.block_of(record).registers(0)}
    return registers[field]


async def test_a_number_of_load_steps_that_makes_no_load_is_refused_and_the_clock_of_the_plant_goes_on(
    field: "FieldAt", wire: "WireTo"
) -> None:
    async with field() as site:
        control, rack = await site.joined(), site.rack
        steps = address_of(PLANT_MAP, PlantSession, "load_steps")
        load = PLANT_MAP.block_of(LoadStep).address
        async with wire(rack.port) as simple:
            for wrong in (0, 2000, 2049, 65535):
                assert await simple.set_register(steps, wrong) == ILLEGAL_VALUE
                await rack.passes(4)
            for watts in (float("nan"), float("inf"), 1e30, -1.0):
                assert await simple.write(PLANT_MAP, LoadStep(0, watts)) == ILLEGAL_VALUE
            assert await simple.set_register(load + 2, 0x7F80) == ILLEGAL_VALUE, "half of a number"
        before = rack.tick
        await rack.passes(20)
        await site.follows(control)
        assert (await rack.client.read(Identity)).session == rack.session
        assert rack.tick > before
        assert rack.violations() == []


async def test_an_updating_period_out_of_range_is_refused_and_the_optimiser_serves_the_next_session(
    field: "FieldAt", processes: "Processes", wire: "WireTo"
) -> None:
    async with field() as site:
        control = site.control()
        optimizer = processes.service("optimizer_plc", f"optimizer_plc.control_plc.port={control.service.port}")
        client = RegisterClient(OPTIMIZER_MAP, host="127.0.0.1", port=optimizer.port, timeout_s=PATIENCE_S)
        await client.connect(START_S)
        await site.rack.begin(factor=5.0)
        session = site.rack.session
        await client.write(OptimizerSession(session, 1, 5.0, 8))
        async with wire(optimizer.port) as simple:
            for wrong in (1, 21, 65535):
                period = address_of(OPTIMIZER_MAP, OptimizerSession, "updating_period")
                assert await simple.set_register(period, wrong) == ILLEGAL_VALUE
        await control.begin(session, factor=5.0)

        async def accepted() -> bool:
            return (await control.client.read(Status)).accepted >= 2

        await site.rack.until(accepted)
        assert optimizer.alive
        assert site.rack.violations() == []
        client.close()
