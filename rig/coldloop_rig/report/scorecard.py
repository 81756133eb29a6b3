"""Claims, what is asked of them, and the verdicts."""

import math
from collections.abc import Mapping, Sequence
from datetime import date
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, model_validator

from coldloop.parsing import parsed_toml
from coldloop_rig.plc_sizing.operations import dense_cholesky
from coldloop_rig.plc_sizing.plc import cholesky_times
from coldloop_rig.studies import published as paper
from coldloop_rig.studies.intervals import Interval, geometric_mean, interval_of_mean
from coldloop_rig.studies.paper.cholesky import SLOW_DOWN, SPEED
from coldloop_rig.studies.paper.solver_comparison import measures
from coldloop_rig.studies.paper.updating_period import is_inside

TOLERANCES: Final = Path(__file__).with_name("tolerances.toml")
FROM_POINTS: Final = "points"


def _limits(value: object) -> object:
    """Read "-" as no limit."""
    if not isinstance(value, list) or len(value) != 2:
        return value
    return tuple(
        limit if limit != "-" else open_end for limit, open_end in zip(value, (-math.inf, math.inf), strict=True)
    )


Range = Annotated[tuple[float, float], BeforeValidator(_limits)]


class ClaimVerdict(StrEnum):
    """Result of a claim."""

    REPRODUCED = "reproduced"
    PARTLY = "partly"
    NOT_REPRODUCED = "not reproduced"
    NO_DATA = "no data in the paper"
    NOT_RUN = "not run"


class ClaimKind(StrEnum):
    """What a claim is, and whether its verdict counts."""

    CLAIM = "claim"
    """The paper's."""
    AIM = "aim"
    """This project's own."""
    CHECK = "check"
    """Arithmetic, or fitted to the paper's own numbers: it holds unless something is broken, and does not count."""
    VARIANT = "variant"
    """A milder form of a claim; it does not count."""


COUNTED: Final = (ClaimKind.CLAIM, ClaimKind.AIM)


class Revision(BaseModel):
    """When something was added, changed or withdrawn after a report, and why; a claim as it was at first has none."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    value: str
    changed: date | None = None
    because: str = ""

    @model_validator(mode="after")
    def _dated_with_a_reason(self) -> Self:
        if (self.changed is None) != (not self.because):
            raise ValueError(f"{self.value}: a change has a date (`changed`) and a reason (`because`)")
        return self


class Claim(Revision):
    """A claim of the paper, an aim of this project, a check or a variant."""

    study: str
    kind: ClaimKind = ClaimKind.CLAIM
    figure: str
    says: str
    of_paper: str
    why: str
    reproduced: Range | None = None
    partly: Range | None = None
    calibrated: str = ""
    """What was chosen with this value in view; empty if nothing was."""
    signed: bool = False
    """Whether a value of a draw can be negative."""

    def mean(self, values: Sequence[float]) -> Interval:
        """Return the mean over the draws that have a value, with its interval."""
        return interval_of_mean(values, above=-math.inf if self.signed else 0.0)


class Judged(NamedTuple):
    """A claim with what was found."""

    claim: Claim
    values: tuple[float, ...]
    """One a draw; empty where the study gave none."""
    of_paper: float | None
    """From the points of the paper's figures."""
    verdict: ClaimVerdict


@cache
def claims() -> tuple[Claim, ...]:
    """Return all claims, in the order of the paper."""
    return tuple(Claim.model_validate(one) for one in _document()["claim"])


@cache
def withdrawn() -> tuple[Revision, ...]:
    """Return what was claimed in an earlier report."""
    return tuple(Revision.model_validate(one) for one in _document()["withdrawn"])


def _document() -> dict[str, Any]:
    return parsed_toml(TOLERANCES.read_text(encoding="utf-8"))


def judge(values: Mapping[str, Sequence[float]]) -> list[Judged]:
    """Return every claim, judged by the values that the studies gave."""
    return [_judged(claim, tuple(values.get(claim.value, ()))) for claim in claims()]


def _judged(claim: Claim, values: tuple[float, ...]) -> Judged:
    of_paper = paper_values().get(claim.value) if claim.of_paper == FROM_POINTS else None
    return Judged(claim, values, of_paper, verdict(claim, values))


