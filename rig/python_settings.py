"""The configuration that Python arguments describe, for `simulate` and for rigs of tests."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from coldloop.config import Configuration, load_configuration
from rig.settings import Settings

Period = float | Literal["adaptive"]
Sections = Mapping[str, Mapping[str, object] | object]


def configured(
    *,
    load: str | Path,
    solver: str,
    updating_period: Period,
    seed: int,
    config: str | Path | None,
    sections: Sections,
    mode: str | None = None,
    factor: float | None = None,
) -> Configuration[Settings]:
    """Return the configuration; the environment has no influence.

    Raises:
        UsageError: An argument cannot be used; one line that says why.
    """
    options: dict[str, tuple[object, str]] = {
        "plant.load": (str(load), "load"),
        "plant.seed": (seed, "seed"),
        "optimizer_plc.program.solver": (solver, "solver"),
        "optimizer_plc.program.updating_period_s": (0.0 if updating_period == "adaptive" else updating_period,
                                                    "updating_period"),
        **_flattened(sections),
    }  # fmt: skip
    if mode is not None:
        options["session.mode"] = mode, "mode"
    if factor is not None:
        options["session.factor"] = factor, "factor"
    return load_configuration(Settings, file=None if config is None else Path(config), environment={}, options=options)


def _flattened(sections: Mapping[str, object], prefix: str = "") -> dict[str, tuple[object, str]]:
    flat: dict[str, tuple[object, str]] = {}
    for key, value in sections.items():
        if isinstance(value, Mapping):
            flat |= _flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = (value, f"{prefix}{key}")
    return flat
