"""The command `coldloop`, and `python -m rig`: interrupts end it in good order also while its modules are imported."""

import gc
import sys

from rig.interruption import INTERRUPTION


def main() -> int:
    """Run the command line; return its exit code."""
    with INTERRUPTION:
        from rig.cli import main as run  # noqa: PLC0415 this takes time
    code = run()
    gc.freeze()  # the interpreter would look for cycles in all modules before it ends, which takes 0.15 s
    return code


if __name__ == "__main__":
    sys.exit(main())
