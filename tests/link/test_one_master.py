"""Of two control PLCs one drives the rack, and of two optimisers one answers the control PLC."""

import shutil
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import AlarmKind, EventKind, LeaseState, LeaseStatus, ServerStatistics
from coldloop.registers.control_plc import LinkCause, PlantLinkState, PlantLinkStatus, Status
from coldloop.registers.optimizer_plc import ControlLinkState, ControlLinkStatus
from tests.harness.records import OPTIMIZER_MAP
from tests.link.conftest import SAFE_STATE

if TYPE_CHECKING:
    from tests.harness.processes import Processes
    from tests.link.conftest import FieldAt

START_S = 90.0
FACTOR = 5.0
"""A lease lasts 3 s: who drives on a busy machine keeps it."""


def is_raised_only(driven: Sequence[float]) -> bool:
    """Return whether an output is never lowered but by the rack, whose watchdog expires on a starved machine."""
    return all(after >= before or after == SAFE_STATE[0] for before, after in pairwise(driven))


async def test_a_second_control_plc_is_refused_and_takes_over_when_the_first_is_killed(field: "FieldAt") -> None:
    async with field() as site:
        second = site.control()
        first, rack = await site.joined(factor=FACTOR), site.rack
        await first.drive(46.0, 100.0, 36.5)
        await second.begin(rack.session, factor=FACTOR)
        await second.drive(40.0, 50.0, 35.5)

        async def refused() -> bool:
            return bool((await second.alarm(AlarmKind.PLANT_OTHER_MASTER)).active)

        await rack.until(refused)
        await rack.passes(100)
        holder = (await first.link()).holder

        async def stands_by() -> bool:
            shown = await second.link()
            return (shown.state, shown.cause) == (PlantLinkState.OTHER_MASTER, LinkCause.SECOND_MASTER)

        await rack.until(stands_by)
        raised = [event.subject for event in await second.events(EventKind.ALARM_RAISED)]
        assert raised.count(AlarmKind.PLANT_OTHER_MASTER) <= 1 + raised.count(AlarmKind.PLANT_LOST), "not to and fro"
        lease, counted = await rack.client.read(LeaseStatus), await rack.client.read(ServerStatistics)
        assert (lease.state, lease.holder) == (LeaseState.HELD, holder)
        assert lease.refused >= 1
        assert counted.second_writer >= 1
        driven = [u[0] for u in rack.applied.values()]
        assert is_raised_only(driven), "towards the setpoint of the first, not to and fro"
        assert len(await second.events(EventKind.PLANT_LINK)) < 10, "one that stands by does not fill its journal"

        first.service.kill()
        await rack.until(lambda: drives(second.client, rack.client))
        await rack.passes(40)
        await site.follows(second)
        assert rack.violations() == []


async def test_of_two_control_plcs_with_the_same_retained_number_one_drives_and_the_other_is_told(
    field: "FieldAt", tmp_path: Path
) -> None:
    kept, copied = tmp_path / "kept", tmp_path / "copied"
    async with field() as site:
        first = await site.joined(f'control_plc.retain.file="{kept}"', factor=FACTOR)
        rack = site.rack
        await first.drive(46.0, 100.0, 36.5)
        await rack.passes(20)
        shutil.copy(kept, copied)
        second = site.control(f'control_plc.retain.file="{copied}"')
        await rack.until(second.answers)
        await second.drive(40.0, 50.0, 35.5)
        assert (await second.link()).holder == (await first.link()).holder

        async def told() -> bool:
            alarms = [await one.alarm(AlarmKind.PLANT_OTHER_MASTER) for one in (first, second)]
            return any(alarm.active for alarm in alarms)

        await rack.until(told)
        await rack.passes(10)

        async def goes_one_way() -> (
            bool
        ):  # in the next 100 ticks; where a busy machine lets one lapse, the other drives
            begun = rack.tick
            await rack.passes(100)
            driven = [u[0] for u in rack.since(begun)]
            return is_raised_only(driven) or is_raised_only([-u for u in driven])

        await rack.until(goes_one_way)
        assert rack.violations() == []


async def test_a_control_plc_that_was_stopped_while_another_took_over_does_not_interfere(field: "FieldAt") -> None:
    async with field() as site:
        second = site.control()
        first, rack = await site.joined(factor=FACTOR), site.rack
        await first.drive(46.0, 100.0, 36.5)
        await second.begin(rack.session, factor=FACTOR)
        await second.drive(40.0, 50.0, 35.5)
        await rack.passes(40)
        first.service.pause()
        await rack.until(lambda: drives(second.client, rack.client))
        begun = rack.tick + 4
        first.service.resume()
        await rack.passes(100)
        await site.follows(second)

        async def told() -> bool:
            link, alarm = await first.link(), await first.alarm(AlarmKind.PLANT_OTHER_MASTER)
            return link.state == PlantLinkState.OTHER_MASTER and bool(alarm.active)

        await rack.until(told)
        driven = [u[0] for u in rack.since(begun)]
        assert is_raised_only(driven), "from the safe state towards the setpoint of the second"
        assert rack.violations() == []


async def drives(control: RegisterClient, rack: RegisterClient) -> bool:
    link, lease = await control.read(PlantLinkStatus), await rack.read(LeaseStatus)
    return link.state == PlantLinkState.SYNCHRONISED and lease.holder == link.holder


async def test_a_second_optimiser_is_refused_and_takes_over_when_the_first_is_killed(
    field: "FieldAt", processes: "Processes"
) -> None:
    async with field() as site:
        control, rack = site.control(), site.rack
        settings = (
            f"optimizer_plc.control_plc.port={control.service.port}",
            "session.mode=realtime",
            "session.factor=2",
            "optimizer_plc.program.updating_period_s=2.0",
        )
        optimizers = [processes.service("optimizer_plc", *settings) for _ in range(2)]
        clients = [RegisterClient(OPTIMIZER_MAP, host="127.0.0.1", port=one.port, timeout_s=5.0) for one in optimizers]
        for client in clients:
            await client.connect(START_S)
        await rack.begin(factor=2.0)
        await control.begin(rack.session, factor=2.0)

        async def accepted(count: int) -> bool:
            return (await control.client.read(Status)).accepted >= count

        async def states() -> list[int]:
            return [(await client.read(ControlLinkStatus)).state for client in clients]

        await rack.until(lambda: accepted(2))
        found = await states()
        standing_by = found.index(ControlLinkState.OTHER_MASTER)
        assert found[1 - standing_by] != ControlLinkState.OTHER_MASTER
        alarm, lease = await control.alarm(AlarmKind.SECOND_WRITER), await control.client.read(LeaseStatus)
        assert alarm.active
        assert lease.refused >= 1
        working = await clients[1 - standing_by].read(ControlLinkStatus)
        assert lease.holder == working.holder
        status = await control.client.read(Status)
        assert working.rejected <= status.deadline_misses + status.overruns, "it is late on a busy machine, and no more"

        optimizers[1 - standing_by].kill()
        before = (await control.client.read(Status)).accepted
        await rack.until(lambda: accepted(before + 2))
        assert (await clients[standing_by].read(ControlLinkStatus)).state != ControlLinkState.OTHER_MASTER
        assert rack.violations() == []
        for client in clients:
            client.close()
