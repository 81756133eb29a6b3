"""Options that several subcommands share, and how their values are read."""

import argparse
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from coldloop.errors import UsageError
from coldloop.process import TICK_S
from rig.commands.choices import LOADS

if TYPE_CHECKING:
    from coldloop.config import Configuration
    from rig.settings import Settings

_UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}

KEYS = {
    "load": ("plant.load", "--load"),
    "seed": ("plant.seed", "--seed"),
    "solver": ("optimizer_plc.program.solver", "--solver"),
    "updating_period": ("optimizer_plc.program.updating_period_s", "--updating-period"),
    "mode": ("session.mode", "--mode"),
    "factor": ("session.factor", "--factor"),
}
"""Options that set one key of the configuration."""


class HostPort(NamedTuple):
    """Address of a server."""

    host: str
    port: int


def duration(text: str) -> int:
    """Return a duration such as 90, 90s, 15min or 2h as ticks."""
    match = re.fullmatch(r"([+-]?\d+(?:\.\d+)?)\s*([a-z]*)", text.strip().lower())
    if match is None or match[2] not in _UNITS:
        raise argparse.ArgumentTypeError(f"'{text}' is not a duration; write 90s, 15min or 2h")
    ticks = float(match[1]) * _UNITS[match[2]] / TICK_S
    if ticks <= 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not positive; write 90s, 15min or 2h")
    if ticks != round(ticks):
        raise argparse.ArgumentTypeError(f"'{text}' is not a multiple of {TICK_S} s")
    return round(ticks)


def updating_period(text: str) -> float:
    """Return an updating period in seconds, 0 for `adaptive`."""
    return 0.0 if text == "adaptive" else _period(text, "neither 'adaptive' nor seconds from 0.5 to 5")


def fixed_updating_period(text: str) -> float:
    """Return an updating period in seconds."""
    value = _period(text, "not seconds from 0.5 to 5")
    if value < 2 * TICK_S or value % TICK_S:
        raise argparse.ArgumentTypeError(f"'{text}' is not a multiple of {TICK_S} s from 0.5 to 5 s")
    return value


def _period(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value <= 5:
        raise argparse.ArgumentTypeError(f"'{text}' is {what}")
    return value


def check_load(name: str | None) -> None:
    """Refuse a load that is neither a name nor a file, before anything that takes time; the file is read later.

    Raises:
        UsageError: There is no such load.
    """
    if name is not None and name.partition("@")[0] not in LOADS and not (name and Path(name).exists()):
        raise UsageError(f"load '{name}': neither a file nor one of {', '.join(LOADS)}")


def endpoint(text: str) -> HostPort:
    """Return HOST:PORT as an address."""
    host, separator, port = text.rpartition(":")
    if not separator or not host or not port.isdecimal() or not 0 < int(port) < 0x10000:
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT")
    return HostPort(host.strip("[]"), int(port))


def configuration(options: argparse.Namespace) -> "Configuration[Settings]":
    """Return the effective configuration of a command."""
    from coldloop.config import load_configuration
    from rig.settings import Settings

    given: Mapping[str, Any] = vars(options)
    return load_configuration(
        Settings,
        file=options.config,
        assignments=options.assignments,
        options={key: (given[name], flag) for name, (key, flag) in KEYS.items() if given.get(name) is not None},
    )
