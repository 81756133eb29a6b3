"""The reference PLC: its speed (paper, figure `performance_automate`), its memory, and its single precision.

The study `cholesky` does no runs. The PLC is the paper's: its times are a table, and our own factorisation is timed on
this machine to stand beside the paper's laptop.
"""

import time
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from coldloop.process.lti_model import load as load_model
from coldloop.process.settings import SHIPPED_MODELS, InputLimits
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorSettings
from coldloop_optimizer_plc.qp import linear_algebra, problem
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.settings import ControlDesign, SolverName, trivial_design
from coldloop_plant.load import HOUR_TICKS
from coldloop_rig.figures.plot import COLOURS, legend_above
from coldloop_rig.plc_sizing import operations
from coldloop_rig.plc_sizing import plc as reference
from coldloop_rig.plc_sizing.budget import estimator_memory, footprint
from coldloop_rig.text_tables import Cell, markdown_table
from coldloop_studies.drawing import panels, paper
from coldloop_studies.request import Series
from coldloop_studies.study import PROGRAM, Found, Outcomes, Study, StudyOptions, StudyResult, loads, study_of_loads

SPEED: Final = "Mflop/s from n = 50 on"
SLOW_DOWN: Final = "slow-down against the laptop, sizes 40 to 125"
ACTIVE: Final = operations.ACTIVE_ROWS
N: Final = 49
"""Variables of the paper's problem."""
SIZES: Final = operations.dense_sizes(N, 94, 21)
"""Sizes of the paper's problem, zeros counted."""


def _cholesky(_options: StudyOptions, _outcomes: Outcomes) -> StudyResult:
    times = reference.cholesky_times()
    curve = reference.reference_curve()
    here = np.array([_seconds_here(int(n)) for n in times.size])
    rows: list[tuple[Cell, ...]] = [
        (int(n), plc * 1e3, curve.time_s(n) * 1e3, laptop * 1e6, own * 1e6)
        for n, plc, laptop, own in zip(*(v.tolist() for v in (*times, here)), strict=True)
    ]
    columns = ("n", "PLC (ms), paper", "PLC (ms), fitted", "laptop (us), paper", "here (us)")
    large = times.size[times.size >= 50]
    modelled = np.array([curve.time_s(n) for n in times.size.tolist()])
    prediction, estimator = PredictionModel(load_model(SHIPPED_MODELS["cold-box"])), EstimatorSettings()
    design, limits, real = ControlDesign(), InputLimits(), linear_algebra.real_of(Arithmetic.FLOAT32)
    reduced, trivial = (
        footprint(problem.PredictiveProblem(prediction, one, limits, real), estimator_memory(prediction, estimator),
                  SolverName.ODE) for one in (design, trivial_design(design))
    )  # fmt: skip
    values = {
        SPEED: float(np.mean([operations.dense_cholesky(n).flops / curve.time_s(n) / 1e6 for n in large.tolist()])),
        SLOW_DOWN: float((modelled / times.laptop_s)[times.size >= 40].mean()),
        "tau_1 of the ODE-based solver (s)": _counted_s(curve, operations.ode(SIZES, ACTIVE.mean)),
        "tau_1 of qpOASES by the paper's route (s)": reference.QPOASES_ON_LAPTOP_S * reference.slow_down(times, N),
        "memory of the trivial problem over that of the PLC": trivial.total / reference.MEMORY_BYTES,
        "memory of the reduced problem over that of the PLC": reduced.total / reference.MEMORY_BYTES,
    }
    return StudyResult(
        columns,
        rows,
        {"cholesky times": _speed_figure(rows)},
        {name: [value] for name, value in values.items()},
        [_remark(curve, float(np.abs(reference.residuals(curve, times)).max())), _iterations(curve)],
    )


CHOLESKY: Final = Study(
    "cholesky",
    "The reference PLC: speed, time of an iteration, memory (figure performance_automate)",
    lambda _: (),
    _cholesky,
)
"""The speed curve, the time of an iteration of each solver, and the memory."""


def _seconds_here(n: int) -> float:
    """Return the shortest time of one factorisation of size n on this machine, s."""
    A = np.eye(n) * n + 1.0
    best = np.inf
    for _ in range(20):
        M_ = A.copy()
        began = time.perf_counter()
        linear_algebra.cholesky(M_)
        best = min(best, time.perf_counter() - began)
    return best


def _counted_s(curve: reference.SpeedCurve, count: operations.Operations) -> float:
    return count.flops / curve.flops_per_s(N)


