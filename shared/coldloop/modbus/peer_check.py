"""Checks the identity block of a peer."""

import math

from coldloop.errors import PeerUnreachableError
from coldloop.registers.codec import WordOrder, codec_of
from coldloop.registers.common import IDENTITY_BLOCK, MAGIC, Identity
from coldloop.registers.declaration import RegisterMap


def check_peer(raw: bytes, register_map: RegisterMap, order: WordOrder, peer: str) -> None:
    """Check the bytes of a peer's identity block.

    Raises:
        PeerUnreachableError: It is something else, uses the other word order, or has another register map.
    """
    identity = _identity(raw, order)
    if not _has_magic(identity):
        other = WordOrder.LOW_FIRST if order is WordOrder.HIGH_FIRST else WordOrder.HIGH_FIRST
        if _has_magic(_identity(raw, other)):
            raise PeerUnreachableError(f"{peer} has the other word order: set it to {other} here, or {order} there")
        raise PeerUnreachableError(
            f"{peer}: another program answers there (register 0 is not {MAGIC}): check host and port"
        )
    if identity.map_digest != register_map.digest:
        raise PeerUnreachableError(
            f"{peer} has another register map (version {identity.map_version}, digest {identity.map_digest:08x}, "
            f"not version {register_map.version}, {register_map.digest:08x}): "
            "check the port, and run the same release, of the same process, on both sides"
        )


def _identity(raw: bytes, order: WordOrder) -> Identity:
    return Identity(*codec_of(IDENTITY_BLOCK, order).decode(raw))


def _has_magic(identity: Identity) -> bool:
    return math.isclose(identity.magic, MAGIC, rel_tol=1e-6)
