"""Which kernels compute in single precision, and which of them with a double all the same.

It runs in an interpreter of its own: kernels that other tests have compiled, for other types, are none of its business.
"""

import importlib
import json
import pkgutil
import re
import sys
from collections.abc import Sequence
from typing import Any

import numba
from numba.core.dispatcher import Dispatcher

import coldloop_optimizer_plc
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.settings import DEFAULT_MODEL_FILE, InputLimits
from coldloop.registers.control_plc import Update, Verdict
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorKind, EstimatorSettings
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName


def kernels() -> dict[str, Dispatcher]:
    """Return all kernels of the optimiser by module and name."""
    found = {}
    for info in pkgutil.walk_packages(coldloop_optimizer_plc.__path__, "coldloop_optimizer_plc."):
        if not info.name.endswith("__main__"):
            module = importlib.import_module(info.name)
            here = [value for value in vars(module).values() if isinstance(value, Dispatcher)]
            found |= {f"{kernel.py_func.__module__}.{kernel.py_func.__name__}": kernel for kernel in here}
    return found


def code(kernel: Dispatcher, signature: tuple[Any, ...]) -> str:
    """Return the LLVM code of a kernel and those it calls, without the wrapper that turns results into Python's."""
    fresh = numba.njit(error_model="numpy")(kernel.py_func)
    fresh.compile(signature)
    functions = fresh.inspect_llvm(fresh.signatures[0]).split("\ndefine ")[1:]
    own = [text for text in functions if "cpython" not in text.split("(")[0] and "cfunc" not in text.split("(")[0]]
    assert own
    return "\n".join(own)


DIGITS = re.compile(r"sitofp i64 \S+ to double|@llvm\.(?:log10|floor)\.f64\(|fptosi double")
"""How numba counts the digits of an integer, for what it says about arrays whose shapes differ."""


def has_double(llvm: str) -> bool:
    """Tell whether LLVM code computes with a double."""
    return any(re.search(r"\bdouble\b", line) and not DIGITS.search(line) for line in llvm.splitlines())


def update_twice(program: OptimizerProgram, model: LtiModel) -> None:
    """Answer two updates of a plant that is away from its operating point."""
    u, y, x = (tuple(values.tolist()) for values in (model.u0 + 1.0, model.y0 * 1.01, model.x0 * 1.01))
    program.restart(0.0)
    for number, tick in enumerate((0, 10)):
        program.plan(Update(number, tick, 0, number, load=model.w0 + 100.0, u_before=u, u=u, y=y, x=x))
        program.solve()
        program.report(Verdict.NONE)


def examine() -> tuple[list[str], list[str]]:
    """Return the kernels that have been called with single precision, and what is wrong with their code."""
    called, faults = [], []
    for name, kernel in kernels().items():
        for types in [types for types in kernel.signatures if "float32" in str(types)]:
            called.append(name)
            if "float64" in str(types):
                faults.append(f"{name} is called with both types: {types}")
            elif has_double(code(kernel, types)):
                faults.append(f"{name}, or one that it calls, computes with a double")
    return called, faults


def main(cases: Sequence[tuple[str, str]]) -> None:
    """Compute two updates in single precision with each pair of solver and estimator; write what `examine` finds."""
    model = load(DEFAULT_MODEL_FILE)
    for solver, estimator in cases:
        kind = EstimatorSettings(kind=EstimatorKind(estimator))
        chosen = ProgramSettings(arithmetic=Arithmetic.FLOAT32, estimator=kind, solver=SolverName(solver))
        update_twice(OptimizerProgram(model, chosen, InputLimits()), model)
    sys.stdout.write(json.dumps(examine()))
