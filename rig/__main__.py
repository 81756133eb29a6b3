"""The command `coldloop`, and `python -m rig`: interrupts end it in good order also while its modules are imported."""

import sys

from rig.interruption import INTERRUPTION


def main() -> int:
    """Run the command line; return its exit code."""
    with INTERRUPTION:
        from rig.cli import main as run  # noqa: PLC0415 this takes time
    return run()


if __name__ == "__main__":
    sys.exit(main())
