"""What of Python a kernel may use to be exported, and how the rest is refused."""

import ast
import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, TypeAlias

import numpy as np
from numba.core.dispatcher import Dispatcher

from coldloop.errors import UsageError
from coldloop_rig.plc_export.tree.nodes import ArrayType, Kind, RecordType, RowsType, StructType, Type

KINDS = {"f": Kind.REAL, "i": Kind.INT, "u": Kind.UNSIGNED, "b": Kind.BOOL}
Kernel: TypeAlias = Dispatcher | Callable[..., Any]
"""A kernel, or a function of plain Python that is one for the exporter."""
RESERVED = re.compile(r"(new|result|at|stop)_\d")


class UnfitKernelError(UsageError):
    """A kernel uses what is not in the subset."""


class Source:
    """Syntax tree of a kernel, with what its names mean where it was written."""

    def __init__(self, function: Kernel) -> None:
        python: Callable[..., Any] = function.py_func if isinstance(function, Dispatcher) else function
        self.name = python.__name__
        self.file = inspect.getsourcefile(python) or python.__module__
        lines, first = inspect.getsourcelines(python)
        tree = ast.parse(textwrap.dedent("".join(lines)))
        ast.increment_lineno(tree, first - 1)
        definition = tree.body[0]
        if not isinstance(definition, ast.FunctionDef):
            raise UnfitKernelError(f"{self.file}:{first}: a kernel is a function")
        self.definition = definition
        self.meanings = {**python.__globals__, **inspect.getclosurevars(python).nonlocals}
        self.assigned, self.assigned_once = self._assigned()

    def refusal(self, node: ast.AST, why: str) -> UnfitKernelError:
        """Return the error for a node, in one line."""
        line = getattr(node, "lineno", self.definition.lineno)
        raise UnfitKernelError(
            f"{self.file}:{line}: {why}; an exported kernel has a smaller Python (`coldloop docs plc-export`)"
        )

    def _assigned(self) -> tuple[set[str], set[str]]:
        """Return the variables, and those that are assigned in one place."""
        names = [node.id for node in ast.walk(self.definition) if isinstance(node, ast.Name)
                 and isinstance(node.ctx, ast.Store)]  # fmt: skip
        parameters = {argument.arg for argument in self.definition.args.args}
        for name in {*names, *parameters}:
            if RESERVED.match(name):
                raise self.refusal(self.definition, f"the name {name} is kept for intermediate values")
        return set(names), {name for name in names if names.count(name) == 1} - parameters


def rows_of(name: str, value: object) -> RowsType | None:
    """Return the type of a structured array, whose records get this name; of anything else None."""
    if not (isinstance(value, np.ndarray) and value.dtype.fields):
        return None
    numbers = tuple((field, KINDS[kind.kind]) for field, (kind, *_) in value.dtype.fields.items())
    return RowsType(StructType(name, numbers), len(value))


def type_of(value: object) -> Type:  # noqa: PLR0911 one case a type
    """Return the type of an argument: an array, numbers in a row, a NamedTuple, a dataclass, or a number.

    Raises:
        UnfitKernelError: It is something else.
    """
    if isinstance(value, np.ndarray) and value.dtype.kind in KINDS and value.ndim:
        return ArrayType(KINDS[value.dtype.kind], value.shape)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        own = type(value).__name__
        parts = tuple((name, rows_of(f"{own}{name.capitalize()}", part) or type_of(part))
                      for name, part in zip(value._fields, value, strict=True))  # fmt: skip
        state = any(isinstance(kind, RowsType) or (isinstance(kind, RecordType) and kind.state) for _, kind in parts)
        return RecordType(own, parts, state)
    if is_dataclass(value) and not isinstance(value, type):
        parts = tuple((each.name, type_of(getattr(value, each.name))) for each in fields(value))
        return RecordType(type(value).__name__, parts, state=True, mutable=True)
    if isinstance(value, list | tuple) and (numbers := np.array(value)).dtype.kind in KINDS:
        return ArrayType(KINDS[numbers.dtype.kind], numbers.shape)
    if isinstance(value, bool | np.bool_):
        return Kind.BOOL
    if isinstance(value, int | np.integer):
        return Kind.INT
    if isinstance(value, float | np.floating):
        return Kind.REAL
    raise UnfitKernelError(f"an argument of type {type(value).__name__} cannot be exported: arrays, records, numbers")
