"""The solver tuned and as printed, what is changed of each, one thing at a time, and the runs to compare them."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final, NamedTuple

from coldloop_optimizer_plc.qp.penalties import Preset
from coldloop_plant.load import HOUR_TICKS
from coldloop_rig.studies.paired_sums import PairedSums
from coldloop_rig.studies.paper.open_loop import paired_loads, paired_request
from coldloop_rig.studies.paper.updating_period import FEW, NINE
from coldloop_rig.studies.request import Procedure, RunRequest
from coldloop_rig.studies.solver_runs import throttled
from coldloop_rig.studies.study import PROGRAM, Load, Outcomes, StudyOptions, loads

TUNED: Final = "tuned"
AS_PRINTED: Final = Preset.AS_PRINTED.value


class PenaltyVariant(NamedTuple):
    """Penalties and start of the solver, tuned or as printed, or these with one thing changed."""

    preset: str
    change: str
    """Empty for the preset itself."""
    assignments: tuple[str, ...]

    @property
    def label(self) -> str:
        """Name in tables and figures."""
        return f"{self.preset}, {self.change}" if self.change else self.preset

    @property
    def is_start(self) -> bool:
        """Whether it changes the size of the first step only."""
        return self.change.startswith(COST_SCALE)

    @property
    def is_weight(self) -> bool:
        """Whether it changes what breaking a row costs."""
        return self.change.startswith(("alpha", "rate rows"))

    @property
    def is_timed(self) -> bool:
        """Whether its periods are compared, too."""
        return not self.change or self.change in TIMED


Paired = PairedSums[PenaltyVariant | None]

QPOASES: Final = "qpOASES"
COST_SCALE: Final = "cost_scale"
TIMED: Final = (f"{COST_SCALE} 0.0001", f"{COST_SCALE} 1e-08")
"""Starts whose best periods are looked for: that of the other preset."""
RATES: Final = {"x 16": (16, 16, 16), "x 160": (160, 160, 160), "in % and W": (100, 2500, 100)}
CHANGES: Final = {
    **{f"alpha = {factor:g} rho": f"penalties.output_rows={factor}" for factor in (0.3, 1.0, 3.0, 10.0, 30.0)},
    **{f"rate rows {name}": f"penalties.rate_rows={list(weights)}" for name, weights in RATES.items()},
    **{f"{COST_SCALE} {scale:g}": f"ode.cost_scale={scale}" for scale in (1.0, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10)},
    "with look-ahead rows": "ode.look_ahead_rows=true", "without look-ahead rows": "ode.look_ahead_rows=false",
    "held at bounds": "ode.hold_at_bounds=true", "not held at bounds": "ode.hold_at_bounds=false",
    "first knot as a box": "penalties.first_knot_in_box=true",
    "first knot as rows": "penalties.first_knot_in_box=false",
    "box penalty": "penalties.box=1", "no box penalty": "penalties.box=0",
}  # fmt: skip
OWN: Final = {
    TUNED: ("alpha = 30 rho", "rate rows x 16", f"{COST_SCALE} 0.0001", "with look-ahead rows",
                   "held at bounds", "first knot as a box", "no box penalty"),
    AS_PRINTED: ("alpha = 1 rho", "rate rows in % and W", f"{COST_SCALE} 1e-08", "without look-ahead rows",
                        "not held at bounds", "first knot as rows", "box penalty"),
}  # fmt: skip
"""What each preset has itself. A test compares it with the presets."""


def _preset(preset: str) -> tuple[str, ...]:
    """Return what asks for it; studies set out from the tuned one."""
    return () if preset == TUNED else (f"{PROGRAM}preset={preset}",)


PRESETS: Final = {preset: PenaltyVariant(preset, "", _preset(preset)) for preset in OWN}
VARIANTS: Final = tuple(
    variant
    for preset in OWN
    for variant in (
        PRESETS[preset],
        *(
            PenaltyVariant(preset, change, (*_preset(preset), PROGRAM + assignment))
            for change, assignment in CHANGES.items()
            if change not in OWN[preset]
        ),
    )
)

POWERS: Final = (0.2, 0.4, 0.6, 1.0, 2.0, 3.2, 4.0, 5.0, 7.0, 10.0, 15.0, 25.0)
"""Of the paper's, those that the presets and qpOASES are compared at."""
SETTLED: Final = 10.0
"""At which a solver has converged."""
WEIGHT_POWERS: Final = (1.0, SETTLED)
"""Those of other weights, which have another optimum."""
DEVICE_POWERS: Final = (1.0,)
"""Those of all else, which has an effect on few iterations, and none on the optimum."""
START_POWERS: Final = (0.2, 0.4, 0.6, 1.0)
"""Those of other starts, which are all about few iterations."""
QUICK_POWERS: Final = (0.2, 1.0, 10.0, 25.0)
CLOSED_DRAWS: Final = 6
FRESH_DRAWS: Final = 3
"""Draws of each hour a to f; those from the second on are fresh."""


