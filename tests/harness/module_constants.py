"""Constants of all modules as they are when a process is named at their import.

`python -m tests.harness.module_constants FILE` writes a line for each constant that is plain data, and one for each
section of settings that there is.
"""

import gc
import pkgutil
import re
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType

import coldloop
import coldloop_control_plc
import coldloop_hmi
import coldloop_optimizer_plc
import coldloop_plant
import coldloop_rig
from coldloop.process.declaration import Process
from coldloop.process.settings import ProcessSettings, settings_of
from coldloop_rig.process_file.reading import read_process_file

PACKAGES = (
    coldloop, coldloop_control_plc, coldloop_hmi, coldloop_optimizer_plc, coldloop_plant, coldloop_rig,
)  # fmt: skip
RANDOM = "NOBODYS_HASH"
PLAIN = (bool, int, float, str, tuple, list, dict, set, frozenset, ProcessSettings, Process)
ADDRESS = re.compile(" at 0x[0-9a-f]+")


def modules() -> list[ModuleType]:
    """Return all modules that can be imported."""
    found = []
    for package in PACKAGES:
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(ImportError):  # an extra may be missing
                if not info.name.endswith("__main__"):
                    found.append(import_module(info.name))
    return found


def main() -> None:
    """Write the constants."""
    process = read_process_file(Path(sys.argv[1]))
    with settings_of(process):
        for module in modules():
            for name, value in sorted(vars(module).items()):
                if isinstance(value, PLAIN) and not name.startswith("__") and name != RANDOM:
                    sys.stdout.write(f"{module.__name__}.{name} = {ADDRESS.sub('', repr(value))}\n")
    for section in gc.get_objects():
        if isinstance(section, ProcessSettings):
            sys.stdout.write(f"settings {section!r}\n")


if __name__ == "__main__":
    main()
