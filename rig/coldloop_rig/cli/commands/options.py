"""Options that several commands share, how their values are read, and the names that they offer.

These names are written down, so that they can be offered without importing what they name;
`tests/rig/test_command_line.py` compares them with what there is.
"""

import argparse
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from coldloop.errors import UsageError
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.service import add_configuration_options
from coldloop_rig.cli import process_setting

if TYPE_CHECKING:
    from coldloop.config import Configuration
    from coldloop_rig.cosim.wiring import OperatorSettings, RigEndpoints
    from coldloop_rig.settings import Settings


MODES: Final = ("lockstep", "realtime")
SOLVERS: Final = ("ode", "qpoases", "osqp", "fast-gradient", "interior-point", "hybrid", "daqp")
PRESETS: Final = ("tuned", "paper", "as-printed")
LOADS: Final = ("a", "b", "c", "d", "e", "f", "2h", "6h", "8h", "pulses", "quench")
SERVICES: Final = ("control_plc", "optimizer_plc", "plant")
WITHOUT: Final = ("optimizer",)
REGISTER_FORMATS: Final = ("csv", "json", "markdown", "table")
TAG_FORMATS: Final = ("fuxa", "grafana", "ignition", "node-red", "telegraf")
FIGURE_FORMATS: Final = ("png", "pdf", "svg")


KEYS = {
    "load": "plant.load",
    "seed": "plant.seed",
    "solver": "optimizer_plc.program.solver",
    "outside_solver": "optimizer_plc.program.outside.solver",
    "preset": "optimizer_plc.program.preset",
    "updating_period": "optimizer_plc.program.updating_period_s",
    "mode": "session.mode",
    "factor": "session.factor",
    "page_port": "hmi.port",
}
"""Options that set one key of the configuration."""
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")


class Command(NamedTuple):
    """A command: its options, and what does it; that one's docstring describes it."""

    declare: Callable[[argparse.ArgumentParser], None]
    execute: Callable[[argparse.Namespace], int]


class HostPort(NamedTuple):
    """Address of a server."""

    host: str
    port: int


def updating_period(text: str) -> float:
    """Return an updating period in seconds, 0 for `adaptive`."""
    return 0.0 if text == "adaptive" else fixed_updating_period(text, "neither 'adaptive' nor a")


def fixed_updating_period(text: str, what: str = "not a") -> float:
    """Return an updating period in seconds; `what` goes before the span in the message about another text."""
    from coldloop.process.settings import settings_process

    process = settings_process()
    if not SHORTEST_TICKS <= ticks_of(text, process.tick_s) <= process.ticks_per_sample:
        span = f"{SHORTEST_TICKS * process.tick_s:g} to {process.sampling_period_s:g} s"
        raise argparse.ArgumentTypeError(f"'{text}' is {what} multiple of {process.tick_s:g} s, a tick, from {span}")
    return float(text)


def number_within(text: str, least: int, most: float, what: str) -> int:
    """Return a whole number of an option; `what` is what the text is not where it is none."""
    if not text.isdecimal() or not least <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"'{text}' is not {what}")
    return int(text)


def ticks_of(text: str, tick_s: float) -> int:
    """Return a time in seconds as ticks of `tick_s`; -1 where it is no number, or not whole ticks."""
    from coldloop.process.updating_periods import whole_ticks

    try:
        ticks = whole_ticks(float(text), tick_s)
    except ValueError:
        ticks = None
    return -1 if ticks is None else ticks


def positive_count(text: str) -> int:
    """Return a number of things of an option, 1 at least."""
    return number_within(text, 1, math.inf, "a whole number of at least 1")


