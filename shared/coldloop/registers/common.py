"""The corner at address 0 that is the same in every map."""

from enum import IntEnum
from typing import Annotated, Final, NamedTuple

from coldloop.registers.declaration import Block, f32, u16, u32

MAGIC: Final = 123.456


class ServiceState(IntEnum):
    """What a service is doing, in `Identity.state`."""

    READY = 0
    RUNNING = 1


class Identity(NamedTuple):
    """Who answers, which map it speaks, and whether it is alive."""

    magic: Annotated[float, f32("Always 123.456: reads right only with the right word order")] = MAGIC
    map_digest: Annotated[int, u32("Digest of this register map")] = 0
    map_version: Annotated[int, u16("Version of this register map")] = 0
    state: Annotated[int, u16("0 ready, 1 running")] = ServiceState.READY
    model_digest: Annotated[int, u32("First 32 bits of the digest of the prediction model in use")] = 0
    session: Annotated[int, u32("Session being run")] = 0
    tick: Annotated[int, u32("Present tick of plant time, counted from the start of the session", unit="0.25 s")] = 0
    heartbeat: Annotated[int, u16("Rises with every tick or update, and wraps")] = 0


IDENTITY_BLOCK: Final = Block("identity", 0, Identity, "Who answers, and whether it is alive")
