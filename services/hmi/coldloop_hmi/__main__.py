"""`python -m coldloop_hmi`: the operator's page as a service."""

import sys
from importlib.util import find_spec

from coldloop.service.start import main
from coldloop_hmi.settings import HmiSettings


def start() -> int:
    """Run the service; return its exit code."""
    if find_spec("aiohttp") is None:
        sys.stderr.write("hmi: the operator's page needs aiohttp: pip install 'coldloop[hmi]'\n")
        return 1
    from coldloop_hmi.runtime import serve  # noqa: PLC0415 without the extra there is nothing to import

    return main("hmi", HmiSettings, serve, None)


if __name__ == "__main__":
    sys.exit(start())