def positive_number(most: float, what: str, text: str) -> float:
    """Return a number of an option above 0, `most` at most; `what` is what the text is not where it is none."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= most:
        raise argparse.ArgumentTypeError(f"'{text}' is not {what}")
    return value


def check_load(name: str | None) -> None:
    """Refuse a load that is neither a name nor a file, before anything that takes time; the file is read later.

    Raises:
        UsageError: There is no such load, or the process has none.
    """
    if name is None:
        return
    if name.partition("@")[0] not in LOADS and not (name and Path(name).exists()):
        raise UsageError(f"load '{name}': neither a file nor one of {', '.join(LOADS)}")
    from coldloop.process.settings import settings_process

    process = settings_process()
    if not process.has_load:
        raise UsageError(f"load '{name}': {process.name} has no load; leave it out")


def endpoint(text: str) -> HostPort:
    """Return HOST:PORT as an address."""
    host, separator, port = text.rpartition(":")
    if not separator or not host or not port.isdecimal() or not 0 < int(port) < 0x10000:
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT")
    return HostPort(host.strip("[]"), int(port))


def port_base(text: str) -> int:
    """Return the first of three ports in a row."""
    return number_within(text, 1, 0xFFFF - 2, f"a port from 1 to {0xFFFF - 2}")


def add_rig_options(parser: argparse.ArgumentParser, *, again: bool = False) -> None:
    """Declare the configuration, and where a rig that is up is found; `again` for a subcommand, as there."""
    add_configuration_options(parser, again=again)
    default = argparse.SUPPRESS if again else None
    parser.add_argument("--rig", nargs=3, type=endpoint, default=default, metavar="HOST:PORT",
                        help="plant, control PLC, optimiser PLC (default: the one rig that is up here)")  # fmt: skip
    parser.add_argument("--port-base", type=port_base, default=default, metavar="PORT",
                        help="first of its three ports in a row here, where several rigs are up")  # fmt: skip
    parser.add_argument("--tls", type="folder", default=default, metavar="FOLDER",
                        help="folder with the operator's certificate; known for a rig started here")  # fmt: skip


def add_loop_options(parser: argparse.ArgumentParser, loads: str) -> None:
    """Declare what the loop does; `loads` says which loads there are besides those with a name."""
    loads = f"{loads}a CSV file of times and loads"
    load = parser.add_argument("--load", type="name", help=f"{', '.join(LOADS)}, {loads} (default: 2h)")
    load.completer = lambda **_: LOADS  # type: ignore[attr-defined]  # argcomplete looks for it
    parser.add_argument("--solver", choices=SOLVERS, help="default: ode")
    parser.add_argument("--outside-solver", metavar="NAME",
                        help="clarabel, piqp, qpalm (each an extra of this name), or a solver that is installed"
                        " beside, by its entry point (`coldloop docs extending`)")  # fmt: skip
    parser.add_argument("--preset", choices=PRESETS, help="of solver and estimator (default: tuned)")
    parser.add_argument("--updating-period", type=updating_period, metavar="adaptive|SECONDS",
                        help="default: adaptive")  # fmt: skip
    parser.add_argument("--seed", type=int, help="seed of the sensors' noise (default: 1)")
    parser.add_argument("--enforce", action="store_true",
                        help="lengthen the updating period to what the PLC takes; refuse where the longest is too"
                        " short")  # fmt: skip


def add_result_options(parser: argparse.ArgumentParser, folder: str) -> None:
    """Declare where results go, by default into `folder`."""
    parser.add_argument("--out", type="into", help=f"folder for the results (default: runs/{folder}-<time>)")
    parser.add_argument("--force", action="store_true", help="replace the run in a folder that is not empty")
    parser.add_argument("--figures", nargs="+", choices=FIGURE_FORMATS, default=["png"], metavar="FORMAT",
                        help="png, pdf, svg (default: png)")  # fmt: skip


def exported(given: str | None, settings: "Settings") -> tuple[str, ...]:
    """Return the program of `--optimizer`; nothing without it.

    Raises:
        UsageError: It cannot take the optimiser's place in this run.
    """
    if given is None:
        return ()
    kind = given.partition(":")[0]
    known = entry_points(group="coldloop.optimizers")
    if kind not in known.names:
        kinds = " or ".join(f"{name}:FOLDER" for name in sorted(known.names))
        raise UsageError(f"--optimizer {given}: give {kinds}; `coldloop docs plc-export` says more")
    program: tuple[str, ...] = known[kind].load()(given, settings)
    return program


def say(line: str) -> None:
    """Write a line at once; a closed output ends the command."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def tell(text: str) -> None:
    """Write a line about progress; a closed output does not stop the command."""
    with suppress(BrokenPipeError):
        say(text)


def rig_endpoints(options: argparse.Namespace, settings: "OperatorSettings | Settings") -> "RigEndpoints":
    """Return where a rig that is up is found.

    Raises:
        UsageError: --rig and --port-base were both given, the folder of --tls has no configuration, no rig is up, or
            several are.
    """
    from coldloop.modbus.settings import Endpoint, TlsSettings
    from coldloop_rig.cosim.wiring import RigEndpoints
    from coldloop_rig.live.started_rigs import find_rig, ports_from, require_listener

    first_port = first_port_here(options, anywhere=True)
    tls, folder = settings.rig.tls, options.tls
    known = None if options.rig else find_rig(first_port)
    ports = ports_from(options.port_base) if known is None else known.ports
    if not options.rig and known is None:
        require_listener(ports[0])
    if known is not None and known.tls and folder is None and tls is None:
        folder = Path(known.tls)
    if options.tls is None and folder is not None:
        own = {key: value for key, (value, _) in _tls_site(folder).items() if key.startswith("rig.tls.")}
        tls = TlsSettings.model_validate({key.removeprefix("rig.tls."): value for key, value in own.items()})
    places = options.rig or [HostPort("127.0.0.1", port) for port in ports]
    return RigEndpoints(*(
        Endpoint(host=place.host, port=place.port, tls=tls, word_order=getattr(settings, service).word_order)
        for service, place in zip(RigEndpoints._fields, places, strict=True)
    ))  # fmt: skip


