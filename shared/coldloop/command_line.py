"""Options that every program has; it imports nothing that takes time, for a command line starts at once."""

import argparse
from pathlib import Path


def add_configuration_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that set the configuration."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="configuration file (TOML)")
    parser.add_argument(
        "--set", dest="assignments", action="append", default=[], metavar="KEY=VALUE",
        help="set one key, such as control_plc.server.port=5021; may be repeated",
    )  # fmt: skip
