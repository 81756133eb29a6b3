"""What single precision, the PLC's, costs against double: the same hours in both."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from coldloop_plant.load import HOUR_TICKS
from coldloop_rig.figures.plot import COLOURS, legend_above
from coldloop_rig.studies.drawing import panels
from coldloop_rig.studies.request import Outcome, RunRequest, Series
from coldloop_rig.studies.study import PROGRAM, Load, Outcomes, StudyOptions, StudyResult, loads

PERIOD_S: Final = 2.5
LONGEST_TICKS: Final = 2 * HOUR_TICKS
"""Of the eight hours: more draws say more than longer ones, for it is single steps that roundings change."""
INPUTS: Final = {"CV155": "%", "NCR22_A": "W", "CV156": "%"}


class SinglePrecision:
    """Double and single precision, tick by tick."""

    name = "single-precision"
    title = "Single against double precision (section IV-D)"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return both arithmetics under every draw."""
        return [request for load in _loads(options) for request in _both(load)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare costs and inputs."""
        result = StudyResult(("load", "J_BF double", "J_BF single", *(f"largest difference of {name} ({unit})"
                              for name, unit in INPUTS.items())), [], {})  # fmt: skip
        for load in _loads(options):
            double, single = (outcomes[request] for request in _both(load))
            largest = [float(np.abs(_difference(double, single, name)).max()) for name in INPUTS]
            change = single.indicators.J_BF / double.indicators.J_BF - 1.0
            result.rows.append((load.name, double.indicators.J_BF, single.indicators.J_BF, *largest))
            result.note("change of J_BF in single precision", change)
            for (name, unit), value in zip(INPUTS.items(), largest, strict=True):
                result.note(f"largest difference of {name} ({unit}) in single precision", value)
            if not result.figures:
                result.figures["difference of the inputs"] = _figure(double, single)
        return result


def _loads(options: StudyOptions) -> list[Load]:
    return loads(options, "8h", longest_ticks=LONGEST_TICKS)


def _both(load: Load) -> list[RunRequest]:
    return [
        load.request(PERIOD_S, f"{PROGRAM}arithmetic={arithmetic}", trace_ticks=1)
        for arithmetic in ("float64", "float32")
    ]


def _difference(one: Outcome, other: Outcome, name: str) -> Series:
    difference: Series = other.series(name) - one.series(name)
    return difference


def _figure(double: Outcome, single: Outcome) -> Figure:
    hours = double.series("time_s") / 3600
    with panels(3, 1, 4.0, sharex=True) as (figure, axes):
        for place, (name, unit), colour in zip(axes, INPUTS.items(), COLOURS, strict=False):
            place.plot(hours, _difference(double, single, name), color=colour, linewidth=0.7, label=name)
            place.set_ylabel(f"single - double ({unit})")
            legend_above(place)
        axes[-1].set_xlabel("plant time (h)")
    return figure
