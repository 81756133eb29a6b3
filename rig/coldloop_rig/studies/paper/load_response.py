"""The updating period against the time since the last load step (paper, figure `diff_upt`), weighted by time.

A mean over updates counts short periods too often: in the same time there are ten of 0.5 s for one of 5 s. Here every
tick has the period that is in force then, and counts once.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from coldloop.process.cold_box import SAMPLING_PERIOD_S, TICK_S
from coldloop_rig.figures.plot import COLOURS, DASHES
from coldloop_rig.studies.drawing import legend_outside, panels
from coldloop_rig.studies.paper.trajectories import load_steps, seconds_since_step
from coldloop_rig.studies.request import Outcome, Series
from coldloop_rig.studies.study import Load
from coldloop_rig.text_tables import markdown_table

SOON_S: Final = (0.0, 30.0)
"""The window after a load step by which the response is judged."""
QUIET_S: Final = (60.0, np.inf)
EDGES_S: Final = np.array([0.0, 2.5, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, np.inf])
DRAWN_TO_S: Final = 400.0
"""Where the last window, which has no end, ends in the figure."""

Run = tuple[Outcome, Load]


class HeldPeriods(NamedTuple):
    """Ticks that have an updating period and a load step before them, of several runs."""

    since_s: Series
    """Time since the last load step."""
    tau_u_s: Series
    """The period in force."""

    def mean(self, span: tuple[float, float]) -> float:
        """Return the mean period (s) in a window of time since the step; NaN if no tick is in it."""
        chosen = self.tau_u_s[(span[0] <= self.since_s) & (self.since_s < span[1])]
        return float(chosen.mean()) if len(chosen) else np.nan

    def share_of_longest(self, span: tuple[float, float]) -> float:
        """Return the share of a window's time that has the longest period; NaN if no tick is in it."""
        chosen = self.tau_u_s[(span[0] <= self.since_s) & (self.since_s < span[1])]
        return float((chosen == SAMPLING_PERIOD_S).mean()) if len(chosen) else np.nan


def held_periods(runs: Sequence[Run]) -> HeldPeriods:
    """Return the periods of runs, tick by tick; a period is held until the next update whose sequence is played."""
    since, held = [np.empty(0)], [np.empty(0)]
    for run, load in runs:
        start, tau = run.column("tick"), run.column("tau_u")
        if not len(start):
            continue
        ticks = np.arange(start[0], start[-1] + tau[-1])
        steps = load_steps(load)
        after = ticks - steps[np.searchsorted(steps, ticks, side="right") - 1]
        known = np.isfinite(after)
        since.append(after[known] * TICK_S)
        held.append(tau[np.searchsorted(start, ticks, side="right") - 1][known] * TICK_S)
    return HeldPeriods(np.concatenate(since), np.concatenate(held))


def contractions(runs: Sequence[Run]) -> tuple[Series, Series]:
    """Return for all updates but the first of each run K = J_{k+1} / J_k, and the time since the load step (s)."""
    K, since = [np.empty(0)], [np.empty(0)]
    for run, load in runs:
        effective = run.column("j_effective")
        K.append(effective[1:] / effective[:-1])
        since.append(seconds_since_step(run, load)[1:])
    return np.concatenate(K), np.concatenate(since)


def response(runs: Sequence[Run], policy: str) -> dict[str, float]:
    """Return what is claimed of the response of a policy, and the quantities that explain it."""
    held = held_periods(runs)
    K, since = contractions(runs)
    quiet = held.mean(QUIET_S)
    return {
        f"tau_u 0 to 30 s after a load step over that in quiet, by time, {policy}": held.mean(SOON_S) / quiet,
        f"tau_u in quiet (s), by time, {policy}": quiet,
        f"tau_u 0 to 30 s after a load step (s), by time, {policy}": held.mean(SOON_S),
        f"share of the quiet time at the longest period, {policy}": held.share_of_longest(QUIET_S),
        f"median of |K - 1| in quiet, {policy}": _median_distance(K[since >= QUIET_S[0]]),
        f"median of |K - 1| 0 to 30 s after a load step, {policy}": _median_distance(K[since < SOON_S[1]]),
    }


def _median_distance(K: Series) -> float:
    return float(np.median(np.abs(K - 1.0))) if len(K) else np.nan


def response_table(runs_of: Mapping[str, Sequence[Run]]) -> str:
    """Return the mean period of each policy in each window, as Markdown."""
    spans = list(pairwise(EDGES_S.tolist()))
    names = [f"{low:g}-{high:g} s" if np.isfinite(high) else f"from {low:g} s on" for low, high in spans]
    caption = "**Mean updating period (s) against the time since the load step**, weighted by time, all hours together."
    rows = []
    for policy, runs in runs_of.items():
        means = [held_periods(runs).mean(span) for span in spans]
        rows.append((policy, *("" if np.isnan(mean) else f"{mean:.2f}" for mean in means)))
    return markdown_table(("policy", *names), rows, caption)


def response_figure(runs_of: Mapping[str, Sequence[Run]]) -> Figure:
    """Draw the mean period of each policy in each window."""
    edges = np.where(np.isfinite(EDGES_S), EDGES_S, DRAWN_TO_S)
    with panels(1, 1, 2.8) as (figure, (place,)):
        for (policy, runs), colour in zip(runs_of.items(), COLOURS, strict=False):
            means = [held_periods(runs).mean(span) for span in pairwise(EDGES_S.tolist())]
            place.stairs(means, edges, color=colour, linestyle=DASHES[colour], baseline=None, label=policy)
        place.set_xlabel(f"time since the load step (s); the last is from {EDGES_S[-2]:g} s on")
        place.set_ylabel("mean updating period (s), by time")
        place.set_ylim(bottom=0)
        legend_outside(figure, place)
    return figure
