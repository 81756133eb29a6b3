"""Whether an adaptive updating period pays on a PLC: the closed loop under some loads, against fixed periods."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coldloop.errors import StudyError
from coldloop.process.declaration import Process
from coldloop.process.lti_model import load
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_plant.load import find_load
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario, natural_ticks
from coldloop_rig.plc_sizing.intervals import Interval, geometric_mean, mean_ratio
from coldloop_rig.results.indicators import evaluate
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

ADAPTIVE: Final = 0.0
"""An updating period, s."""


def loop_cost(settings: Settings, name: str, period_s: float, run: Callable[[Scenario, Recorder], None]) -> float:
    """Return J_BF under a load, a named one or a file, with what runs a scenario."""
    model = load(settings.model.file)
    profile = find_load(name, model.w0, settings.process)
    scenario = Scenario(natural_ticks(name, profile), profile, period_s, settings.plant.seed)
    recorder = Recorder(scenario.ticks)
    run(scenario, recorder)
    return evaluate(recorder.recording(), model, settings.optimizer_plc.program.design).J_BF


def require_costs(costs: ArrayLike) -> None:
    """Refuse costs of which a ratio would say nothing, those of loops in which nothing happens (`StudyError`)."""
    if not np.all(np.asarray(costs) > 0.0):
        raise StudyError(
            "under some load the loop costs nothing (J_BF is 0): with the inputs at rest all outputs stay in their "
            "bands. Give the process a load or disturbances that drive them out, or a setpoint where it does not rest"
        )


SHARES: Final = (0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
"""Updating periods that are compared unless one is given, as shares of the sampling period."""


def fixed_periods(process: Process) -> tuple[float, ...]:
    """Return the updating periods, s, that are compared."""
    ticks = sorted({round(share * process.ticks_per_sample) for share in SHARES})
    return tuple(each * process.tick_s for each in ticks if each >= SHORTEST_TICKS)


def adaptive_gain(
    settings: Settings, names: Sequence[str], period_s: float | None, done: Callable[[int, int], None]
) -> str:
    """Return, as a sentence, J_BF of the adaptive period over that of the best fixed one.

    The best is chosen on the same loads, which favours it.

    Args:
        settings: With the power of the PLC.
        names: Loads, named ones or files.
        period_s: The fixed period to compare with; None for the best of `fixed_periods` in which an iteration fits.
        done: Is called with the number of runs done and that of all.
    """
    program = settings.optimizer_plc.program
    budget = PlcBudget(program.budget, program.iteration_s)
    periods = fixed_periods(settings.process)
    fitting = [period for period in periods if budget.times.holds(round(period / settings.process.tick_s))]
    fixed = fitting or [periods[-1]] if period_s is None else [period_s]
    rig, runs = OneProcessRig(settings), list(product((ADAPTIVE, *fixed), names))
    costs = []
    for number, (period, name) in enumerate(runs):
        done(number, len(runs))
        costs.append(loop_cost(settings, name, period, rig.run))
    best, ratio = over_best_fixed(np.array(costs).reshape(-1, len(names)))
    which = f"a fixed {fixed[best - 1]:g} s" + (", the best fixed one" if len(fixed) > 1 else "")
    loads = f"load{'s' if len(names) > 1 else ''} {', '.join(names)}"
    return f"With {loads} an adaptive period costs {ratio.text()} of {which}: {pays(ratio)}."


def over_best_fixed(costs: NDArray[np.float64]) -> tuple[int, Interval]:
    """Return which row is the best fixed period, and the cost of the first row, the adaptive one, over its.

    Costs have a row for each period, a column for each load.

    Raises:
        StudyError: A loop costs nothing.
    """
    require_costs(costs)
    best = min(range(1, len(costs)), key=lambda which: geometric_mean(costs[which]))
    return best, mean_ratio(costs[0], costs[best])


def pays(ratio: Interval) -> str:
    """Return whether it does, in words; of costs, those of the adaptive period over others."""
    return ratio.in_words("it pays", "it does not pay", "one load has no interval; name several")
