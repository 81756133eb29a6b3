"""`python -m plant`: the plant as a service of its own."""

import sys

from coldloop.service import main
from plant.runtime import serve
from plant.settings import PlantSettings

if __name__ == "__main__":
    sys.exit(main("plant", PlantSettings, serve, None))