def verdict(claim: Claim, values: tuple[float, ...]) -> ClaimVerdict:
    """Return the verdict on a claim, given one value a draw, by the 95 % interval of their mean.

    A single value is judged as it is. A claim that has no value in some draw has no mean, and is not reproduced.
    """
    if not values:
        return ClaimVerdict.NOT_RUN
    if claim.reproduced is None or claim.partly is None:
        return ClaimVerdict.NO_DATA
    if not all(map(math.isfinite, values)):
        return ClaimVerdict.NOT_REPRODUCED
    mean, *interval = claim.mean(values)
    ends = interval if len(values) > 1 else values
    if _within(claim.reproduced, *ends):
        return ClaimVerdict.REPRODUCED
    if _within(claim.reproduced, mean) or _within(claim.partly, *ends):
        return ClaimVerdict.PARTLY
    return ClaimVerdict.NOT_REPRODUCED


def _within(limits: tuple[float, float], *values: float) -> bool:
    return all(limits[0] <= value <= limits[1] for value in values)


@cache
def paper_values() -> Mapping[str, float]:
    """Return what the points of the paper's figures give, by the formulas that ours are computed with."""
    comparison = paper.solver_comparison()
    powers = comparison["ode"]["normalized_power"]
    values = measures(powers, comparison)
    closed = {solver: points["J_BF"] for solver, points in comparison.items()}
    one = int(np.argmin(np.abs(powers - 1.0)))
    values["limited: J_BF"] = float(closed["qpoases"][one] / closed["qpoases"][-1])
    values["trajectories: J_BF"] = float(closed["ode"][one] / closed["qpoases"][-1])
    values["trajectories: J_BF of qpOASES over ODE"] = float(closed["qpoases"][one] / closed["ode"][one])
    return {**values, **_updating_period(), **_cholesky()}


def _updating_period() -> dict[str, float]:
    hours = list(paper.updating_period().values())
    fixed = np.array([hour["cost_fixed_pct"] for hour in hours])
    adaptive = np.array([hour["cost_adaptive_pct"][0] for hour in hours])
    best = fixed.min(axis=1)
    ends = np.maximum(fixed[:, 0], fixed[:, -1])
    literal = "Algorithm 1, hours"
    inside = float(np.mean([is_inside(hour) for hour in fixed]))
    return {
        "interior optimum from 1 to 5 s, share of hours": inside,
        "interior optimum from 1 to 5 s, share of hours, as printed": inside,
        "worst end over best from 1 to 5 s, smallest of hours": float((ends / best).min()),
        f"better than the mean fixed period, share: {literal}": float((adaptive < fixed.mean(axis=1)).mean()),
        f"best of all, share: {literal}": float((adaptive < best).mean()),
        f"within 2 % of the best fixed period, share: {literal}": float((adaptive <= 1.02 * best).mean()),
        f"cost over that of the best fixed period, geometric mean: {literal}": geometric_mean(adaptive / best),
    }


def _cholesky() -> dict[str, float]:
    size, plc_s, laptop_s = cholesky_times()
    speed = np.array([dense_cholesky(n).flops for n in size.tolist()]) / plc_s / 1e6
    return {SPEED: float(speed[size >= 50].mean()), SLOW_DOWN: float((plc_s / laptop_s)[size >= 40].mean())}


def counted(judged: Sequence[Judged]) -> list[Judged]:
    """Return those whose verdicts count."""
    return [j for j in judged if j.claim.kind in COUNTED]


def counts(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """Return how often each verdict was given, to claims of the paper and to aims of this project; nothing else counts.

    Calibrated claims are among them, and counted once more by themselves.
    """
    some = counted(judged)
    groups = {
        "claims of the paper": [j for j in some if j.claim.kind is ClaimKind.CLAIM],
        "among them calibrated": [j for j in some if j.claim.kind is ClaimKind.CLAIM and j.claim.calibrated],
        "aims of this project": [j for j in some if j.claim.kind is ClaimKind.AIM],
    }
    return {
        name: {one.value: sum(j.verdict is one for j in group) for one in ClaimVerdict}
        for name, group in groups.items()
    }


def as_json(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """Return the scorecard as plain data."""
    return [
        {
            **j.claim.model_dump(mode="json", exclude={"reproduced", "partly"}),
            "reproduced": _plain(j.claim.reproduced),
            "partly": _plain(j.claim.partly),
            "paper": j.of_paper,
            "values": [value if math.isfinite(value) else None for value in j.values],
            "verdict": j.verdict,
        }
        for j in judged
    ]


def _plain(limits: tuple[float, float] | None) -> list[float | None] | None:
    return [limit if math.isfinite(limit) else None for limit in limits] if limits else None
