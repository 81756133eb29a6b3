"""A TCP proxy between the client and the server of one link, which does to the link what a plan says."""

import asyncio
import contextlib
import random
import socket
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, NamedTuple

from coldloop.errors import UsageError
from coldloop.modbus.requests import MalformedFrameError, next_frame
from coldloop.modbus.settings import Endpoint
from coldloop_chaos import faults
from coldloop_chaos.faults import LinkPlan
from coldloop_rig.cosim.wiring import Detours, ReservedPorts, RigEndpoints

UNIT: Final = 6  # place of the unit in a frame; the function code is the next byte


class FrameAction(NamedTuple):
    """Forwarding of one frame: its bytes and delay."""

    data: bytes
    """Bytes to forward, with any that were held back before."""
    delay_s: float = 0.0
    """Delay before forwarding."""
    close: bool = False
    """Whether the connection is closed afterwards."""
    reset: bool = False
    """Whether it is closed by a reset (RST)."""


class Mangler:
    """Decides about the frames of one direction of one connection: seed, frames and faults determine it."""

    def __init__(self, direction: faults.Direction, seed: str) -> None:
        self.direction = direction
        self._draw = random.Random(seed)  # noqa: S311 not for secrets
        self._held = b""
        self.hold_s: float | None = None
        """While a frame is held back: how long, unless another one comes."""

    def decide(self, frame: bytes, active: Iterable[faults.FrameFault]) -> FrameAction:
        """Return how a frame is forwarded under the active faults."""
        pieces, delay_s, overtaken = [frame], 0.0, self.release()
        for fault in active:
            if fault.direction not in {faults.Direction.BOTH, self.direction}:
                continue
            if isinstance(fault, faults.Delay):
                delay_s += max(0.0, fault.delay_ms + fault.jitter_ms * self._draw.uniform(-1, 1)) / 1000
            elif isinstance(fault, faults.Reorder):
                if pieces and not overtaken and self._hit(fault.share):
                    self._held, self.hold_s = pieces.pop(), fault.hold_ms / 1000
            elif not isinstance(fault, faults.ShareFault):
                raise TypeError(f"no frame is disturbed by {fault.kind}: add a branch")
            elif fault.kind in ("abort", "truncate"):
                if pieces and self._hit(fault.share):
                    half = b"".join(pieces[:-1]) + pieces[-1][: len(pieces[-1]) // 2]
                    is_abort = fault.kind == "abort"
                    return FrameAction(b"" if is_abort else half, delay_s, close=True, reset=is_abort)
            else:
                pieces = [new for piece in pieces for new in self._instead(piece, fault)]
        return FrameAction(b"".join([*pieces, overtaken]), delay_s)

    def release(self) -> bytes:
        """Return the held frame and clear it."""
        held, self._held, self.hold_s = self._held, b"", None
        return held

    def _instead(self, piece: bytes, fault: faults.ShareFault) -> list[bytes]:
        """Return the frames that replace `piece`."""
        if not self._hit(fault.share):
            return [piece]
        if isinstance(fault, faults.FrameLoss):
            return [] if fault.kind == "drop" else [piece, piece]
        if isinstance(fault, faults.Flip):
            damaged, bits = bytearray(piece), 8 * len(piece)
            for bit in self._draw.sample(range(bits), min(fault.bits, bits)):
                damaged[bit // 8] ^= 1 << bit % 8
            return [bytes(damaged)]
        if len(piece) <= UNIT + 1:
            return [piece]
        unit, function = piece[UNIT], piece[UNIT + 1]
        if isinstance(fault, faults.ExceptionAnswer):
            return [piece[:4] + b"\x00\x03" + bytes([unit, function | 0x80, fault.code])]
        return [piece[:UNIT] + bytes([unit + 1 & 0xFF]) + piece[UNIT + 1 :]]

    def _hit(self, share: float) -> bool:
        return self._draw.random() < share


def take_frames(buffer: bytearray) -> list[bytes]:
    """Take all whole frames out of a buffer; bytes that are not Modbus/TCP come as one piece, unchanged."""
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


HOST: Final = "127.0.0.1"
CHUNK: Final = 4096
MOST_FROZEN: Final = 64
"""Connections that are kept while nothing passes: those who try again and again would take up all files."""
HALF_CLOSED_S: Final = 60.0  # longest time that one direction may stay open alone, s
_LINGER_NOT: Final = struct.pack("ii", 1, 0)


class LinkProxy:
    """Passes Modbus/TCP frames on, one by one, under the faults that are on.

    Args:
        port: Where to listen; 0 takes any free port.
        target: The server.
        seed: Decides, with the number of the connection, how each frame is forwarded.
        host: The address of this machine to listen at.
        tell: Called with a line for each connection that the server did not accept.

    A frame is not read before the previous one has been forwarded, so nothing piles up here: what waits, waits in the
    buffers of TCP.
    """

    def __init__(
        self, port: int, target: Endpoint, seed: str, *, host: str = HOST, tell: Callable[[str], object] | None = None
    ) -> None:
        self.port = port
        self._target, self._host, self._tell, self._seed, self._number = target, host, tell, seed, 0
        self._faults: list[faults.LinkFault] = []
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._open: set[asyncio.StreamWriter] = set()
        self._serving: dict[asyncio.Task[None], None] = {}
        """Tasks that serve the connections, the oldest one first."""
        self._listener: asyncio.Server | None = None

    async def start(self) -> None:
        """Listen."""
        self._listener = await asyncio.start_server(self._serve, self._host, self.port)
        self.port = self._listener.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Stop listening and drop all connections."""
        if self._listener is not None:
            self._listener.close()
        await asyncio.sleep(0)  # a connection that was accepted just now gets its task
        for task in self._serving:
            task.cancel()
        await asyncio.gather(*self._serving, return_exceptions=True)
        await asyncio.sleep(0)  # aborted connections close their sockets in the next turn of the loop

    def begin(self, fault: faults.LinkFault) -> None:
        """Disturb the link."""
        self._faults.append(fault)
        if fault.kind == "freeze":
            self._flowing.clear()
        elif fault.kind == "reset":
            for writer in tuple(self._open):
                reset(writer)

    def end(self, fault: faults.LinkFault) -> None:
        """Stop disturbing it."""
        self._faults.remove(fault)
        if not any(other.kind == "freeze" for other in self._faults):
            self._flowing.set()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            self._serving[task] = None
            task.add_done_callback(self._serving.pop)
            if not self._flowing.is_set():
                for one in list(self._serving)[:-MOST_FROZEN]:
                    one.cancel()
        ends = [writer]
        try:
            if any(fault.kind == "reset" for fault in self._faults):
                reset(writer)
                return
            far_reader, far_writer = await asyncio.open_connection(self._target.host, self._target.port)
            ends.append(far_writer)
            self._open.update(ends)
            await self._pass_both_ways((reader, writer), (far_reader, far_writer))
        except OSError as error:
            reset(writer)  # no server behind the proxy: refuse, as if none listened here
            if self._tell is not None:
                self._tell(f"{self._target.host}:{self._target.port}: {error.strerror or error}")
        except asyncio.CancelledError:  # the proxy is being closed: what is not sent yet is not waited for
            for end in ends:
                end.transport.abort()
        finally:
            for end in ends:
                self._open.discard(end)
                end.close()

    async def _pass_both_ways(
        self,
        near: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        far: tuple[asyncio.StreamReader, asyncio.StreamWriter],
    ) -> None:
        """Pass frames on until both ends are closed, or one is broken; what one end still says, the other is sent."""
        self._number += 1
        seed = f"{self._seed}/{self._number}"
        pumps = [
            asyncio.create_task(self._pump(near[0], far[1], Mangler(faults.Direction.REQUESTS, f"{seed}/requests"))),
            asyncio.create_task(self._pump(far[0], near[1], Mangler(faults.Direction.ANSWERS, f"{seed}/answers"))),
        ]
        try:
            ended, left = await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            if left and all(pump.result() for pump in ended):
                await asyncio.wait(left, timeout=HALF_CLOSED_S)
        finally:
            for pump in pumps:
                pump.cancel()
            await asyncio.gather(*pumps, return_exceptions=True)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, mangler: Mangler) -> bool:
        """Pass one direction on until it ends; return whether its end was passed on, too."""
        buffer = bytearray()
        with contextlib.suppress(OSError):
            while True:
                try:
                    async with asyncio.timeout(mangler.hold_s):
                        data = await reader.read(CHUNK)
                except TimeoutError:
                    if mangler.hold_s is None:  # the network's own: the connection has gone
                        return False
                    writer.write(mangler.release())
                    continue
                await self._flowing.wait()
                if not data:
                    writer.write(mangler.release())
                    writer.write_eof()
                    return True
                buffer += data
                for frame in take_frames(buffer):
                    if not await self._pass(frame, writer, mangler):
                        return False
        return False

    async def _pass(self, frame: bytes, writer: asyncio.StreamWriter, mangler: Mangler) -> bool:
        """Forward a frame as decided; return whether the connection stays open."""
        outcome = mangler.decide(frame, [fault for fault in self._faults if isinstance(fault, faults.FrameFault)])
        if outcome.delay_s > 0:
            await asyncio.sleep(outcome.delay_s)
        await self._flowing.wait()
        if outcome.reset:
            reset(writer)
            return False
        writer.write(outcome.data)
        await writer.drain()
        return not outcome.close


def reset(writer: asyncio.StreamWriter) -> None:
    """Close with RST: nothing is sent any more, and the peer knows at once."""
    connection = writer.get_extra_info("socket")
    if connection is not None and not writer.is_closing():
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_NOT)
    writer.transport.abort()


async def disturb(plan: LinkPlan, listen: tuple[str, int], target: Endpoint, say: Callable[[str], object]) -> None:
    """Pass frames on to a server, under the faults of a plan, until it is cancelled.

    `say` is called with lines: where the proxy listens, faults that begin and end, refused connections. Raises
    UsageError: it cannot listen at the address and port `listen`.
    """
    host, port = listen
    loop = asyncio.get_running_loop()
    proxy = LinkProxy(port, target, str(plan.seed), host=host, tell=say)
    try:
        await proxy.start()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UsageError(f"--listen {host}:{port}: {reason}; name an address and a free port of this machine") from None
    try:
        say(f"{host}:{proxy.port} -> {target.host}:{target.port}")
        began = loop.time()
        for at_s, begins, fault in plan.changes():
            await asyncio.sleep(began + at_s - loop.time())
            (proxy.begin if begins else proxy.end)(fault)
            say(f"{at_s:9.1f} s  {'begin' if begins else 'end'} {fault.in_words}")
        await loop.create_future()
    finally:
        await proxy.close()


class LinkProxies:
    """A proxy in each of the two links, on ports of their own. The seed decides which frames are hit."""

    def __init__(self, seed: str) -> None:
        self._seed = seed
        self._reserved = ReservedPorts(len(Detours._fields))
        self.detours = Detours(*self._reserved.numbers)
        self.by_link: Mapping[faults.Link, LinkProxy] = {}

    def put_before(self, ends: RigEndpoints) -> None:
        """Make them, for these servers."""
        self.by_link = {
            faults.Link.PLANT: LinkProxy(self.detours.plant, ends.plant, f"{self._seed}/plant"),
            faults.Link.OPTIMIZER: LinkProxy(self.detours.control_plc, ends.control_plc, f"{self._seed}/optimizer"),
        }

    async def connect(self) -> None:
        """Start them: until then no client reaches a server."""
        for proxy in self.by_link.values():
            await proxy.start()

    async def close(self) -> None:
        """Close them."""
        for proxy in self.by_link.values():
            await proxy.close()
        self._reserved.release()

    @contextlib.contextmanager
    def cut(self, link: str) -> Iterator[None]:
        """Let nothing pass in a link in this context; its connections stay open."""
        proxy = self.by_link[faults.Link(link)]
        fault = faults.LinkCut(kind="freeze", link=faults.Link(link), duration_s=1.0)
        proxy.begin(fault)
        try:
            yield
        finally:
            proxy.end(fault)
