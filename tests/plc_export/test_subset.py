"""Kernels beyond the subset are refused in one line, with the file and the line."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from coldloop_export.statements import Program
from coldloop_export.tree import UnfitKernelError, type_of

HEAD = """
import math
import numpy as np
from coldloop.kernels.compiled import kernel

def plain(x):
    return x

@kernel
def doubled(z):
    return z + z

@kernel
def bad(z, A, k):
"""
REFUSED = {
    "a dot product": "    return np.dot(z, z)  #!",
    "a matrix product": "    return A @ z  #!",
    "a sum of numpy's": "    return z.sum()  #!",
    "a sum of Python's": "    return sum(z)  #!",
    "a logarithm": "    return math.log(z[0])  #!",
    "a power": "    return z[0] ** z[1]  #!",
    "a literal without a type": "    return z[0] * 2.0  #!",
    "an integer among reals": "    return z[0] * k  #!",
    "a quotient of integers": "    return k / 2  #!",
    "a remainder by a variable": "    return 7 % k  #!",
    "a second name of an array": "    y = z  #!",
    "a slice with a step": "    z[::2] = z[0]  #!",
    "a slice of rows": "    A[1:] = A[0]  #!",
    "a view that changes": "    row = A[0]  #!\n    row = A[1]",
    "an index from the end": "    return z[-1]  #!",
    "a loop over elements": "    for x in z:  #!\n        pass",
    "a try": "    try:  #!\n        z[0] = z[1]\n    except IndexError:\n        pass",
    "a list": "    return [z[0]]  #!",
    "a comprehension": "    y = [x for x in z]  #!",
    "a function that is no kernel": "    return plain(z[0])  #!",
    "an array of a length that is not known": "    y = np.zeros(k, z.dtype)  #!\n    return y",
    "a variable that may have no value": "    if k > 0:\n        y = z[0]\n    return y  #!",
    "a variable of two types": "    y = z[0]\n    y = k  #!",
    "arrays of two lengths": "    y = z + np.zeros(7, z.dtype)  #!",
    "an argument that is returned": "    return z  #!",
    "a break": "    while k > 0:\n        break  #!",
    "a swap": "    x = z[0]\n    y = z[1]\n    x, y = y, x  #!",
    "a value that is read behind its assignment": "    z[0] = z[1] = z[0] + z[1]  #!",
    "a comparison with a literal that is not exact": "    while z[0] > 0.1:  #!\n        z[0] = z[1]",
    "a call behind another assignment": "    x, y = z[0], doubled(z)  #!\n    return x + y[0]",
    "a text": "    y = 'gamma'  #!",
    "a lambda": "    y = lambda: k  #!",
    "a number for truth": "    while k:  #!\n        k -= 1",
}


@pytest.mark.parametrize("body", REFUSED.values(), ids=REFUSED)
def test_a_kernel_beyond_the_subset_is_refused_with_file_and_line(tmp_path: Path, body: str) -> None:
    file = tmp_path / "bad.py"
    file.write_text(f"{HEAD}{body}\n")
    spec = importlib.util.spec_from_file_location("bad", file)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    line = next(number for number, text in enumerate(file.read_text().splitlines(), 1) if text.endswith("#!"))
    z, A = np.ones(3, np.float32), np.ones((3, 3), np.float32)
    with pytest.raises(UnfitKernelError) as refusal:
        Program().function(module.bad, tuple(map(type_of, (z, A, 3))))
    assert str(refusal.value).startswith(f"{file}:{line}: ")
    assert "\n" not in str(refusal.value)
