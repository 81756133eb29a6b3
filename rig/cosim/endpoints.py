"""Where the three servers of a rig are."""

from typing import NamedTuple

from coldloop.modbus.endpoints import Endpoint


class RigEndpoints(NamedTuple):
    """Where the three servers are."""

    plant: Endpoint
    control_plc: Endpoint
    optimizer_plc: Endpoint
