"""Parts of every service besides its program: its start, journal, logs, metrics and telemetry; the options of programs.

Nothing that takes time is imported here, for a command line starts at once.
"""

import argparse
from pathlib import Path


def add_configuration_options(parser: argparse.ArgumentParser, *, again: bool = False) -> None:
    """Add the options that set the configuration.

    Args:
        parser: Of a command, or of one of its subcommands.
        again: For a subcommand: what is not given there leaves what was given before it, `--set` adds to it.
    """
    default = argparse.SUPPRESS if again else None
    parser.register("type", "read", Path)  # as `coldloop_rig.cli.USES`
    parser.add_argument("--config", type="read", default=default, metavar="FILE", help="configuration file (TOML)")
    parser.add_argument(
        "--set", dest="further_assignments" if again else "assignments", action="append",
        default=argparse.SUPPRESS if again else [], metavar="KEY=VALUE",
        help="set one key, such as control_plc.server.port=5021; may be repeated",
    )  # fmt: skip
