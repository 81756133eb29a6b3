"""`coldloop new`: a folder with a process file and a plant to begin with, commented."""

import argparse
import sys
from importlib.resources import files
from pathlib import Path
from typing import Final

FILES: Final = ("process.toml", "my_plant.py")


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("folder", type="into", metavar="FOLDER", help="a new folder, or one without such files")


def execute(options: argparse.Namespace) -> int:
    """Write the files, unless there is one of them already."""
    from coldloop.errors import UsageError
    from coldloop.whole_file import whole_text

    folder: Path = options.folder
    present = next((name for name in FILES if (folder / name).exists()), None)
    if present is not None:
        raise UsageError(f"{folder / present}: is there already; name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            template = files("rig.process_file").joinpath("template", f"{name}.txt")
            whole_text(folder / name, template.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; name a folder that can be written to") from None
    sys.stdout.write(f"{folder}: {' and '.join(FILES)}; now coldloop process {folder / FILES[0]}\n")
    return 0
