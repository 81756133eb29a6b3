"""Digests of code by what it reaches: the functions, classes and data that it names, recursively.

Kernels, gains and outcomes of studies are kept under such digests (`coldloop.kernels.compiled`,
`coldloop_rig.studies.request`).
A digest is the same in every process and wherever the files are; it changes with whatever may change what the code
does, and not with docstrings, comments or code that is not reached. `coldloop.kernels.description` says what counts.

Each object is described once per process: what the names of a module mean must not change after its import.
"""

import hashlib
import threading
from collections.abc import Iterator
from typing import Any, Final

from coldloop.kernels.data import Plain
from coldloop.kernels.description import Describer, Reference
from coldloop.kernels.implementations import registrations

Key = tuple[int, bool]


class _Node:
    """An object that counts, and its place in Tarjan's search for those that refer to each other."""

    def __init__(self, reference: Reference, number: int) -> None:
        describer = Describer(compiled=reference.compiled)
        description = describer.describe(reference.holder)
        self.holder = reference.holder
        self.content = _hash(description)
        self.references = describer.references
        self.finished = describer.finished
        self.waiting = iter(self.references)
        self.number = self.lowest = number
        self.digest: bytes | None = None


class _State:
    """Of the nodes that there are.

    Attributes:
        finished: None of them refers to a module that is being imported.
        registered: So many implementations were there when they were described.
    """

    def __init__(self) -> None:
        self.finished = True
        self.registered = 0


_nodes: Final[dict[Key, _Node]] = {}
_state: Final = _State()
_lock: Final = threading.RLock()


def digest(*roots: Any, compiled: bool = False) -> str:  # noqa: ANN401 functions, kernels, classes, data
    """Return a digest of functions, classes and data, and of all that they reach; a path counts as the file's content.

    Args:
        roots: What the digest is of.
        compiled: They are used by compiled code, for which a class is the layout of its data.
    """
    with _lock:
        description, nodes = _described(roots, compiled=compiled)
        return _hash((description, [node.digest for node in nodes])).hex()[:24]


def reached(*roots: Any) -> list[Any]:  # noqa: ANN401
    """Return the functions, classes and instances that the digest of `roots` is of."""
    with _lock:
        _, waiting = _described(roots, compiled=False)
        found: dict[int, _Node] = {}
        while waiting:
            node = waiting.pop()
            if node.number not in found:
                found[node.number] = node
                waiting += map(_settle, node.references)
    return [node.holder for node in found.values()]


def _described(roots: Any, *, compiled: bool) -> tuple[Plain, list[_Node]]:  # noqa: ANN401
    """Return the description of roots and the nodes that it refers to.

    To describe some functions is to import what they import, which may register implementations of others that have
    been described: these are then described again.
    """
    while True:
        if _state.registered != registrations() or not _state.finished:
            _nodes.clear()
            _state.finished, _state.registered = True, registrations()
        describer = Describer(compiled=compiled)
        description = describer.value(roots)
        nodes = [_settle(each) for each in describer.references]
        if _state.registered == registrations():
            return description, nodes


def _key(reference: Reference) -> Key:
    return id(reference.holder), reference.compiled


def _hash(plain: Plain) -> bytes:
    return hashlib.sha256(repr(plain).encode()).digest()


def _settle(root: Reference) -> _Node:
    """Return the node of an object, with its digest."""
    known = _nodes.get(_key(root))
    if known is not None:
        return known
    path, group = [_added(root)], list[_Node]()
    group.append(path[0])
    while path:
        node = path[-1]
        for reference in node.waiting:
            other = _nodes.get(_key(reference))
            if other is None:
                other = _added(reference)
                path.append(other)
                group.append(other)
                break
            if other.digest is None:
                node.lowest = min(node.lowest, other.number)
        else:
            path.pop()
            if path:
                path[-1].lowest = min(path[-1].lowest, node.lowest)
            if node.lowest == node.number:
                start = group.index(node)
                _close(group[start:])
                del group[start:]
    return _nodes[_key(root)]


def _added(reference: Reference) -> _Node:
    node = _nodes[_key(reference)] = _Node(reference, len(_nodes))
    _state.finished = _state.finished and node.finished
    return node


def _close(group: list[_Node]) -> None:
    """Give digests to objects that refer to each other, directly or through others; all others have theirs."""
    contents = {id(node): node.content for node in group}
    for _ in range(2 if len(group) > 1 else 1):
        contents = {id(node): _hash((node.content, list(_parts(node, contents)))) for node in group}
    whole = sorted(contents.values()) if len(group) > 1 else []
    for node in group:
        node.digest = _hash((contents[id(node)], whole))


def _parts(node: _Node, contents: dict[int, bytes]) -> Iterator[bytes]:
    for reference in node.references:
        other = _nodes[_key(reference)]
        yield other.digest or contents[id(other)]
