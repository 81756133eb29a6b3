"""`coldloop completion`: a script for a shell's start-up file, such as `eval "$(coldloop completion bash)"`."""

import argparse
import sys


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish", "tcsh"))


def execute(options: argparse.Namespace) -> int:
    """Print the script."""
    from argcomplete.shell_integration import shellcode

    sys.stdout.write(shellcode(["coldloop"], shell=options.shell) + "\n")
    return 0
