"""`python -m optimizer_plc`: the optimiser PLC as a service of its own."""

import sys

from coldloop.service import main
from optimizer_plc.runtime import serve
from optimizer_plc.settings import OptimizerSettings

if __name__ == "__main__":
    sys.exit(main("optimizer_plc", OptimizerSettings, serve, None))
