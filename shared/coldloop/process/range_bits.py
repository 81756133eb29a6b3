"""What of the plant can leave the range of its property tables."""

from enum import IntFlag


class ModelRange(IntFlag):
    """What of the simulation is outside its property tables, one bit each."""

    BATH_PRESSURE = 1
    SUPPLY_PRESSURE = 2
    RETURN_PRESSURE = 4
    COLD_CELL = 8
    WARM_CELL = 16
    WARM_BATH = 32
