"""Restores a rig that ran in real time before a client attached to it."""

import logging
from typing import NamedTuple

from coldloop.errors import LinkError
from coldloop.operating.execution import LoadStream, lead_ticks, write_pace
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.codec import sealed
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import Operator, OperatorMode
from coldloop.registers.plant import LOAD_ROWS, LiveLoad, LoadStatus, LoadStep, PlantSession
from coldloop_rig.cosim.session import SessionClient

log = logging.getLogger("coldloop.rig")


class SavedSession(NamedTuple):
    """State of a rig when the client attached."""

    pace: SessionPace
    operator: Operator
    load: LoadProfile
    """Load from that tick on, W."""


async def save_session(rig: SessionClient) -> SavedSession | None:
    """Return the session of a rig if it runs in real time.

    Raises:
        LinkError: A service does not answer.
    """
    identity, pace = await rig.plant.read(Identity), await rig.plant.read(SessionPace)
    if not identity.session or not pace.realtime:
        return None
    return SavedSession(pace, await rig.control.read(Operator), await _load_from(rig, identity.tick))


async def _load_from(rig: SessionClient, now: int) -> LoadProfile:
    """Return the load from now on: of the session's table, unless another client has written one since."""
    status, asked = await rig.plant.read(LoadStatus), await rig.plant.read(PlantSession)
    steps: list[LoadStep] = []
    if status.upcoming:
        steps = await rig.plant.read_rows(LoadStep, 0, min(asked.load_steps, LOAD_ROWS))
    if not steps or steps[-1].tick != status.last_tick:
        steps = []
    coming = [step for step in steps if step.tick > now]
    try:
        return LoadProfile((0, *(step.tick - now for step in coming)), (status.watts, *(step.watts for step in coming)))
    except ValueError as error:
        raise LinkError(f"{rig.plant.peer}: its load is invalid: {error}") from None


async def restore_session(rig: SessionClient, saved: SavedSession | None, session: int) -> None:
    """Restore real time, factor, load and operating mode of the rig in the session of our run.

    Nothing is done where the rig was in lock-step, or where another client has begun another session. A failure
    is logged: the run is recorded all the same.
    """
    if saved is None:
        return
    try:
        identity = await rig.plant.read(Identity)
        if identity.session != session:
            return
        await write_pace(rig.clients, saved.pace._replace(session=0))
        if saved.operator.mode != OperatorMode.AUTO:
            await rig.control.write(saved.operator)
        tick = (await rig.plant.read(Identity)).tick
        await rig.plant.write(sealed(LiveLoad(0, saved.load.watts[0]), rig.plant.map))
        coming = LoadProfile(saved.load.times, saved.load.watts)
        await LoadStream(
            rig.plant, session, coming, begin=tick + lead_ticks(saved.pace, rig.plant.process.tick_s)
        ).feed(tick)
    except LinkError as error:
        log.warning("the rig was not restored: %s", error)
    else:
        log.info("restored at %g s", tick * rig.plant.process.tick_s)
