"""Records of constants in C: initial values, the arrays in them, and the sum over all that the self-test computes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coldloop_rig.plc_export.c.printer import Printer, identifier
from coldloop_rig.plc_export.kernels.ode_program import crc
from coldloop_rig.plc_export.templates import filled, template
from coldloop_rig.plc_export.tree.nodes import Kind

Array = NDArray[Any]


class ConstantRecords:
    """Records of constants, noted as they are printed.

    Args:
        printer: It has printed all that uses them: its literals are summed up first.
    """

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.arrays: dict[str, Array] = {}
        """By their names."""
        self.real, self.type = np.dtype(np.float32 if printer.single else np.float64), printer.scalars[Kind.REAL]
        self._sums: list[str] = []
        self._sum = crc(np.array([float(each.rstrip("f")) for each in printer.literals], self.real))

    def printed(self, path: str, value: object) -> str:
        """Return the initial value of a record, a number or an array, whose arrays and numbers are noted."""
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            parts = (f".{identifier(name)} = {self.printed(f'{path}.{identifier(name)}', part)}"
                     for name, part in zip(value._fields, value, strict=True))  # fmt: skip
            return f"{{{', '.join(parts)}}}"
        array = np.asarray(value)
        array = array if array.size else np.zeros(1, array.dtype)  # C has no array without elements
        real = array.dtype.kind == "f"
        self._sum = crc(array.astype(self.real if real else np.int32), self._sum)
        function, kind = ("sum_of_reals", self.type) if real else ("sum_of_integers", "int32_t")
        if array.ndim:
            name = path.replace(".", "_")
            self._sums.append(f"changed = changed || *(const {kind} *const volatile *)&{path} != {name};")
            self._sums.append(f"sum = {function}(sum, {name}, {array.size});")
            self.arrays[name] = array
            return name
        if isinstance(value, bool | np.bool_):
            self._sums.append(f"sum = sum_of_integers(sum, &(int32_t){{*(const volatile unsigned char *)&{path}}}, 1);")
            return str(bool(value)).lower()
        self._sums.append(f"sum = {function}(sum, &{path}, 1);")
        return self.printer.number(float(array)) if real else str(int(array))

    def bytes(self) -> int:
        """Return the bytes of arrays and literals."""
        reals = self.real.itemsize
        arrays = sum((reals if array.dtype.kind == "f" else 4) * array.size for array in self.arrays.values())
        return arrays + reals * len(self.printer.literals)

    def arrays_text(self) -> str:
        """Return the definitions of the arrays."""
        return "\n".join(self.printer.array(name, values) for name, values in self.arrays.items())

    def declared(self) -> str:
        """Return the declarations of the sum, and what it is."""
        return f"""/* Sum over literals and constants; SUM_OF_CONSTANTS is what it was when they were written. */
uint32_t sum_of_constants(void);
uint32_t sum_of_reals(uint32_t sum, const volatile {self.type} *values, int32_t count);
uint32_t sum_of_integers(uint32_t sum, const volatile int32_t *values, int32_t count);
#define SUM_OF_CONSTANTS UINT32_C({self._sum})
"""

    def summing(self) -> str:
        """Return the functions that sum up."""
        bits = {"REAL": self.type, "BITS": f"uint{8 * self.real.itemsize}_t", "BYTES": str(self.real.itemsize)}
        body = "".join(f"    {each}\n" for each in self._sums)
        return f"""{filled(template("c/sums.c"), bits)}
uint32_t sum_of_constants(void) {{
    bool changed = false; /* where an array is */
    uint32_t sum = sum_of_reals(0, literals, N_LITERALS);
{body}    return changed ? ~SUM_OF_CONSTANTS : sum;
}}
"""
