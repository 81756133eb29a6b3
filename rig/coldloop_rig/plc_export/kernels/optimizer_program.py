"""The whole optimiser as functions of the typed tree, with its constants."""

from collections.abc import Callable, Mapping
from typing import Any, Final, cast

import numpy as np
from numba.core.dispatcher import Dispatcher

from coldloop_optimizer_plc import decisions, scheme
from coldloop_optimizer_plc.computing_settings import Arithmetic
from coldloop_optimizer_plc.decisions import Latched, Starts
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.arithmetic import real_of
from coldloop_optimizer_plc.rules import make_rule
from coldloop_optimizer_plc.rules.interface import DECISIONS, decide_by
from coldloop_optimizer_plc.solvers.kernel_solver import KERNELS, solve_by
from coldloop_rig.plc_export.tree.nodes import Function, Type
from coldloop_rig.plc_export.tree.reading import Program
from coldloop_rig.plc_export.tree.subset import type_of

GENERIC: Final = {
    cast("Callable[..., Any]", of): {kind.__name__: cast("Dispatcher", kernel) for kind, kernel in kernels.items()}
    for of, kernels in ((solve_by, KERNELS), (decide_by, DECISIONS))
}
PLATFORM: Final = frozenset({"power", "log"})
"""The cube root of a step size, and the logarithms of the rules of the updating period."""


class OptimizerKernels:
    """Functions of the optimiser, and what they compute with.

    Args:
        optimizer: Of the settings that are exported.

    Raises:
        UnfitKernelError: A kernel uses what is not in the subset.
    """

    def __init__(self, optimizer: OptimizerProgram) -> None:
        real = real_of(Arithmetic.FLOAT32)
        self.rules = [make_rule(optimizer.settings, optimizer.budget, ticks, real)
                      for ticks in range(optimizer.budget.longest_ticks + 1)]  # fmt: skip
        """The rule for each fixed updating period in ticks; that for 0 adapts it."""
        self.starts = [Starts(rule.first, rule.after_interruption()) for rule in self.rules]
        self.constants: Mapping[str, Any] = {
            "constants": optimizer.constants._replace(fixed_ticks=0), "method": optimizer.method,
        }  # fmt: skip
        process = optimizer.process
        sizes = (len(process.inputs), len(process.inputs), len(process.outputs), len(process.states), 0)
        latched = Latched(0, 0, 0, real(0.0), *(np.zeros(size, real) for size in sizes))
        c, method, m = self.constants["constants"], self.constants["method"], optimizer.state
        program = Program(PLATFORM, GENERIC)
        self.entries: list[Function] = [
            program.function(cast("Dispatcher", kernel), tuple(map(type_of, given)))
            for kernel, given in (
                (decisions.begin_session, (c, m)),
                (decisions.take_update, (c, self.rules[0], self.starts[0], m, latched)),
                (scheme.solve, (c, method, m)),
                (decisions.note_answer, (m, True)),
            )
        ]
        self.functions = program.functions
        """Callees before their callers."""
        self.types: tuple[Type, ...] = tuple(parameter.type for each in self.functions for parameter in each.parameters)
