"""Decides which updates run in the compiled loop, and takes over their results."""

from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import Optimization
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.solvers import KernelSolver
from rig.cosim.compiled.records import Optimizer, Reports


def is_compiled(program: OptimizerProgram) -> bool:
    """Return whether the program's updates have a compiled form: those of a solver of our own."""
    if type(program) is not OptimizerProgram:  # who has made another kind of it wants to be asked
        return False
    return isinstance(program.solver, KernelSolver)


def is_ordinary(program: OptimizerProgram) -> bool:
    """Return whether the update under way is one of many: what is played began at its instant."""
    now, playing = program.state.numbers[0], program.state.playing.numbers[0]
    return bool(now["planned"] and playing["length"] and playing["first_tick"] == now["tick"])


def parts_of(program: OptimizerProgram) -> Optimizer:
    """Return the program as the loop takes it; its state is the program's own."""
    return Optimizer(program.constants, program.method, program.rule, program.state)


def optimizations(reports: Reports, solved: int) -> list[Optimization]:
    """Return what was reported, as the recorder takes it."""
    counts, values = reports.counts[:solved].tolist(), reports.values[:solved].tolist()
    rows = ([*row, int(Verdict.ACCEPTED), *of_row] for row, of_row in zip(counts, values, strict=True))
    return [Optimization(*row) for row in rows]
