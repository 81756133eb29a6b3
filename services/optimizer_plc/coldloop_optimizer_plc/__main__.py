"""`python -m coldloop_optimizer_plc`: the optimiser PLC as a service."""

import sys

from coldloop.kernels.cache import load_numba_alone
from coldloop.service.start import in_one_line, main


def start() -> int:
    """Run the service; return its exit code."""
    load_numba_alone()
    from coldloop_optimizer_plc.runtime import serve  # noqa: PLC0415 has numba imported
    from coldloop_optimizer_plc.settings import OptimizerSettings  # noqa: PLC0415

    return main("optimizer_plc", OptimizerSettings, serve, None)


if __name__ == "__main__":
    sys.exit(in_one_line("optimizer_plc", start))
