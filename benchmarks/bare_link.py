"""The messages of a networked run between as many processes, without programs: what the link alone costs.

Each tick has the exchange of outputs and measurement and is recorded; each update has the plan with the sequence, and
the pending read of the next update. `benchmarks/lockstep.py` compares a run with this.
"""

import argparse
import asyncio
import sys
from collections.abc import Awaitable, Callable

from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer, ServerSettings
from coldloop.process.cold_box import COLD_BOX
from coldloop.registers import maps_of
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.codec import blank
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import (
    Acknowledgement,
    AwaitUpdate,
    Grant,
    Plan,
    SequenceHeader,
    SequenceRow,
    Update,
    Verdict,
)
from coldloop.registers.declaration import Block, RegisterMap
from coldloop.registers.plant import HISTORY_ROWS, Actuators, Measurement, PlantSample
from coldloop.service.start import run_event_loop

PLANT, CONTROL, _ = maps_of(COLD_BOX)
NOBODY = DeviceIdentity(product="bare link", revision="")
LOW = tuple(one.span[0] for one in COLD_BOX.inputs)
LOAD_W = COLD_BOX.load.span[1]


def client_of(register_map: RegisterMap, port: int) -> RegisterClient:
    """Return a client of a server on this machine."""
    return RegisterClient(register_map, host="127.0.0.1", port=port, timeout_s=60.0)


async def serve(bank: RegisterBank, port: int, on_write: Callable[[Block, Caller], Awaitable[None] | None]) -> None:
    """Listen."""
    settings = ServerSettings(port=port)
    await ModbusServer(bank, settings=settings, on_write=on_write, identity=NOBODY).start()


async def plant(port: int) -> None:
    """Answer outputs with a measurement, and keep the history."""
    bank, tick = RegisterBank(PLANT), 0
    measurement, sample = blank(Measurement, PLANT)._replace(u=LOW, generation=1), blank(PlantSample, PLANT)

    def on_write(block: Block, _: Caller) -> None:
        nonlocal tick
        if block.record is Actuators:
            tick = bank.get(Actuators).tick + 1
            bank.put_sealed(measurement._replace(tick=tick - 1))
            bank.put(sample._replace(tick=tick - 1), (tick - 1) % HISTORY_ROWS)

    bank.keep_fresh(
        Identity, lambda: Identity(map_digest=PLANT.digest, map_version=PLANT.version, session=1, tick=tick)
    )
    await serve(bank, port, on_write)


async def control_plc(port: int, plant_port: int, ticks_per_update: int) -> None:
    """Exchange outputs for measurements as far as is granted; latch an update now and then, and wait for its answer."""
    bank, news, changed = RegisterBank(CONTROL), asyncio.Event(), asyncio.Event()
    bank.put(Identity(map_digest=CONTROL.digest, map_version=CONTROL.version))
    updates = answers = tick = 0

    def on_write(block: Block, _: Caller) -> Awaitable[None] | None:
        nonlocal answers
        if block.record is AwaitUpdate and bank.get(AwaitUpdate).update >= updates:
            return latched(news)
        if block.record is SequenceHeader:
            header = bank.get(SequenceHeader)
            bank.get_rows(SequenceRow, header.length)
            bank.put_sealed(Acknowledgement(header.number, Verdict.ACCEPTED))
            answers += 1
        changed.set()
        return None

    async def latched(event: asyncio.Event) -> None:
        await event.wait()

    await serve(bank, port, on_write)
    rack = client_of(PLANT, plant_port)
    await rack.connect(60.0)
    update = blank(Update, CONTROL)._replace(u=LOW, u_before=LOW, load=LOAD_W)
    while True:
        while tick >= bank.get(Grant).until_tick or answers < updates:
            changed.clear()
            await changed.wait()
        await rack.exchange(Actuators(tick, LOW, 1), Measurement)
        if tick % ticks_per_update == 0:
            bank.put_sealed(update._replace(update=updates, tick=tick))
            updates += 1
            news.set()
            news = asyncio.Event()
        tick += 1


async def optimizer_plc(control_port: int, rows: int) -> None:
    """Answer each update with a plan and a sequence."""
    control, number = client_of(CONTROL, control_port), 0
    await control.connect(60.0)
    sequence = [SequenceRow(LOW)] * rows
    while True:
        update = await control.exchange(AwaitUpdate(1, number), Update)
        number += 1
        header = SequenceHeader(number, update.update, update.tick + 1, rows, 1, 0, 0)
        plan = Plan(update.update, update.tick + 1)
        await control.exchange(header, Acknowledgement, rows=sequence, before=plan)


async def run(role: str, numbers: list[int]) -> int:
    """Be one of the three until the standard input is closed."""
    work = {"plant": plant, "control_plc": control_plc, "optimizer_plc": optimizer_plc}[role](*numbers)
    task = asyncio.ensure_future(work)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    task.cancel()
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("role", choices=("plant", "control_plc", "optimizer_plc"))
    parser.add_argument("numbers", type=int, nargs="+")
    options = parser.parse_args()
    run_event_loop(lambda: run(options.role, options.numbers))
