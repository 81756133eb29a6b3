"""How processes of this package are started."""

import sys
from typing import Final

PYTHON: Final = (sys.executable, "-P")
"""Without the folder where the user is: a `plant.py` that is there is not ours, and would be run in the place of it."""
