"""Remarks on the configuration in the head of a run, and the configuration changed to one that the PLC can do."""

from dataclasses import replace

import numpy as np

from coldloop.config import Configuration
from coldloop.errors import UsageError
from coldloop.process.lti_model import load
from coldloop.session.settings import TimeMode
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.qp.linear_algebra import real_of
from coldloop_optimizer_plc.settings import AdaptiveSettings, ProgramSettings, RuleName
from coldloop_rig.plc_sizing.holding import digits_last_s, shortest_period_s, waiting
from coldloop_rig.settings import Settings

UNSET = AdaptiveSettings.model_fields
PERIOD = "optimizer_plc.program.updating_period_s"


def remarks(effective: Configuration[Settings]) -> list[str]:
    """Return what a user should know before a run, a line each; usually nothing.

    Raises:
        UsageError: In real time no answer would ever be there in time.
    """
    program, realtime = effective.settings.optimizer_plc.program, effective.settings.session.mode is TimeMode.REALTIME
    process, budget = effective.settings.process, _budget(program)
    ticks = round(program.updating_period_s / process.tick_s)
    if realtime and ticks and not budget.is_enough(ticks):
        raise UsageError(
            f"{PERIOD} = {program.updating_period_s:g}: this PLC (P = {program.budget.power:g}) needs"
            f" {budget.answer_after_s(1):.3g} s for an answer with {program.solver_name}, and in real time none comes"
            " sooner: give a longer period, adaptive, or --enforce"
        )
    found, left_out = [too_slow(program), certificate(effective.settings)], effective.notes()
    if not process.has_load and "plant.load" in effective.sources:
        found.append(f"load {effective.settings.plant.load}: the {process.name} has no load; only the length is taken")
    adaptive = program.adaptive
    unused = {"q_first", "q_min", "q_max", "delta"} & adaptive.model_fields_set
    if adaptive.rule is RuleName.CONTRACTION and any(getattr(adaptive, one) != UNSET[one].default for one in unused):
        found.append(
            f"adaptive.{', adaptive.'.join(sorted(unused))}: of Algorithm 1; the rule is adaptive.rule=contraction"
        )
    if left_out:
        found.append(f"not applied of the preset: {', '.join(left_out)}; `coldloop config` says why")
    return [*filter(None, found)]


def too_slow(program: ProgramSettings) -> str:
    """Return the remark that the PLC is too slow for the simulated controller; empty where it is fast enough."""
    why = _budget(program).too_slow(round(program.updating_period_s / program.process.tick_s))
    return why and (
        f"this PLC (P = {program.budget.power:g}) cannot do what is simulated: with {program.solver_name} {why}; "
        "one iteration is granted all the same (--enforce: not)"
    )


def certificate(settings: Settings, *, only_lost: bool = False) -> str:
    """Return what the fixed updating period means for a plant with a mode that grows; empty for another.

    Where it is adaptive or too short for the PLC it is the PLC's shortest. With `only_lost` it is empty where held.
    """
    limits, program, process, more = settings.limits, settings.optimizer_plc.program, settings.process, ""
    reach, shortest_s = np.array([limits.low, limits.high, limits.rate]), _shortest_s(program)
    needs, fixed_s = waiting(load(settings.model.file), process, reach, limits.rate_share), program.updating_period_s
    rule = "adaptive.contraction" if program.adaptive.rule is RuleName.CONTRACTION else "adaptive"
    most = program.adaptive.contraction.q_max if rule == "adaptive.contraction" else program.adaptive.q_max
    period_s, longest_s = max(fixed_s, shortest_s), _budget(program).times.period(most) * process.tick_s
    if not needs or (only_lost and period_s <= needs.limit_s):
        return ""
    if not fixed_s and longest_s > needs.longest_s >= shortest_s:
        more += f"; adaptive ones go up to {longest_s:.3g} s: lower optimizer_plc.program.{rule}.q_max"
    horizon_s = program.design.horizon * process.sampling_period_s
    if horizon_s > (most_s := digits_last_s(needs.growth, real_of(program.arithmetic))):
        more += (
            f"; the horizon of {horizon_s:.3g} s leaves the problem no digits, in {program.arithmetic} beyond "
            f"{most_s:.3g} s: shorten optimizer_plc.program.design.decision_instants"
        )
    whose = "the PLC's shortest updating period" if period_s > fixed_s else "the updating period"
    return f"a mode of the plant grows with {needs.growth:.3g} /s: {needs.text(period_s, whose)}{more}"


def enforced(effective: Configuration[Settings]) -> Configuration[Settings]:
    """Return a configuration whose fixed updating period is as long as the PLC takes; an adaptive one always is.

    Raises:
        UsageError: The longest updating period is too short for the PLC, or the shortest too long for the plant.
    """
    program, tick_s = effective.settings.optimizer_plc.program, effective.settings.process.tick_s
    shortest_s = _shortest_s(program)
    if why := _budget(program).too_slow():
        raise UsageError(
            f"--enforce: with {program.solver_name} {why}; take a faster PLC "
            "(optimizer_plc.program.budget.power), another solver, or a longer sampling period"
        )
    if why := certificate(effective.settings, only_lost=True):
        raise UsageError(f"--enforce: {why}; take a faster PLC, a shorter period, or inputs that reach further")
    if not 0 < round(program.updating_period_s / tick_s) < round(shortest_s / tick_s):
        return effective
    settings = effective.settings.with_program(updating_period_s=shortest_s)
    return replace(effective, settings=settings, sources={**effective.sources, PERIOD: "--enforce"})


def _shortest_s(program: ProgramSettings) -> float:
    times = _budget(program).times
    return shortest_period_s(times.slots + times.iteration, times.tick_s)


def _budget(program: ProgramSettings) -> PlcBudget:
    return PlcBudget(program.budget, program.iteration_s)
