"""The control PLC's output guard as functions of the typed tree, in double precision."""

from coldloop.process.limits import InputLimits
from coldloop.registers.control_plc import SEQUENCE_ROWS
from coldloop_control_plc import output_limits
from coldloop_control_plc.output_limits import beginning, plain
from coldloop_rig.cosim.compiled.portable import PORTABLE
from coldloop_rig.plc_export.tree.nodes import ArrayType, Function, Kind
from coldloop_rig.plc_export.tree.reading import Program
from coldloop_rig.plc_export.tree.subset import type_of


class GuardKernels:
    """Functions of the output guard.

    Args:
        limits: Of the inputs.
    """

    def __init__(self, limits: InputLimits) -> None:
        self.limits = plain(limits)
        state = type_of(beginning(self.limits, self.limits.low))
        n, tick, of = len(self.limits.low), Kind.INT, type_of(self.limits)
        row, rows = ArrayType(Kind.REAL, (n,)), ArrayType(Kind.REAL, (SEQUENCE_ROWS, n))
        program = Program(portable=frozenset(PORTABLE), double=True)
        self.begin, self.resume, self.admit, self.judge, self.in_range = self.entries = tuple(
            program.function(function, types) for function, types in (
                (output_limits.begin, (state, of, row)),
                (output_limits.resume, (state, of, tick, row)),
                (output_limits.admit, (state, of, tick, row, Kind.BOOL)),
                (output_limits.judge, (state, state, of, tick, rows, tick, tick, tick, rows, tick)),
                (output_limits.in_range, (of, row)),
            )
        )  # fmt: skip
        self.functions: list[Function] = program.functions
        """Callees before their callers."""