def _remark(curve: reference.SpeedCurve, error: float) -> str:
    mean, none, worst = (operations.ode(SIZES, active) for active in (ACTIVE.mean, 0, ACTIVE.worst))
    qpoases = _counted_s(curve, operations.qpoases(SIZES, operations.WORKING_SET))
    return (
        f"Fitted: {curve.c1 * 1e6:.3g} n + {curve.c2 * 1e6:.3g} n² + {curve.c3 * 1e6:.3g} n³ µs, within "
        f"{100 * error:.2f} % of the 25 measured times; {curve.flops_per_s(N) / 1e6:.3f} Mflop/s at n = {N}. An "
        f"iteration of the ODE-based solver has {mean.flops:,.0f} operations with {ACTIVE.mean:g} rows active, "
        f"the mean of the closed loop, and takes {_counted_s(curve, mean):.3f} s; with none it takes "
        f"{_counted_s(curve, none):.3f} s, with the most ever seen {_counted_s(curve, worst):.3f} s. A working-set "
        f"change of qpOASES, counted, takes {qpoases:.3f} s, much less than by the paper's route: 120 µs on the laptop "
        "are calls, copies and checks more than arithmetic, which a lean implementation on the PLC would not have."
    )


def _iterations(curve: reference.SpeedCurve) -> str:
    tau = {
        "ODE (slot of 0.25 s)": 0.25,
        "ODE (counted dense)": _counted_s(curve, operations.ode(SIZES, ACTIVE.mean)),
        "qpOASES (0.48 s)": 0.48,
        "qpOASES (counted dense)": _counted_s(curve, operations.qpoases(SIZES, operations.WORKING_SET)),
        "OSQP (counted dense)": _counted_s(curve, operations.osqp(SIZES)),
        "fast gradient (counted dense)": _counted_s(curve, operations.fast_gradient(SIZES, ACTIVE.mean)),
    }
    powers = (0.2, 0.6, 1.0, 2.0, 5.0, 10.0, 25.0)
    rows = [
        (name, f"{seconds:.3f}", *(str(int(5 * power / seconds + 1e-9)) for power in powers))
        for name, seconds in tau.items()
    ]
    header = ("solver", "tau_1 (s)", *(f"P = {power:g}" for power in powers))
    return markdown_table(header, rows, "**Iterations in 5 s** against the power P:")


def _speed_figure(rows: list[tuple[Cell, ...]]) -> Figure:
    table: Series = np.array(rows, dtype=float)
    with panels(2, 1, 4.2, sharex=True) as (figure, (plc, computers)):
        paper(plc, table[:, 0], table[:, 1], COLOURS[0], "PLC, paper")
        plc.plot(table[:, 0], table[:, 2], color=COLOURS[0], label="PLC, fitted")
        paper(computers, table[:, 0], table[:, 3], COLOURS[1], "laptop, paper")
        computers.plot(table[:, 0], table[:, 4], "--", color=COLOURS[2], label="this machine")
        for place, unit in ((plc, "ms"), (computers, "us")):
            place.set(yscale="log", ylabel=f"factorisation ({unit})")
            place.legend(loc="lower right")
        computers.set_xlabel("size of the matrix (1)")
    return figure


INPUTS: Final = {"CV155": "%", "NCR22_A": "W", "CV156": "%"}


def _single_precision(found: Found[str]) -> StudyResult:
    result = StudyResult(("load", "J_BF double", "J_BF single", *(f"largest difference of {name} ({unit})"
                          for name, unit in INPUTS.items())), [], {})  # fmt: skip
    for load, runs in found:
        double, single = runs.values()
        apart = {name: single.series(name) - double.series(name) for name in INPUTS}
        largest = [float(np.abs(each).max()) for each in apart.values()]
        change = single.indicators.J_BF / double.indicators.J_BF - 1.0
        result.rows.append((load.name, double.indicators.J_BF, single.indicators.J_BF, *largest))
        result.note("change of J_BF in single precision", change)
        for (name, unit), value in zip(INPUTS.items(), largest, strict=True):
            result.note(f"largest difference of {name} ({unit}) in single precision", value)
        if not result.figures:
            with panels(3, 1, 4.0, sharex=True) as (figure, axes):
                for place, (name, unit), colour in zip(axes, INPUTS.items(), COLOURS, strict=False):
                    hours = double.series("time_s") / 3600
                    place.plot(hours, apart[name], color=colour, linewidth=0.7, label=name)
                    place.set_ylabel(f"single - double ({unit})")
                    legend_above(place)
                axes[-1].set_xlabel("plant time (h)")
            result.figures["difference of the inputs"] = figure
    return result


SINGLE_PRECISION: Final = study_of_loads(
    "single-precision",
    "Single against double precision (section IV-D)",
    # two hours of each draw: rounding changes single steps, so more draws say more than longer runs
    lambda options: loads(options, "8h", longest_ticks=2 * HOUR_TICKS),
    lambda load: {
        kind: load.request(2.5, f"{PROGRAM}arithmetic={kind}", trace_ticks=1) for kind in ("float64", "float32")
    },
    _single_precision,
)
"""Double and single precision, tick by tick."""
