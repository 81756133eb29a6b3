"""Constants of Structured Text: lists that tools take, in pieces where they are larger, and the sum over them."""

import math
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from coldloop_rig.plc_export.kernels.ode_program import Array
from coldloop_rig.plc_export.structured_text.lowering import Split
from coldloop_rig.plc_export.structured_text.printer import LARGEST, TABLE, StructuredTextPrinter, global_name, section
from coldloop_rig.plc_export.structured_text.verdict import LENGTH, VERDICT
from coldloop_rig.plc_export.tree.nodes import Path, Type
from coldloop_rig.plc_export.tree.subset import UnfitKernelError, type_of

LARGEST_LIST: Final = 64 * 1024
"""Bytes of a list of constants: a data block of standard access of an S7-1200 or S7-1500 holds no more."""
PRIME, FACTOR = 65521, 257
PARTS: Final = 3
"""Integers that the bits of a number in double precision are read as."""
LEAST_EXPONENT: Final = -1100
"""Below that of the smallest number."""


class Constants:
    """What nothing writes to, as `VAR_GLOBAL`: the literals of a printer, and these.

    Not every tool takes `VAR_EXTERNAL CONSTANT`, which would have to go with `VAR_GLOBAL CONSTANT`.

    Args:
        values: By the fields that lead to them.
        printer: It prints what uses them.
    """

    def __init__(self, values: Mapping[Path, Array], printer: StructuredTextPrinter) -> None:
        self.values, self.printer = values, printer

    def _weighed(self, of_real: int, of_integer: int) -> list[int]:
        """Return the numbers of each one, those with a point and the others counted so often; first the literals."""
        weights = {"f": of_real}
        return [of_real * len(self.printer.literals), *(weights.get(values.dtype.kind, of_integer) * max(values.size, 1)
                                                        for values in self.values.values())]  # fmt: skip

    def _sizes(self) -> list[int]:
        """Return the bytes of each one; first those of the literals."""
        return self._weighed(4 if self.printer.single else 8, 4)

    def bytes(self) -> int:
        """Return the bytes of all of them."""
        return sum(self._sizes())

    def declared(self) -> dict[str, tuple[str, str]]:
        """Return type and value of each constant by its name."""
        literals = f"[\n        {', '.join(self.printer.literals)}]"
        found = {TABLE: (f"{TABLE}_table", literals)}
        for path, values in self.values.items():
            name = global_name(path)
            if name in found:
                raise UnfitKernelError(f"two constants have the name {name}")
            found[name] = (self.printer.type(type_of(values[()])), self.value(values))
        return found

    def value(self, values: Array) -> str:
        """Return a number, or an array as an initialiser; one without elements has a zero."""
        if values.dtype.kind == "b":
            return "TRUE" if values else "FALSE"
        number = self.printer.number if values.dtype.kind == "f" else lambda each: str(int(each))
        printed = [number(each) for each in (values.ravel() if values.size else np.zeros(1, values.dtype))]
        rows = [", ".join(printed[place : place + 6]) for place in range(0, len(printed), 6)]
        return f"[\n        {(',' + chr(10) + ' ' * 8).join(rows)}]" if values.ndim else printed[0]

    def lists(self) -> Iterator[str]:
        """Yield lists of constants, none larger than tools take."""
        listed: dict[str, str] = {}
        room = LARGEST_LIST
        for (name, (kind, value)), size in zip(self.declared().items(), self._sizes(), strict=True):
            if size > LARGEST_LIST:
                raise UnfitKernelError(f"{name}: {size} bytes, and a list of constants has at most {LARGEST_LIST}")
            if size > room:
                yield section("VAR_GLOBAL", listed)
                listed, room = {}, LARGEST_LIST
            listed[name] = f"{kind} := {value}"
            room -= size
        yield section("VAR_GLOBAL", listed)

    def configuration(self, *more: str) -> str:
        """Return the configuration with these lists, more of them, and room for the verdict of the self-test."""
        verdict = section("VAR_GLOBAL", {VERDICT: self.printer.array_type("DINT", LENGTH)})
        return configuration(iter([*self.lists(), *more, verdict]))

    def sum(self) -> int:
        """Return the sum over all of them that the self-test computes."""
        double = not self.printer.single
        sum_ = sum_of(np.array([float(each.rpartition("#")[2]) for each in self.printer.literals]), double=double)
        for values in self.values.values():
            sum_ = sum_of(values if values.size else np.zeros(1), sum_, double=double)
        return sum_

    def summed(self) -> dict[str, str]:
        """Return the parts of a self-test that sum them up: declarations, lengths, a case for each constant."""
        lengths = self._weighed(1 if self.printer.single else PARTS, 1)
        self.printer.array_type("DINT", len(lengths))
        declared = self.declared()
        return {
            "EXTERNALS": "\n".join(f"    {name} : {kind};" for name, (kind, _) in declared.items()),
            "PARTS": str(len(lengths)), "LENGTHS": ", ".join(map(str, lengths)), "SUM": str(self.sum()),
            "CONSTANTS": "".join(self._item(part, name, values) for part, (name, values)
                                 in enumerate(zip(declared, (None, *self.values.values()), strict=True))).rstrip(),
        }  # fmt: skip

    def _item(self, part: int, name: str, values: Array | None) -> str:
        """Return the case of the self-test that reads an element of a constant."""
        pad = " " * 20
        if values is not None and values.dtype.kind == "b":
            read = f"IF {name} THEN\n{pad}    item := 1;\n{pad}ELSE\n{pad}    item := 0;\n{pad}END_IF;"
        else:
            real = values is None or values.dtype.kind == "f"
            double = real and not self.printer.single
            place = f"(offset / {PARTS})" if double else "offset"
            element = f"{name}[{place}]" if values is None or values.ndim else name
            bits = f"cl_lreal_bits({element}, (offset MOD {PARTS}))" if double else f"cl_bits({element})"
            read = f"item := {bits if real else element};"
        return f"{pad}{part}:\n{pad}    {read.replace(chr(10), chr(10) + '    ')}\n"