def rig_services(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the services of the rig that `add_rig_options` names; one that was started here may be without optimiser.

    Raises:
        UsageError: Several are up, or its record is damaged.
    """
    from coldloop_rig.cosim.wiring import RigEndpoints
    from coldloop_rig.live.started_rigs import find_rig

    known = None if options.rig else find_rig(options.port_base)
    return RigEndpoints._fields if known is None else tuple(known.services)


def first_port_here(options: argparse.Namespace, *, anywhere: bool = False) -> int | None:
    """Return the first port of the rig on this machine that `add_rig_options` names, None for the only one.

    Raises:
        UsageError: --rig and --port-base were both given, or the rig is on another machine and not `anywhere`.
    """
    if options.rig and options.port_base:
        raise UsageError("--rig and --port-base: give one of them")
    if not options.rig:
        return None if options.port_base is None else int(options.port_base)
    plant: HostPort = options.rig[0]
    if plant.host not in LOOPBACK and not anywhere:
        raise UsageError(f"--rig {plant.host}:{plant.port}: kill and suspend services on their own machine only")
    return plant.port


def _tls_site(folder: Path) -> dict[str, tuple[object, str]]:
    """Return the settings of a folder of `coldloop certificates`, and where they come from."""
    from coldloop.config import flattened
    from coldloop.text import parsed_toml, read_text

    file = folder / "tls.toml"
    remedy = f"make it with `coldloop certificates --out {folder}`"
    try:
        content = parsed_toml(read_text(file, remedy))
    except ValueError as error:
        raise UsageError(f"{file}: {error}; {remedy}") from None
    return {key: (value, "--tls") for key, value in flattened(content).items()}


def configuration(options: argparse.Namespace) -> "Configuration[Settings]":
    """Return the effective configuration of a command."""
    from coldloop.config import load_configuration
    from coldloop_rig.settings import Settings

    given: Mapping[str, Any] = vars(options)
    site = _tls_site(given["tls"]) if given.get("tls") is not None else {}
    keys = {key: (given[n], f"--{n.replace('_', '-')}") for n, key in KEYS.items() if given.get(n) is not None}
    assignments = [*options.assignments, *given.get("further_assignments", ())]
    own = site | process_setting(options.assignments) | keys
    effective = load_configuration(Settings, file=options.config, assignments=assignments, options=own)
    if given.get("enforce"):
        from coldloop_rig.runs.running import enforced

        return enforced(effective)
    return effective


def operator_settings(options: argparse.Namespace) -> "OperatorSettings":
    """Return what a command of an operator reads of the configuration.

    Raises:
        UsageError: A key was set that has no effect on it.
    """
    from coldloop.config import load_configuration
    from coldloop_rig.cosim.wiring import OTHERS, OperatorSettings

    given = [*options.assignments, *vars(options).get("further_assignments", ())]
    site = process_setting(given) | (_tls_site(options.tls) if options.tls is not None else {})
    effective = load_configuration(
        OperatorSettings, file=options.config, assignments=given, options=site, others=OTHERS
    )
    for key, source in effective.sources.items():
        if source.startswith("--set") and not (key.startswith(("limits", "rig")) or key.endswith(".word_order")):
            raise UsageError(f"{source}: has no effect on this command: the rig has its own; drop it")
    return effective.settings


def refuse_ineffective(effective: "Configuration[Settings]", place: str, more: Mapping[str, str] | None = None) -> None:
    """Refuse values that the command replaces by its own; a file and the environment may repeat the default.

    Raises:
        UsageError: A place of a service, the autostart or a dotted key of `more` was set; the message has what to do
            instead: `place`, or the value of the key.
    """
    from coldloop.config import DEFAULT, flattened

    keys = {**dict.fromkeys(PLACES, place), "session.autostart": "it begins a session", **(more or {})}
    usual = flattened(effective.usual().model_dump(mode="json"))
    for key, value, source in effective.effective():
        if key in keys and (source.startswith("--") or (source != DEFAULT and value != usual.get(key))):
            where = source if key in source.lower().replace("__", ".") else f"{source}: {key}"
            raise UsageError(f"{where}: has no effect on this command: {keys[key]}")


OWN_PORTS = "its services get free ports; `coldloop up --port-base` has fixed ones"
PLACES = (
    "plant.server.port", "plant.server.host", "control_plc.server.port", "control_plc.server.host",
    "optimizer_plc.server.port", "optimizer_plc.server.host", "control_plc.plant.port", "control_plc.plant.host",
    "optimizer_plc.control_plc.port", "optimizer_plc.control_plc.host",
)  # fmt: skip
"""Keys that say where services are."""
