"""How far the one-process rig is from its floor: the sum of its kernels, each timed alone in one compiled loop.

The floor of a run is the plant's steps, and the starts and iterations of the solver, as often as the run has them.
"""

import argparse
import statistics
import time
from typing import NamedTuple

import numba
import numpy as np
from qp_solvers import RecordedProblem, record

from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.process.lti_model import load
from coldloop_optimizer_plc.computing_settings import OdeSettings
from coldloop_optimizer_plc.qp.costs import matrices_of
from coldloop_optimizer_plc.solvers.ode import descend, flow_in, warm_start
from coldloop_plant.cold_box import advance_along, evaluate
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.helium import load_helium
from coldloop_plant.load import find_load
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings


class Floors(NamedTuple):
    """Times of kernels, s."""

    held_step: float
    """Plant step under inputs and load of the step before."""
    first_step: float
    start: float
    iteration: float


@numba.njit(error_model="numpy")
def steps(x, u, w, box, helium, first, count):  # noqa: ANN001, ANN201 compiled
    """Advance so many ticks; `first` re-evaluates the slope each time."""
    slope, y = np.empty(28), np.empty(22)
    evaluate(x, u, w, box, helium, slope, y)
    for _ in range(count):
        if first:
            evaluate(x, u, w, box, helium, slope, y)
        x = advance_along(x, slope, u, w, TICK_S, box, helium)
        evaluate(x, u, w, box, helium, slope, y)
    return x


@numba.njit(error_model="numpy")
def solves(matrices, qp, guess, flow, iterations, count):  # noqa: ANN001, ANN201 compiled
    """Solve a problem so many times with so many iterations."""
    total = 0.0
    for _ in range(count):
        z, cost, dt = warm_start(matrices, qp, guess, flow)
        _, _, cost, _ = descend(matrices, qp, z, np.zeros_like(qp.gamma), cost, dt, 0, iterations, flow)
        total += cost
    return total


def seconds(call, *arguments) -> float:  # noqa: ANN001, ANN002 of any function
    """Return the time of a call."""
    start = time.perf_counter()
    call(*arguments)
    return time.perf_counter() - start


def floors(problems: list[RecordedProblem], count: int) -> Floors:
    """Return the times of the kernels; `count` calls of the plant's, and each problem ten times."""
    model, helium, flow = (
        load(Settings().model.file),
        load_helium(),
        flow_in(OdeSettings(), None, np.float64),
    )
    state = np.array(model.x0) * 1.001, np.array(model.u0), model.w0, REFERENCE, helium
    steps(*state, 0, 1)
    held, first = (seconds(steps, *state, anew, count) / count for anew in (0, 1))
    matrices = matrices_of(problems[0].problem)
    solves(matrices, *problems[0], flow, 1, 1)
    start, five = (
        sum(seconds(solves, matrices, *one, flow, q, 10) for one in problems) / 10 / len(problems) for q in (0, 5)
    )
    return Floors(held, first, start, (five - start) / 5)


def run(period_s: float, ticks: int, hours: str) -> tuple[float, int, int]:
    """Do a run; return its time (s), its updates and its iterations."""
    settings = Settings()
    rig, recorder = OneProcessRig(settings), Recorder(ticks)
    rig.run(Scenario(ticks, find_load(hours, load(settings.model.file).w0, COLD_BOX), period_s, seed=1), recorder)
    updates = recorder.recording().updates
    return recorder.wall_seconds, len(updates), sum(update.iterations for update in updates)


def measured(load_name: str, ticks: int, repeat: int, calls: int) -> dict[str, tuple[float, float]]:
    """Return the speed of each kind of run and its ratio to the floor, as medians."""
    results = {}
    problems = record("e", 5.0, 1.0)[20:120]
    run(0.0, 240, load_name)
    for name, period_s in (("5 s", 5.0), ("2.5 s", 2.5), ("adaptive", 0.0)):
        pairs = []
        for _ in range(repeat):
            floor = floors(problems, calls)
            wall, updates, iterations = run(period_s, ticks, load_name)
            kernels = (ticks - updates) * floor.held_step + updates * (floor.first_step + floor.start)
            pairs.append((ticks * TICK_S / wall, wall / (kernels + iterations * floor.iteration)))
        speed, ratio = (statistics.median(each) for each in zip(*pairs, strict=True))
        results[name] = speed, ratio
    return results


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--load", default="2h")
    parser.add_argument("--ticks", type=int, default=28_800)
    parser.add_argument("--repeat", type=int, default=5, help="the medians are printed")
    parser.add_argument("--calls", type=int, default=5000, help="of the plant's step when it is timed alone")
    options = parser.parse_args()
    for name, (speed, ratio) in measured(options.load, options.ticks, options.repeat, options.calls).items():
        print(f"tau_u {name}: {speed:,.0f} times real time, {ratio:.2f} times the sum of the kernels")


if __name__ == "__main__":
    main()
