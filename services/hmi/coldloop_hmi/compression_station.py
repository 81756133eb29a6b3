"""What the page shows of a whole refrigerator beyond the cold box: mode and alarms of the station, and its limits."""

from collections.abc import Mapping
from typing import Any, Final

from coldloop.registers.plant import StationAlarm, StationMode, StationStatus
from coldloop.service.event_text import word_of
from coldloop_hmi.process_image import Model

KIND: Final = "plant.kind"
REFRIGERATOR: Final = "refrigerator"
SIGNALS: Final = "plant.station.signals."
ALARMS: Final = "plant.station.alarms."
LIMITS: Final[Mapping[str, tuple[str | None, str | None]]] = {
    "P12": ("hp_low_bar", "hp_high_bar"),
    "P11": ("lp_low_bar", "lp_high_bar"),
    "L_N2": ("nitrogen_low", None),
    "lost": (None, "helium_lost_kg"),
}
"""Where the station's alarms begin, by signal: below, above."""


def plant_document(model: Model) -> dict[str, Any]:
    """Return the kind of the plant as it reports it; of a refrigerator also the state of its station."""
    kind = model.configuration.get(KIND, "")
    if kind != REFRIGERATOR:
        return {"kind": kind}
    status = model.record("plant", StationStatus) or StationStatus()
    return {
        "kind": kind,
        "mode": word_of(StationMode, status.mode),
        "alarms": [str(one.name).lower().replace("_", " ") for one in StationAlarm if status.alarms & one],
        "bands": {f"{SIGNALS}{name}": _band(model, *keys) for name, keys in LIMITS.items()},
    }


def _band(model: Model, *keys: str | None) -> list[float | None]:
    values = (model.configuration.get(f"{ALARMS}{key}") if key else None for key in keys)
    return [float(value) if isinstance(value, int | float) else None for value in values]
