"""An optimiser that is not ours drives another process by its register map; one that breaks off does no harm."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest
from pymodbus.client import ModbusTcpClient

from coldloop.registers.control_plc import Mode
from tests.harness.processes import Processes
from tests.process.outside_client import HOLDER, HOST, Optimiser, SideBySide
from tests.process.site import COLUMN, TANK, Case, up

WITHOUT: Final = ("--without", "optimizer")


@pytest.mark.usefixtures("realtime")
@pytest.mark.parametrize(
    "case", [pytest.param(TANK, id="tank", marks=pytest.mark.night), pytest.param(COLUMN, id="column")]
)
def test_pi_controllers_by_registers_drive_a_process(case: Case, processes: Processes, tmp_path: Path) -> None:
    with up(case, processes, tmp_path, *WITHOUT) as site, site.optimiser() as optimiser:
        optimiser.introduce()
        site.drives(optimiser, 4)
        site.assert_no_step()
        measured = site.control.read("process")
    assert [measured[f"y.{loop.output}"] for loop in case.loops] == pytest.approx(
        [loop.setpoint for loop in case.loops], abs=0.3
    )


def closes(optimiser: Optimiser, rows: bytes) -> None:  # noqa: ARG001 it does not come to the header
    """Lose the connection when all rows have been written."""
    optimiser.client.close()  # type: ignore[no-untyped-call]


def closes_in_a_request(optimiser: Optimiser, rows: bytes) -> None:
    """Lose the connection within the request that would commit them."""
    optimiser.send_half_a_request(optimiser.next_update(), rows)
    optimiser.client.close()  # type: ignore[no-untyped-call]


def falls_silent(optimiser: Optimiser, rows: bytes) -> None:
    """Keep the connection, and say no more within that request."""
    optimiser.send_half_a_request(optimiser.next_update(), rows)


@pytest.mark.usefixtures("realtime")
@pytest.mark.parametrize(
    "breaks_off", [closes_in_a_request, *(pytest.param(one, marks=pytest.mark.night) for one in (closes, falls_silent))]
)
def test_one_that_breaks_off_in_a_sequence_leaves_the_ladder_to_act_without_a_step(
    breaks_off: Callable[[Optimiser, bytes], None], processes: Processes, tmp_path: Path
) -> None:
    with up(TANK, processes, tmp_path, *WITHOUT) as site, ExitStack() as first:
        optimiser = first.enter_context(site.optimiser())
        optimiser.introduce()
        site.drives(optimiser, 3)
        accepted = site.control.read("status")["accepted"]
        optimiser.plan(optimiser.next_update())
        breaks_off(optimiser, optimiser.send_rows([loop.high for loop in TANK.loops]))
        modes = site.modes_until(Mode.CLASSICAL)
        assert modes == [Mode.MPC, Mode.REST, Mode.HOLD, Mode.CLASSICAL]
        assert site.control.read("status")["accepted"] == accepted
        with site.optimiser() as second:
            second.introduce()
            site.drives(second, 2)
        site.assert_no_step()


@pytest.mark.usefixtures("realtime")
def test_a_connection_per_block_drives_a_process_and_a_copied_number_does_not(
    processes: Processes, tmp_path: Path
) -> None:
    with up(COLUMN, processes, tmp_path, *WITHOUT) as site, ExitStack() as held:
        optimiser = held.enter_context(site.optimiser(SideBySide))
        optimiser.introduce()
        site.drives(optimiser, 2)
        assert len(optimiser.clients) == 5
        stranger = ModbusTcpClient(HOST, port=site.port, source_address=("127.0.0.2", 0), retries=0)
        assert stranger.connect()  # type: ignore[no-untyped-call]
        words = optimiser.sealed("heartbeat", 0, 0, HOLDER)
        refused = stranger.write_registers(site.control_blocks["heartbeat"].address, words)
        stranger.close()  # type: ignore[no-untyped-call]
        assert (refused.exception_code, site.control.read("optimiser lease")["holder"]) == (6, HOLDER)
        assert site.control.read("statistics")["second_writer"] == 1
        optimiser.clients.pop("plan").close()  # type: ignore[no-untyped-call]
        site.drives(optimiser, 2)
        optimiser.plan(optimiser.next_update())
        optimiser.send_rows([loop.high for loop in COLUMN.loops])
        held.close()
        assert site.modes_until(Mode.CLASSICAL) == [Mode.MPC, Mode.REST, Mode.HOLD, Mode.CLASSICAL]
        site.assert_no_step()
