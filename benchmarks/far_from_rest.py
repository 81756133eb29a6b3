"""Draws a refrigerator far from rest, inputs held: `far_from_rest.py write FOLDER`, then `draw FIGURE FOLDER ...`.

`write` computes the cases with the plant that is installed, a CSV each, and prints what is wrong with the helium:
in the circuit or lost, against the beginning. `draw` puts the courses of several folders, of several versions, into
one figure; the last is drawn in front.
"""

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coldloop.process.cold_box import OUTPUT_NAMES, STATION_SIGNAL_NAMES, TICK_S
from coldloop.process.load_profile import LoadProfile
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.program import PlantProgram
from coldloop_plant.settings import PlantSettings
from coldloop_rig.figures.plot import COLOURS, DASHES
from coldloop_studies.drawing import legend_outside, panels

HEADER = own_header(DEFAULT_MODEL_FILE)
COLUMNS = ("minute", "L1", "T1", "T5", "P12", "P11", "lost", "imbalance")
LABELS = ("L1 (%)", "T1 (K)", "T5 (K)", "P12 (bar)", "P11 (bar)", "lost (kg)", "made (kg)")
EVERY = 8
"""Ticks from one point to the next."""


class Case(NamedTuple):
    """What happens for how long, from a minute after the beginning."""

    minutes: int
    load: LoadProfile = LoadProfile((0,), (HEADER.w0,))
    events: tuple[tuple[str, float], ...] = ()
    """Targets and values."""


def _load(w: float, ticks: int | None = None) -> LoadProfile:
    """Return another load (W) from the first minute on, for good or for some ticks."""
    if ticks is None:
        return LoadProfile((0, 240), (HEADER.w0, w))
    return LoadProfile((0, 240, 240 + ticks), (HEADER.w0, w, HEADER.w0))


CASES = {
    "5,385 W for 30 s": Case(15, _load(5385.0, 120)),
    "no load": Case(180, _load(0.0)),
    "250 W more": Case(120, _load(HEADER.w0 + 250.0)),
    "both compressors off": Case(11, events=(("nc1", 0.0), ("nc2", 0.0))),
    "leak, 50 g per s": Case(16, events=(("leak", 50.0),)),
}


def _plant(case: Case) -> PlantProgram:
    events = [{"at_s": 60.0, "target": target, "value": value} for target, value in case.events]
    section = {"kind": "refrigerator", "refrigerator": {"events": events}}
    return plant_maker(HEADER, PlantSettings.model_validate({"plant": section}).plant)(case.load, 1)


def course(case: Case) -> Iterator[list[float]]:
    """Yield what `COLUMNS` name, every two seconds."""
    plant, begun = _plant(case), None
    for tick in range(round(60 * case.minutes / TICK_S)):
        plant.advance()
        if tick % EVERY or plant.station is None:
            continue
        signals = dict(zip(STATION_SIGNAL_NAMES, plant.station.signals, strict=True))
        outputs = dict(zip(OUTPUT_NAMES, plant.measure(), strict=True))
        whole = signals["helium"] + signals["lost"]
        begun = whole if begun is None else begun
        shown = outputs["L1"], outputs["T1"], outputs["T5"], signals["P12"], signals["P11"], signals["lost"]
        yield [tick * TICK_S / 60.0, *shown, whole - begun]


def write(folder: Path, names: list[str]) -> None:
    """Write the courses of cases, and print their largest imbalance."""
    folder.mkdir(parents=True)
    for name in names:
        rows = list(course(CASES[name]))
        with (folder / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            writer.writerows(rows)
        table = np.array(rows)
        worst = table[np.argmax(np.abs(table[:, -1])), -1]
        print(f"{name}: {worst:.1e} kg of helium made, {table[-1, -2]:.2f} kg lost, L1 {table[-1, 1]:.1f} %")


def draw(figure_file: Path, folders: list[Path]) -> None:
    """Draw a column for each case that the last folder has."""
    names = [name for name in CASES if (folders[-1] / f"{name}.csv").exists()]
    with panels(len(LABELS), len(names), 10.0, sharex=True) as (figure, axes):
        for i, name in enumerate(names):
            column = axes[i :: len(names)]
            column[0].set_title(name)
            for folder, colour in zip(folders, COLOURS[len(folders) - 1 :: -1], strict=False):
                table = np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1)
                for place, values in zip(column, table[:, 1:].T, strict=True):
                    place.plot(table[:, 0], values, color=colour, linestyle=DASHES[colour], linewidth=0.9,
                               label=folder.name)  # fmt: skip
            column[-1].set_xlabel("plant time (min)")
        first = axes[:: len(names)]
        for place, label in zip(first, LABELS, strict=True):
            place.set_ylabel(label)
        legend_outside(figure, first[0])
    figure.savefig(figure_file, dpi=200)


def main() -> None:
    """Write or draw."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    writing, drawing = (commands.add_parser(name, allow_abbrev=False) for name in ("write", "draw"))
    writing.add_argument("folder", type=Path)
    writing.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    drawing.add_argument("figure", type=Path)
    drawing.add_argument("folders", type=Path, nargs="+")
    options = parser.parse_args()
    if options.command == "write":
        write(options.folder, options.cases)
    else:
        draw(options.figure, options.folders)


if __name__ == "__main__":
    main()
