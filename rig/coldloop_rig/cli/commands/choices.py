"""Names that the command line offers, written down so that it can offer them without importing what they name.

`tests/rig/test_command_line.py` compares them with what there is.
"""

from importlib.resources import files
from typing import Final

MODES: Final = ("lockstep", "realtime")
SOLVERS: Final = ("ode", "qpoases", "osqp", "fast-gradient", "interior-point", "hybrid", "daqp")
PRESETS: Final = ("tuned", "paper", "as-printed")
LOADS: Final = ("a", "b", "c", "d", "e", "f", "2h", "6h", "8h", "pulses", "quench")
SERVICES: Final = ("control_plc", "optimizer_plc", "plant")
WITHOUT: Final = ("optimizer",)
REGISTER_FORMATS: Final = ("csv", "json", "markdown", "table")
TAG_FORMATS: Final = ("fuxa", "grafana", "ignition", "node-red", "telegraf")
FIGURE_FORMATS: Final = ("png", "pdf", "svg")
STUDIES: Final = (
    "cholesky", "unlimited", "limited", "solver-comparison", "trajectories", "updating-period", "plc-2h", "adaptive-2h",
    "trade-off", "classical", "single-precision", "coupling", "disturbances",
    "robustness", "contest", "penalties", "periods", "compare",
)  # fmt: skip


def plans() -> list[str]:
    """Return the names of the chaos plans that are shipped."""
    folder = files("coldloop_rig.chaos") / "plans"
    return sorted(file.name.removesuffix(".toml") for file in folder.iterdir() if file.name.endswith(".toml"))
