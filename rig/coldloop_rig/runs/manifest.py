"""The manifest of a run: versions, configuration, inputs and hashes; what it takes to repeat the run."""

import argparse
import platform
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Final

from coldloop import __version__
from coldloop.config import Configuration
from coldloop.process.lti_model import load as load_model
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.columns import FORMAT
from coldloop_rig.results.folders import installed_version
from coldloop_rig.runs.inputs import configuration_digest
from coldloop_rig.settings import Settings

DEPENDENCIES: Final = (
    "numpy", "scipy", "numba", "pymodbus", "pydantic", "aiomqtt", "osqp", "daqp", "casadi", "pyarrow", "matplotlib",
)  # fmt: skip
RUNNING: Final = "the run has not ended, or its process was killed"


def now_utc() -> str:
    """Return the time in ISO 8601, such as 2026-03-01T12:00:00.000Z."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def first_manifest(
    effective: Configuration[Settings], scenario: Scenario, inputs: Mapping[str, Any], way: str,
    arguments: Mapping[str, Any],
) -> dict[str, Any]:  # fmt: skip
    """Return the manifest as it is written before the first tick, incomplete."""
    configured = {key: value for key, value, _ in effective.effective() if value is not None}  # None is "not set"
    model = load_model(effective.settings.model.file)
    return {
        "format": FORMAT,
        "complete": False,
        "reason": RUNNING,
        "started_utc": now_utc(),
        "ended_utc": None,
        "coldloop": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "dependencies": {name: installed_version(name) for name in DEPENDENCIES},
        "command": sys.argv[1:],
        "arguments": dict(arguments),
        "way": way,
        "ticks": scenario.ticks,
        "recorded_ticks": 0,
        "configuration": configured,
        "inputs": dict(inputs),
        "hashes": {
            "configuration_sha256": configuration_digest(configured),
            "model_sha256": model.digest,
            "plant_parameters_sha256": model.parameters_digest,
            "trace_sha256": None,
        },
    }


def final_manifest(first: Mapping[str, Any], reason: str | None, ticks: int, trace_sha256: str) -> dict[str, Any]:
    """Return the manifest as it is written after the last tick; without a reason the run is complete."""
    return {
        **first,
        "complete": reason is None,
        "reason": reason,
        "ended_utc": now_utc(),
        "recorded_ticks": ticks,
        "hashes": {**first["hashes"], "trace_sha256": trace_sha256},
    }


def plain_arguments(options: argparse.Namespace) -> dict[str, str]:
    """Return the options of a command that were given, as text."""
    return {name: str(value) for name, value in vars(options).items() if name != "execute" and value is not None}
