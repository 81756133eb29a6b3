"""`coldloop new`: a folder with a process file and a plant to begin with, commented, or with an example."""

import argparse
import sys
from importlib.resources import files
from pathlib import Path
from typing import Final

FILES: Final = ("process.toml", "my_plant.py")
INSTALLED: Final = Path(__file__).parents[2] / "examples"
"""Of a wheel; a clone has them beside the packages."""
EXAMPLES: Final = (
    "cool_down", "efficient_refrigerator", "optimiser_by_registers", "optimiser_with_do_mpc", "outside_package",
    "quadruple_tank", "smaller_turbine", "wood_berry",
)  # fmt: skip


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("folder", type="into", metavar="FOLDER", help="a new folder, or one without such files")
    parser.add_argument("--example", choices=EXAMPLES, metavar="NAME",
                        help=f"the files of an example instead: {', '.join(EXAMPLES)}")  # fmt: skip


def execute(options: argparse.Namespace) -> int:
    """Write the files, unless there is one of them already."""
    from coldloop.errors import UsageError
    from coldloop.whole_file import whole_text

    folder: Path = options.folder
    texts = _template() if options.example is None else _example(options.example)
    present = next((name for name in texts if (folder / name).exists()), None)
    if present is not None:
        raise UsageError(f"{folder / present}: is there already; name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            whole_text(folder / name, text)
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; name a folder that can be written to") from None
    begin = "" if options.example else f"; now coldloop process {folder / FILES[0]}"
    sys.stdout.write(f"{folder}: {', '.join(texts)}{begin}\n")
    return 0


def _template() -> dict[str, str]:
    place = files("coldloop_rig.process_file").joinpath("template")
    return {name: place.joinpath(f"{name}.txt").read_text(encoding="utf-8") for name in FILES}


def _example(name: str) -> dict[str, str]:
    from coldloop.errors import UsageError

    folder = INSTALLED if INSTALLED.is_dir() else Path(__file__).parents[4] / "examples"
    found = sorted(file for file in folder.rglob("*.*") if name in (file.parent.name, file.name[: len(name)]))
    texts = {file.name: file.read_text(encoding="utf-8") for file in found if file.suffix != ".pyc"}
    if not texts:
        raise UsageError(f"--example {name}: this installation has no examples; they are in the wheel and in a clone")
    return texts
