"""A TCP proxy between the client and the server of one link, which does to the link what a plan says."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Callable
from typing import Final

from coldloop.modbus.endpoints import Endpoint
from coldloop_rig.chaos.disturbance import Mangler, take_frames
from coldloop_rig.chaos.faults import Direction, FrameFault, Freeze, LinkFault, Reset

HOST: Final = "127.0.0.1"
CHUNK: Final = 4096
MOST_FROZEN: Final = 64
"""Connections that are kept while nothing passes: those who try again and again would take up all files."""
HALF_CLOSED_S: Final = 60.0
"""How long one direction may stay open alone."""
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
        self._target = target
        self._host = host
        self._tell = tell
        self._seed = seed
        self._faults: list[LinkFault] = []
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._number = 0
        self._open: set[asyncio.StreamWriter] = set()
        self._serving: dict[asyncio.Task[None], None] = {}
        """What serves each connection, the oldest one first."""
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

    def begin(self, fault: LinkFault) -> None:
        """Disturb the link."""
        self._faults.append(fault)
        if isinstance(fault, Freeze):
            self._flowing.clear()
        elif isinstance(fault, Reset):
            for writer in tuple(self._open):
                reset(writer)

    def end(self, fault: LinkFault) -> None:
        """Stop disturbing it."""
        self._faults.remove(fault)
        if not any(isinstance(other, Freeze) for other in self._faults):
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
            if any(isinstance(fault, Reset) for fault in self._faults):
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
            asyncio.create_task(self._pump(near[0], far[1], Mangler(Direction.REQUESTS, f"{seed}/requests"))),
            asyncio.create_task(self._pump(far[0], near[1], Mangler(Direction.ANSWERS, f"{seed}/answers"))),
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
        outcome = mangler.decide(frame, [fault for fault in self._faults if isinstance(fault, FrameFault)])
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