def configuration(lists: Iterator[str]) -> str:
    """Return a configuration with these lists of variables, and one task that runs `cl_main`."""
    return f"""CONFIGURATION cl_configuration
{"".join(lists)}RESOURCE cl_resource ON PLC
    TASK cl_task(INTERVAL := T#250ms, PRIORITY := 1);
    PROGRAM cl_program WITH cl_task : cl_main;
END_RESOURCE
END_CONFIGURATION
"""


def in_pieces(constants: Mapping[Path, Array]) -> tuple[dict[Path, Array], Split]:
    """Return constants with those that are larger than a list in pieces of whole rows; and which these are."""
    found: dict[Path, Array] = {}
    split: dict[Path, list[tuple[Path, int]]] = {}
    for path, values in constants.items():
        rows = LARGEST_LIST // (4 * values[0].size) if values.ndim > 1 and values.size else 0
        if 4 * values.size <= LARGEST_LIST or not rows:
            found[path] = values
            continue
        pieces = {(*path, str(first)): values[first : first + rows] for first in range(0, len(values), rows)}
        split[path] = [(piece, part.size) for piece, part in pieces.items()]
        found |= pieces
    return found, split


def types_in(values: Mapping[Path, Array]) -> dict[Path, Type]:
    """Return the types of constants."""
    return {path: type_of(each[()]) for path, each in values.items()}


def scalar_of(values: Array) -> str:
    """Return the type of an array's elements."""
    return "REAL" if values.dtype.kind == "f" else "DINT"


def sum_of(values: Array, before: int = 0, *, double: bool = False) -> int:
    """Return the sum over numbers that the self-test computes: no change of one bit leaves it as it is."""
    if values.dtype.kind == "f" and double:
        items = np.array([item for value in values.ravel().tolist() for item in bits_of_double(value)])
    elif values.dtype.kind == "f":
        single = np.nan_to_num(values.astype(np.float32).ravel(), nan=float(LARGEST))
        items = np.abs(single).view(np.int32).astype(int) * np.where(single < 0, -1, 1)
    else:
        items = values.astype(int).ravel()
    for item in items.tolist():
        before = (before * FACTOR + item % PRIME) % PRIME
    return before


def bits_of_double(value: float) -> tuple[int, int, int]:
    """Return exponent, negative where the number is, and the halves of what is behind the point: `cl_lreal_bits`."""
    finite = value if np.isfinite(value) else math.copysign(float(LARGEST), value)
    share, exponent = math.frexp(abs(finite))
    mantissa, exponent = (2.0 * share - 1.0, exponent - 1) if share else (-1.0, LEAST_EXPONENT)
    high, low = divmod(int(mantissa * 2**52), 2**26)
    return (exponent - LEAST_EXPONENT) * (-1 if finite < 0 else 1), high, low


def summing(array: str, scalar: str, length: int) -> str:
    """Return the loop of the self-test that sums up an array."""
    item = f"cl_bits({array}[i])" if scalar == "REAL" else f"{array}[i]"
    return (f"            FOR i := 0 TO {length - 1} DO\n"
            f"                sum := cl_floor_mod(((sum * {FACTOR}) + cl_floor_mod({item}, {PRIME})), {PRIME});\n"
            "            END_FOR;\n")  # fmt: skip
