"""Draws the cool-down of a refrigerator from the folder of its run: `cool_down_figure.py RUN FIGURE`.

The run is that of `coldloop run --in-process --config examples/cool_down.toml --load examples/cool_down.csv
--duration 22h --out RUN`.
"""

import argparse
from pathlib import Path

import pyarrow.parquet as pq

from coldloop_rig.figures.plot import COLOURS, DASHES, legend_above
from coldloop_studies.drawing import panels

PANELS = (
    ("temperature (K)", ("T1", "T2", "T5", "T6", "T9"), (3.0, 400.0)),
    ("L1 (%)", ("L1",), None),
    ("valves (%)", ("CV155", "CV156"), None),
    ("heater (W)", ("NCR22_A",), None),
    ("pressure (bar)", ("P12", "P13"), None),
    ("flow (g/s)", ("M12", "M_NC", "M_GN2"), None),
)
EVERY = 40
"""Ticks from one point to the next."""


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("figure", type=Path)
    options = parser.parse_args()
    trace, station = (pq.read_table(options.run / f"{name}.parquet") for name in ("trace", "station"))
    with panels(len(PANELS), 1, 7.5, sharex=True) as (figure, axes):
        for place, (label, names, logarithmic) in zip(axes, PANELS, strict=True):
            for name, colour in zip(names, COLOURS, strict=False):
                column = (trace if name in trace.column_names else station)[name].to_numpy()[::EVERY]
                hours = [EVERY * 0.25 / 3600.0 * i for i in range(len(column))]
                place.plot(hours, column, color=colour, linestyle=DASHES[colour], linewidth=0.9, label=name)
            if logarithmic:
                place.set_yscale("log")
                place.set_ylim(logarithmic)
            place.set_ylabel(label)
            legend_above(place)
        axes[-1].set_xlabel("plant time (h)")
    figure.savefig(options.figure, dpi=260)


if __name__ == "__main__":
    main()
