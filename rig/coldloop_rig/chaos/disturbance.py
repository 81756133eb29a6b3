"""Decides how each frame of a disturbed link is forwarded; no sockets."""

import random
from collections.abc import Iterable
from typing import Final, NamedTuple

from coldloop.modbus.framing import MalformedFrameError, next_frame
from coldloop_rig.chaos.faults import (
    Abort,
    Delay,
    Direction,
    Drop,
    Duplicate,
    ExceptionAnswer,
    Flip,
    FrameFault,
    Reorder,
    Truncate,
    WrongUnit,
)

Replacing = Drop | Duplicate | ExceptionAnswer | Flip | WrongUnit
UNIT: Final = 6
"""Where a frame has its unit; the function comes next."""


class FrameAction(NamedTuple):
    """How one frame is forwarded."""

    data: bytes
    """Bytes to forward, with any that were held back before."""
    delay_s: float = 0.0
    """Delay before forwarding."""
    close: bool = False
    """Whether the connection is closed afterwards."""
    reset: bool = False
    """Whether it is closed by a reset (RST)."""


class Mangler:
    """Decides about the frames of one direction of one connection.

    Args:
        direction: Requests or answers.
        seed: The same seed, frames and faults lead to the same decisions.
    """

    def __init__(self, direction: Direction, seed: str) -> None:
        self.direction = direction
        self._draw = random.Random(seed)  # noqa: S311 not for secrets
        self._held = b""
        self.hold_s: float | None = None
        """While a frame is held back: how long, unless another one comes."""

    def decide(self, frame: bytes, faults: Iterable[FrameFault]) -> FrameAction:  # noqa: C901 a branch for each kind
        """Return how a frame is forwarded under the active faults."""
        pieces, delay_s, overtaken = [frame], 0.0, self.release()
        for fault in faults:
            if fault.direction not in {Direction.BOTH, self.direction}:
                continue
            if isinstance(fault, Delay):
                delay_s += max(0.0, fault.delay_ms + fault.jitter_ms * self._draw.uniform(-1, 1)) / 1000
            elif isinstance(fault, Truncate):
                if pieces and self._hit(fault.share):
                    return FrameAction(b"".join(pieces[:-1]) + pieces[-1][: len(pieces[-1]) // 2], delay_s, close=True)
            elif isinstance(fault, Abort):
                if pieces and self._hit(fault.share):
                    return FrameAction(b"", delay_s, close=True, reset=True)
            elif isinstance(fault, Reorder):
                if pieces and not overtaken and self._hit(fault.share):
                    self._held, self.hold_s = pieces.pop(), fault.hold_ms / 1000
            elif isinstance(fault, Replacing):
                pieces = [new for piece in pieces for new in self._instead(piece, fault)]
            else:
                raise TypeError(f"no frame is disturbed by {fault.kind}: add a branch")
        return FrameAction(b"".join([*pieces, overtaken]), delay_s)

    def release(self) -> bytes:
        """Return the held frame and clear it."""
        held, self._held, self.hold_s = self._held, b"", None
        return held

    def _instead(self, piece: bytes, fault: Replacing) -> list[bytes]:
        """Return the frames that replace `piece`."""
        if not self._hit(fault.share):
            return [piece]
        if isinstance(fault, Drop):
            return []
        if isinstance(fault, Duplicate):
            return [piece, piece]
        if isinstance(fault, Flip):
            return [self._flipped(piece, fault.bits)]
        return [_with_other_words(piece, fault) if len(piece) > UNIT + 1 else piece]

    def _flipped(self, piece: bytes, bits: int) -> bytes:
        damaged = bytearray(piece)
        for bit in self._draw.sample(range(8 * len(piece)), min(bits, 8 * len(piece))):
            damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)

    def _hit(self, share: float) -> bool:
        return self._draw.random() < share


def _with_other_words(frame: bytes, fault: ExceptionAnswer | WrongUnit) -> bytes:
    unit, function = frame[UNIT], frame[UNIT + 1]
    if isinstance(fault, WrongUnit):
        return frame[:UNIT] + bytes([unit + 1 & 0xFF]) + frame[UNIT + 1 :]
    return frame[:4] + b"\x00\x03" + bytes([unit, function | 0x80, fault.code])


def take_frames(buffer: bytearray) -> list[bytes]:
    """Take all whole frames out of a buffer; what is not Modbus/TCP comes as one piece, unchanged."""
    frames, position = [], 0
    try:
        while (frame := next_frame(buffer, position)) is not None:
            frames.append(bytes(buffer[position : frame.end]))
            position = frame.end
    except MalformedFrameError:
        frames.append(bytes(buffer[position:]))
        position = len(buffer)
    del buffer[:position]
    return frames
