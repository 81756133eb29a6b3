"""Register maps: each register is declared once, everything else is derived from the declaration."""

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

from coldloop.process.declaration import Process
from coldloop.registers.control_plc import control_map
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.optimizer_plc import optimizer_map
from coldloop.registers.plant import plant_map


class Maps(NamedTuple):
    """The register maps of a process; commands are written in this order, to those who follow the plant after it."""

    plant: RegisterMap
    control_plc: RegisterMap
    optimizer_plc: RegisterMap

    @property
    def by_service(self) -> Mapping[str, RegisterMap]:
        """The maps by the names of their services."""
        return self._asdict()


@cache
def maps_of(process: Process) -> Maps:
    """Return the register maps of a process."""
    return Maps(plant_map(process), control_map(process), optimizer_map(process))