def variants(options: StudyOptions) -> tuple[PenaltyVariant, ...]:
    """Return those of a study; a quick one has the presets only."""
    return tuple(PRESETS.values()) if options.quick else VARIANTS


def powers_of(variant: PenaltyVariant | None, options: StudyOptions) -> tuple[float, ...]:
    """Return the powers of a variant, or of qpOASES."""
    if options.quick:
        return QUICK_POWERS
    if variant is None or not variant.change:
        return POWERS
    if variant.is_start:
        return START_POWERS
    return WEIGHT_POWERS if variant.is_weight else DEVICE_POWERS


def _with(request: RunRequest, variant: PenaltyVariant) -> RunRequest:
    return replace(request, assignments=(*request.assignments, *variant.assignments))


def paired(load: Load, variant: PenaltyVariant | None, power: float) -> RunRequest:
    """Return the request for a variant, or for qpOASES, on the problems of a load."""
    if variant is None:
        return paired_request(load, "qpoases", power)
    return _with(throttled(load, "ode", power, procedure=Procedure.PAIRED_PROBLEMS), variant)


def paired_sums(options: StudyOptions, outcomes: Outcomes) -> Paired:
    """Gather what presets, variants and qpOASES, which is no variant, gave on the same problems.

    Raises:
        StudyError: A profile costs less than the optimum.
    """
    powers = {variant: sorted(powers_of(variant, options)) for variant in (None, *variants(options))}
    return PairedSums(
        paired_loads(options), powers, paired, lambda variant: variant.label if variant else QPOASES, outcomes
    )


def closed_loads(options: StudyOptions) -> list[Load]:
    """Return the draws of the closed loop at 5 s, an hour of each."""
    return loads(options, "8h", usual=CLOSED_DRAWS, longest_ticks=HOUR_TICKS)


def closed(load: Load, variant: PenaltyVariant) -> RunRequest:
    """Return the request for the closed loop of a variant at 5 s and P = 1."""
    return _with(throttled(load, "ode", 1.0), variant)


def hours(options: StudyOptions) -> list[Load]:
    """Return the hours that periods are compared in."""
    return loads(options, *options.hours, usual=FRESH_DRAWS)


def periods(options: StudyOptions) -> tuple[float, ...]:
    """Return the updating periods, s."""
    return FEW if options.quick else NINE


def timed_variants(load: Load, options: StudyOptions) -> list[PenaltyVariant]:
    """Return the variants whose periods are compared under a load: other starts under first draws only."""
    return [one for one in variants(options) if one.is_timed and (not one.change or load.draw == 1)]


def of_period(load: Load, variant: PenaltyVariant, period_s: float) -> RunRequest:
    """Return the request for a fixed updating period."""
    return load.request(period_s, *variant.assignments)


def requests(options: StudyOptions) -> Iterator[RunRequest]:
    """Yield all requests, load by load: a worker has the problems of a load at hand."""
    for load in paired_loads(options):
        for variant in (None, *variants(options)):
            yield from (paired(load, variant, power) for power in powers_of(variant, options))
    yield from (closed(load, variant) for variant in variants(options) for load in closed_loads(options))
    for load in hours(options):
        for variant in timed_variants(load, options):
            yield from (of_period(load, variant, period) for period in periods(options))
