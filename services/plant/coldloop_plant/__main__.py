"""`python -m coldloop_plant`: the plant as a service."""

import sys

from coldloop.kernels.cache import load_numba_alone
from coldloop.service.start import in_one_line, main


def start() -> int:
    """Run the service; return its exit code."""
    load_numba_alone()
    from coldloop_plant.runtime import serve  # noqa: PLC0415 has numba imported
    from coldloop_plant.settings import PlantSettings  # noqa: PLC0415

    return main("plant", PlantSettings, serve, None)


if __name__ == "__main__":
    sys.exit(in_one_line("plant", start))
