"""Where the three servers of a rig are."""

from typing import Final, NamedTuple

from coldloop.modbus.endpoints import Endpoint

REQUIRED: Final = ("plant", "control_plc")
"""Services of every rig; an optimiser may be somebody else's (`up --without optimizer`)."""


class RigEndpoints(NamedTuple):
    """Where the three servers are."""

    plant: Endpoint
    control_plc: Endpoint
    optimizer_plc: Endpoint
