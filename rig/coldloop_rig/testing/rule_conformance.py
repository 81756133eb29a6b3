"""What a rule of the updating period that is not ours keeps of what the rig relies on."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from coldloop.process.declaration import REFERENCE_TICK_S
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop_optimizer_plc.rules import Observation, assess
from coldloop_optimizer_plc.rules.outside import OutsideDecision
from coldloop_rig.testing.requirement import Requirement

DECISIONS: Final = 200
"""In each session."""
LONGEST_TICKS: Final = 20
"""Of a sampling period, as the cold box has it; a ladder says what periods there are."""
LADDERS: Final = (
    tuple(range(SHORTEST_TICKS, LONGEST_TICKS + 1)), (SHORTEST_TICKS, LONGEST_TICKS), (LONGEST_TICKS,),
)  # fmt: skip
"""Every period, two, and a single one: on a slow PLC there is no other."""
Made = Callable[[Sequence[int]], OutsideDecision]


def rule_requirements(make: Made) -> list[Requirement]:
    """Return what the rules that are made keep, in a session with each ladder."""
    failed = dict.fromkeys(
        ("begins with the number of a period", "decides numbers of periods, 1 to their count",
         "has the number of a period after a load step", "decides the same from the same observations",
         "begins a session as if there had been none before"), 0,
    )  # fmt: skip
    begins, decides, steps, same, fresh = failed
    for ladder in LADDERS:
        rule, twin = make(ladder), make(ladder)
        decided = session(rule, ladder)
        failed[begins] += not is_q(decided[0], ladder)
        failed[decides] += not all(is_q(q, ladder) for q in decided[1:])
        failed[steps] += not is_q(getattr(rule, "after_interruption", rule.first)(), ladder)
        failed[same] += decided != session(twin, ladder)
        failed[fresh] += decided != session(make(ladder), ladder)
    return [Requirement(text, failures, len(LADDERS)) for text, failures in failed.items()]


def is_q(q: float, ladder: Sequence[int]) -> bool:
    """Return whether this is the number of a period, which is one of whole ticks."""
    return float(q).is_integer() and 1 <= q <= len(ladder)


def session(rule: OutsideDecision, ladder: Sequence[int]) -> list[float]:
    """Return what a rule decides in a session of random costs over twelve decades, the first q first.

    A q that it should not have decided is followed by the nearest.
    """
    random = np.random.default_rng(1)
    decided: list[float] = [rule.first()]
    for _ in range(DECISIONS):
        q = int(np.clip(np.nan_to_num(decided[-1], nan=1.0), 1, len(ladder)))
        before, hot_start, delivered, effective = (10.0 ** random.uniform(0.0, 12.0, 4)).tolist()
        last_but_one = delivered * (1.0 + abs(float(random.normal())))
        ticks = ladder[q - 1]
        o = Observation(q, 4 * ticks, ticks * REFERENCE_TICK_S, before, hot_start, last_but_one, delivered, effective)
        decided.append(rule.decide(o, assess(o)))
    return decided
