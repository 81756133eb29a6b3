"""`coldloop config`: the effective configuration, and where each value comes from."""

import argparse
import sys

from coldloop.service.command_line import add_configuration_options
from coldloop_rig.cli.commands.options import configuration


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_configuration_options(parser)
    parser.add_argument("--keys", action="store_true", help="list all keys and what they mean, as Markdown")


def execute(options: argparse.Namespace) -> int:
    """Print one line a value, as TOML with its source behind it."""
    from coldloop.config import as_toml

    if options.keys:
        from coldloop_rig.cli.key_listing import key_listing
        from coldloop_rig.settings import Settings

        sys.stdout.write(key_listing(Settings))
        return 0
    rows = configuration(options).effective()
    texts = [
        f"# {key} = not set" if value is None else f"{key} = {as_toml(value)}"  # TOML has no word for what is not set
        for key, value, _ in rows
    ]
    width = min(60, max(len(text) for text in texts))
    for text, (_, _, source) in zip(texts, rows, strict=True):
        sys.stdout.write(f"{text.ljust(width)}  # {source}\n")
    return 0
