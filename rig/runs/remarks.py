"""What the head of a run says of its configuration, and a configuration that the PLC can do."""

from dataclasses import replace

from coldloop.config import Configuration
from coldloop.errors import UsageError
from coldloop.process.loaded import PROCESS
from coldloop.process.signals import TICK_S
from coldloop.session.settings import TimeMode
from optimizer_plc.budget import PlcBudget
from optimizer_plc.settings import ProgramSettings
from rig.settings import Settings

PERIOD = "optimizer_plc.program.updating_period_s"


def remarks(effective: Configuration[Settings]) -> list[str]:
    """Return what a user should know before a run, a line each; usually nothing.

    Raises:
        UsageError: In real time no answer would ever be there in time.
    """
    program, realtime = effective.settings.optimizer_plc.program, effective.settings.session.mode is TimeMode.REALTIME
    ticks, budget = round(program.updating_period_s / TICK_S), _budget(program)
    if realtime and ticks and not budget.is_enough(ticks):
        raise UsageError(
            f"{PERIOD} = {program.updating_period_s:g}: this PLC (P = {program.budget.power:g}) needs"
            f" {budget.answer_after_s(1):.3g} s for an answer with {program.solver_name}, and in real time none comes"
            " sooner: give a longer period, adaptive, or --enforce"
        )
    found, left_out = [too_slow(program)], effective.notes()
    if not PROCESS.has_load and "plant.load" in effective.sources:
        found.append(f"load {effective.settings.plant.load}: the {PROCESS.name} has no load; only the length is taken")
    if left_out:
        found.append(f"not applied of the preset: {', '.join(left_out)}; `coldloop config` says why")
    return [*filter(None, found)]


def too_slow(program: ProgramSettings) -> str:
    """Return that the PLC cannot do what is simulated; empty where it can."""
    why = _budget(program).too_slow(round(program.updating_period_s / TICK_S))
    return why and (
        f"this PLC (P = {program.budget.power:g}) cannot do what is simulated: with {program.solver_name} {why}; "
        "one iteration is granted all the same (--enforce: not)"
    )


def enforced(effective: Configuration[Settings]) -> Configuration[Settings]:
    """Return a configuration whose fixed updating period is as long as the PLC takes; an adaptive one always is.

    Raises:
        UsageError: The longest updating period is too short for the PLC.
    """
    program = effective.settings.optimizer_plc.program
    shortest = _budget(program).shortest_ticks
    if shortest is None:
        raise UsageError(
            f"--enforce: with {program.solver_name} {_budget(program).too_slow()}; take a faster PLC "
            "(optimizer_plc.program.budget.power), another solver, or a longer sampling period"
        )
    if not 0 < round(program.updating_period_s / TICK_S) < shortest:
        return effective
    settings = effective.settings.with_program(updating_period_s=shortest * TICK_S)
    return replace(effective, settings=settings, sources={**effective.sources, PERIOD: "--enforce"})


def _budget(program: ProgramSettings) -> PlcBudget:
    return PlcBudget(program.budget, program.iteration_s)
