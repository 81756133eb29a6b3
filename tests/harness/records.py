"""Records of the cold box as the tests write them."""

from typing import Any, Final, NamedTuple, TypeVar, cast

from coldloop.kernels.single_precision import single
from coldloop.process.cold_box import COLD_BOX
from coldloop.registers import codec, maps_of
from coldloop.registers.declaration import RegisterMap

R = TypeVar("R", bound=tuple[Any, ...])
PLANT_MAP, CONTROL_MAP, OPTIMIZER_MAP = maps_of(COLD_BOX)
MAPS: Final = maps_of(COLD_BOX).by_service
"""Register maps by service."""


class Row(NamedTuple):
    """Inputs of one tick."""

    cv155: float
    ncr22: float
    cv156: float


def map_of(record: type[tuple[Any, ...]]) -> RegisterMap:
    """Return the map that has a record."""
    return next(one for one in MAPS.values() if record in [block.record for block in one.blocks])


def as_transmitted(record: R) -> R:
    """Return a record, or a row of a sequence, as its reader sees it."""
    if isinstance(record, Row) or type(record) is tuple:
        return cast("R", Row(*map(single, record)))
    return codec.as_transmitted(record, map_of(type(record)))


def sealed(record: R) -> R:
    """Return a record with its CRC."""
    return codec.sealed(record, map_of(type(record)))
