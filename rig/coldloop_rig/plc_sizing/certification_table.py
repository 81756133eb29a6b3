"""Certified iterations as text."""

from coldloop_rig.plc_sizing.certification import LONGEST, SCENARIO_TICKS, Certificate, certify, failure_bound
from coldloop_rig.progress import make_console
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import aligned


def certification_table(settings: Settings, scenarios: int, tolerance_pct: float, confidence_pct: float) -> str:
    """Sample scenarios and return what they certify, as text.

    Args:
        settings: Of plant, problem, solvers and budget.
        scenarios: N, 1 or more.
        tolerance_pct: An answer is good when its J is within this of the optimum.
        confidence_pct: Of the bounds.
    """
    beta = 1.0 - confidence_pct / 100.0
    with make_console().status("") as status:
        found = certify(
            settings, scenarios, tolerance_pct / 100.0, beta,
            lambda done: status.update(f"{done} of {scenarios} scenarios"),
        )  # fmt: skip
    none_failed = 100.0 * failure_bound(0, scenarios, beta)
    power, period_s = settings.optimizer_plc.program.budget.power, settings.process.sampling_period_s
    heading = (
        f"{scenarios} independent scenarios of {SCENARIO_TICKS // 240} min under random telegraphs, problems "
        f"every {period_s:g} s; good is an answer within {tolerance_pct:g} % of the optimal J\n"
        f"with confidence {confidence_pct:g} %: at most so many problems at a random instant are not good after "
        f"the iterations that fit into {period_s:g} s at P = {power:g};\n"
        "at most so many scenarios have one that is not; and at most "
        f"{none_failed:.2f} % have one that needs more iterations than the most needed\n\n"
    )
    header = (
        "solver",
        f"fit into {period_s:g} s",
        "problems failed",
        "at most",
        "scenarios failed",
        "at most",
        "most needed",
    )
    return heading + aligned([header, *(_row(one, scenarios) for one in found)], numbers=True)


def _row(one: Certificate, scenarios: int) -> tuple[str, ...]:
    return (
        one.solver, f"{one.fitting}", f"{one.failures} of {scenarios}", f"{100 * one.failure_bound:.1f} %",
        f"{one.run_failures} of {scenarios}", f"{100 * one.run_bound:.1f} %",
        f"{one.worst}" if one.worst <= LONGEST else f"over {LONGEST}",
    )  # fmt: skip
