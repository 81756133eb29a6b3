"""What more than one Coldloop service needs: registers, the bus, the clock, configuration and telemetry."""

from typing import Final

__version__: Final = "0.3.0"
