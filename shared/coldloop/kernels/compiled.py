"""Numerical kernels, compiled once and cached.

Kernels are compiled without fast-math and without contraction of multiply-add, loops run in the order they are
written: the same inputs give the same bits in every process and on every processor.

A compiled kernel is a file in the cache (`coldloop.kernels.cache`) under a digest of all that decides its code:
the kernel, the kernels and the data that it reaches (`coldloop.kernels.reach`), the types of its arguments, the
versions of numba, LLVM, numpy and Python, and the processor. So an edit compiles the kernels that reach what was edited
and no others, and checkouts of the same sources share their kernels. What takes long to compute is kept there, too
(`kept`).

Processes that need the same kernel at once compile it once: one does, the others wait for it (`KernelCache`).
"""

import contextlib
import hashlib
import io
import pickle
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, ParamSpec, TypeVar, cast

import llvmlite  # type: ignore[import-untyped]
import numba
import numpy as np
from numba.core import compiler, sigutils, types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaWarning
from numba.core.serialize import dumps
from numpy.typing import NDArray

from coldloop.kernels.cache import CacheFolder, find_cache_folder, needs_compiling
from coldloop.kernels.reach import digest, label

P = ParamSpec("P")
R = TypeVar("R")
VERSIONS: Final = (numba.__version__, llvmlite.__version__, np.__version__, sys.implementation.cache_tag)
LONGEST_NAME: Final = 120
"""Characters of a kernel's name that the name of its file has."""
cache_folder = CacheFolder(find_cache_folder())
"""Folder of this process's kernels."""


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` in nopython mode on its first call for given types, or load it from the cache."""
    return cast("Callable[P, R]", _cached(function))


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` as `kernel` does, and copy its code into each kernel that calls it.

    For small functions in inner loops: a call that passes tables costs more than reading them. The bits are the same.
    """
    return cast("Callable[P, R]", _cached(function, forceinline=True))


LARGE: Final = 100
"""Parts of arguments from which on their wrapper takes longer to compile than a second form of the kernel."""


def _cached(function: Callable[..., Any], **options: bool) -> Any:  # noqa: ANN401 numba has no types
    """Return a kernel, with a second form for calls from kernels by arguments of many parts.

    The first form has a wrapper for calls from Python, which takes the arguments apart. Where these are tables of
    hundreds of parts it takes long to compile, and nobody calls most of them.
    """
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return function
    njit = cast("Any", numba.njit)
    from_python, from_kernels = (
        _in_turn(njit(error_model="numpy", no_cfunc_wrapper=True, no_cpython_wrapper=bare, **options)(function))
        for bare in (False, True)
    )
    usual_template, usual_overload = from_python.get_call_template, from_python.get_overload

    def get_call_template(arguments: Any, named: Any) -> Any:  # noqa: ANN401
        large = _count((*arguments, *named.values())) > LARGE
        return (from_kernels.get_call_template if large else usual_template)(arguments, named)

    def get_overload(signature: Any) -> Any:  # noqa: ANN401
        arguments, _ = sigutils.normalize_signature(signature)  # type: ignore[no-untyped-call]
        return (from_kernels.get_overload if _count(arguments) > LARGE else usual_overload)(signature)

    from_python.get_call_template, from_python.get_overload = get_call_template, get_overload
    from_python.for_kernels = from_kernels
    return from_python


def _count(kinds: Iterable[Any]) -> int:
    """Return of how many parts arguments of these types are."""
    count = 0
    for kind in kinds:
        count += _count(kind.types) if isinstance(kind, types.BaseTuple) else 1  # type: ignore[attr-defined]
    return count


def python_of(value: object) -> Callable[..., Any] | None:
    """Return the Python function that a kernel is compiled from; None of what is no kernel."""
    return value.py_func if isinstance(value, Dispatcher) else None


def _in_turn(dispatcher: Any) -> Any:  # noqa: ANN401
    """Return a form of a kernel with its cache; processes compile it in turn."""
    cache = KernelCache(dispatcher)
    compile_kernel = dispatcher.compile

    def compile_in_turn(signature: Any) -> Any:  # noqa: ANN401
        try:
            return compile_kernel(signature)
        finally:
            cache.unlock(signature)

    dispatcher._cache = cache  # noqa: SLF001 as numba's enable_caching does
    dispatcher.compile = compile_in_turn
    return dispatcher


class KernelCache:
    """The cache of one kernel, as numba calls one: a file for each signature, locked until it is saved.

    Without the lock two processes compile the same kernel. Locks are taken from callers to what they call, so no two
    processes wait for each other.
    """

    def __init__(self, dispatcher: Any) -> None:  # noqa: ANN401
        self._dispatcher = dispatcher
        self._names: dict[Any, str] = {}
        self._locked: set[Any] = set()

    @property
    def cache_path(self) -> str:
        """Folder of the files."""
        return str(cache_folder.path)

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        """Return the kernel for a signature; None, with the lock, when this process is to compile it."""
        target_context.refresh()
        found = self._load(sig, target_context)
        if found is None:
            cache_folder.lock(self.file_name(sig, target_context.codegen()))
            self._locked.add(sig)
            found = self._load(sig, target_context)  # another process may have compiled it meanwhile
            if found is None:
                needs_compiling()
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        content = cache_folder.read(self.file_name(sig, target_context.codegen()))
        if content is None:
            return None
        with contextlib.suppress(Exception):  # whatever is wrong with it: it is compiled anew
            parts = pickle.loads(content)  # noqa: S301 a folder of our own
            return compiler.CompileResult._rebuild(target_context, *parts)  # type: ignore[no-untyped-call] # noqa: SLF001
        return None

    def save_overload(self, sig: Any, data: Any) -> None:  # noqa: ANN401
        """Save a kernel that has been compiled for a signature."""
        if data.lifted or data.library.has_dynamic_globals:
            name = label(self._dispatcher.py_func)
            warnings.warn(
                f"{name} cannot be cached: it uses pointers or large global arrays", NumbaWarning, stacklevel=2
            )
            return
        cache_folder.write(self.file_name(sig, data.codegen), dumps(data._reduce()))  # type: ignore[no-untyped-call] # noqa: SLF001

    def file_name(self, sig: Any, codegen: Any) -> str:  # noqa: ANN401
        """Return the name of the file for a signature; the module has been imported when this is called."""
        name = self._names.get(sig)
        if name is None:
            arguments, returned = sigutils.normalize_signature(sig)  # type: ignore[no-untyped-call]
            parts = dict.fromkeys(each for kind in arguments for each in _parts(kind))
            decided_by = (
                digest(self._dispatcher), [_text(each) for each in (*arguments, returned)],
                digest(*parts, compiled=True),  # with what they reach
                VERSIONS, codegen.magic_tuple(), numba.config.OPT, numba.config.BOUNDSCHECK,  # type: ignore[attr-defined]
            )  # fmt: skip
            plain = label(self._dispatcher.py_func).replace("<", "").replace(">", "")[:LONGEST_NAME]
            name = self._names[sig] = f"{plain}-{hashlib.sha256(repr(decided_by).encode()).hexdigest()[:24]}.nbc"
        return name

    def unlock(self, sig: Any) -> None:  # noqa: ANN401
        """Let others compile."""
        if sig in self._locked:
            self._locked.discard(sig)
            cache_folder.unlock(self._names[sig])

    def flush(self) -> None:
        """Do nothing: no file is out of date."""


def is_compiled(kernel: Callable[..., Any], *arguments: Any) -> bool:  # noqa: ANN401
    """Return whether a kernel can be called with arguments like these without being compiled first."""
    of_numba: Any = kernel
    signature = tuple(map(numba.typeof, arguments))
    if signature in of_numba.overloads:
        return True
    codegen = of_numba.targetctx.codegen()
    return cache_folder.has(of_numba._cache.file_name(signature, codegen))  # noqa: SLF001


def entry_of(kernel: Callable[P, R], *arguments: Any) -> Callable[P, R]:  # noqa: ANN401
    """Return the compiled code of a kernel for arguments of these types: the caller passes no others.

    It saves what numba takes to recognise them, 30 to 80 us a call for records of many arrays.
    """
    of_numba: Any = kernel
    if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        return kernel
    return cast("Callable[P, R]", of_numba.compile(tuple(map(numba.typeof, arguments))))


def _text(kind: Any) -> str:  # noqa: ANN401 a type of numba
    """Return a type as text that is the same in every process."""
    if isinstance(kind, types.Dispatcher):
        return f"kernel {label(kind.dispatcher.py_func)}"
    if isinstance(kind, types.BaseTuple):
        name = label(kind.instance_class) if isinstance(kind, types.BaseNamedTuple) else "tuple"  # type: ignore[attr-defined]
        return f"{name}({', '.join(map(_text, kind.types))})"  # type: ignore[attr-defined]
    return str(kind)


def _parts(kind: Any) -> Iterator[Any]:  # noqa: ANN401
    """Yield the classes and kernels in the type of an argument."""
    if isinstance(kind, types.Dispatcher):
        yield kind.dispatcher
    elif hasattr(kind, "instance_class"):  # of a named tuple, or of a member of an enumeration
        yield kind.instance_class
    if isinstance(kind, types.BaseTuple):
        for each in kind.types:  # type: ignore[attr-defined]
            yield from _parts(each)


def kept(name: str, compute: Callable[..., NDArray[np.float64]], *arguments: Any) -> NDArray[np.float64]:  # noqa: ANN401
    """Return what `compute` returns for arguments, from the cache where it is there and whole.

    It is kept under a digest of the arguments' values and of what `compute` reaches.
    """
    file = f"{name}-{hashlib.sha256(repr((digest(compute, *arguments), VERSIONS)).encode()).hexdigest()[:24]}.npy"
    content = cache_folder.read(file)
    with contextlib.suppress(ValueError, EOFError):
        if content is not None:
            return cast("NDArray[np.float64]", np.load(io.BytesIO(content)))
    found, whole = compute(*arguments), io.BytesIO()
    np.save(whole, found)
    cache_folder.write(file, whole.getvalue())
    return found
