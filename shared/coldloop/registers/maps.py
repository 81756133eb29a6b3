"""The register maps of the three services."""

from collections.abc import Mapping
from typing import Final

from coldloop.registers.control_plc import CONTROL_MAP
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.optimizer_plc import OPTIMIZER_MAP
from coldloop.registers.plant import PLANT_MAP

MAPS: Final[Mapping[str, RegisterMap]] = {one.service: one for one in (PLANT_MAP, CONTROL_MAP, OPTIMIZER_MAP)}
"""By service, in the order in which a command is written: those who follow the plant's clock after it."""
