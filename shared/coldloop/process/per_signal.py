"""Types of settings that have a number for each input, or for each output with a band, of the process."""

from typing import TYPE_CHECKING

from pydantic import FiniteFloat, PositiveFloat

from coldloop.process.signals import CONTROLLED, INPUT_NAMES

if TYPE_CHECKING:
    PerInput = tuple[float, ...]
    PositivePerInput = tuple[float, ...]
    PerBand = tuple[float, ...]
    PositivePerBand = tuple[float, ...]
else:
    PerInput = tuple[(FiniteFloat,) * len(INPUT_NAMES)]
    PositivePerInput = tuple[(PositiveFloat,) * len(INPUT_NAMES)]
    PerBand = tuple[(FiniteFloat,) * len(CONTROLLED)]
    PositivePerBand = tuple[(PositiveFloat,) * len(CONTROLLED)]
