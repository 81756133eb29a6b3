"""Rigs for test suites: three services on localhost, their registers by name, and faults on purpose.

With pytest, the fixture `coldloop_rigs` starts them; without, `up` is a context manager:

from coldloop_rig.testing import up

with up(load="a") as rig:
    rig.advance(60)
    print(rig.plant.read("measurement.y.T5"))
"""

import asyncio
import contextlib
import tempfile
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import AsyncExitStack, contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar

from coldloop.errors import LinkError, PeerUnreachableError, UnfitValueError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.settings import Endpoint
from coldloop.registers import common, declaration, maps_of
from coldloop_rig.cosim import networked_run, session, wiring
from coldloop_rig.runs.running import check_certificates, make_scenario
from coldloop_rig.settings import Period, Settings, configured

__all__ = ["LiveRig", "NamedRegisters", "Rigs", "up"]

T = TypeVar("T")
LOOK_S: Final = 0.01
"""Interval at which the plant's tick is polled, s of real time."""


class BackgroundLoop:
    """Runs coroutines in a background thread until it is closed."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="coldloop rig", daemon=True)
        self._thread.start()

    def call(self, work: Coroutine[Any, Any, T]) -> T:
        """Return the result of `work`; a caller that is interrupted cancels it."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def close(self) -> None:
        """End the thread."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.run_until_complete(self._loop.shutdown_default_executor())
        self._loop.close()


Call = Callable[[Coroutine[Any, Any, Any]], Any]
Record = tuple[Any, ...]


class _Place(NamedTuple):
    block: declaration.Block
    field: str
    element: int | None
    """Index in an array; None is all of the field."""


class NamedRegisters:
    """A Modbus client of one service, with the roles of this machine's address or of the rig's certificate.

    A name is that of the block, a dot, and that of the register: `measurement.y.T5`, `operator.mode`. Without the
    element it is the whole array: `measurement.y`. Values have the units of the register map.

    A block with a CRC that was never sealed cannot be read (`DamagedAnswerError`): write all of it.

    All methods raise `UsageError` for a name that does not exist, `PeerUnreachableError` when the service does not
    answer, and `RequestRefusedError`, with the `exception_code`, when it refuses the request.
    """

    def __init__(
        self, register_map: declaration.RegisterMap, endpoint: Endpoint, client: RegisterClient, call: Call
    ) -> None:
        self._client = client
        self._call = call
        self._blocks = {block.name: block for block in register_map.blocks}
        self._places: dict[str, _Place] = {}
        for block in register_map.blocks:
            for name, field in block.fields.items():
                self._places[f"{block.name}.{name}"] = _Place(block, name, None)
                before = block.name if field.each else f"{block.name}.{name}"
                for index, element in enumerate(field.elements):
                    self._places[f"{before}.{element}"] = _Place(block, name, index)
        self.endpoint = endpoint
        """Endpoint of the service, for clients of your own."""
        self.latest: dict[str, Any] = {}
        """Values that were read last, by name, since `clear`."""

    def read(self, name: str, *, row: int = 0) -> Any:  # noqa: ANN401 a number, or a tuple of an array
        """Return the value of a register; `row` counts from 0 in blocks that have several."""
        place = self._place(name)
        value = getattr(self._record(place.block, row), place.field)
        self.latest[name] = value = value if place.element is None else value[place.element]
        return value

    def read_block(self, block: str, *, row: int = 0) -> Any:  # noqa: ANN401 the record of that block
        """Return all registers of a block, read in one request, as a named tuple."""
        self.latest[block] = found = self._record(self._block(block), row)
        return found

    def write(self, name: str, value: float | Record, *, row: int = 0) -> None:
        """Write a register; the others of its block are written as they were read just before."""
        place = self._place(name)
        if place.element is not None:
            values = list(getattr(self._record(place.block, row), place.field))
            values[place.element] = value
            value = tuple(values)
        self.write_block(place.block.name, row=row, **{place.field: value})

    def write_block(self, block: str, *, row: int = 0, **values: Any) -> None:  # noqa: ANN401 as the registers are
        """Write a block in one request, with its CRC if it has one; registers that are not named keep what was read."""
        where = self._block(block)
        names = [name for name in where.fields if name != "crc" or not where.sealed]
        own = [element for field in where.fields.values() if field.each for element in field.elements]
        unknown = [name for name in values if name not in (*names, *own)]
        if unknown:
            raise UsageError(f"block '{block}' has no register '{unknown[0]}'; it has {', '.join((*names, *own))}")
        for name, field in where.fields.items():  # registers of their own names are given by these, or as one array
            single = {element: values.pop(element) for element in field.elements if field.each and element in values}
            if single:
                if len(single) < len(field.elements):
                    single = dict(zip(field.elements, getattr(self._record(where, row), name), strict=True)) | single
                values[name] = tuple(single[element] for element in field.elements)
        if len(values) == len(names):
            record = where.record(**values, **({"crc": 0} if where.sealed else {}))
        else:
            record = self._record(where, row)._replace(**values)
        try:
            self._call(self._client.write_rows([record], row))
        except (UnfitValueError, TypeError) as error:
            given = ", ".join(f"{name}={value!r}" for name, value in values.items())
            reason = str(error).rpartition(": ")[2]
            raise UsageError(f"block '{block}' cannot hold {given}: {reason}") from None

    def _record(self, block: declaration.Block, row: int) -> Any:  # noqa: ANN401 the record of that block
        if not 0 <= row < block.rows:
            raise UsageError(f"block '{block.name}' has rows 0 to {block.rows - 1}, not {row}")
        return self._call(self._client.read_rows(block.record, row, 1))[0]

    def _block(self, name: str) -> declaration.Block:
        if name not in self._blocks:
            raise UsageError(f"unknown block '{name}'; choose from {', '.join(self._blocks)}")
        return self._blocks[name]

    def _place(self, name: str) -> _Place:
        if name not in self._places:
            close = get_close_matches(name, self._places, n=3)
            hint = f"did you mean {', '.join(close)}" if close else "see `coldloop registers`: BLOCK.NAME"
            raise UsageError(f"no register '{name}'; {hint}")
        return self._places[name]


class LiveRig:
    """Three services with a session under way. `up` makes one.

    A rig in lock-step moves only in `advance` and `wait_until`; one in real time moves by itself. All methods are to be
    called from one thread. What the services refuse, and a service that has ended, raise `LinkError`.
    """

    def __init__(self, settings: Settings, folder: Path) -> None:
        self.settings = settings
        """Configuration of the services, except for the ports."""
        maps, self._tick_s = maps_of(settings.process), settings.process.tick_s
        self._scenario = make_scenario(settings)
        self._folder = folder
        self._links: wiring.Links = wiring.fault_injection("links")(str(settings.plant.seed))
        retained = wiring.retaining(settings, folder, always=True)
        self._services = networked_run.LocalServices(retained, folder / "logs", links=self._links)
        self.endpoints: wiring.RigEndpoints = self._services.endpoints
        """Endpoints of the services."""
        self._loop = BackgroundLoop()
        self._stack = AsyncExitStack()
        self._driver = session.SessionClient(self.endpoints, settings)
        self._clients = {
            service: RegisterClient.at(register_map, endpoint)
            for service, register_map, endpoint in zip(wiring.SERVICES, maps, self.endpoints, strict=True)
        }
        self.plant, self.control_plc, self.optimizer_plc = (
            NamedRegisters(register_map, endpoint, self._clients[service], self._call)
            for service, register_map, endpoint in zip(wiring.SERVICES, maps, self.endpoints, strict=True)
        )
        self._injector = wiring.fault_injection("injector")(self._services, self._links, self._clients["plant"], folder)

    @property
    def time_s(self) -> float:
        """Plant time of the session, s."""
        return float(self.plant.read("identity.tick")) * self._tick_s

    def advance(self, seconds: float) -> float:
        """Let `seconds` of plant time pass (a multiple of 0.25); return the plant time at the end.

        Raises:
            LinkError: Plant time does not move for 20 s.
        """
        ticks = seconds / self._tick_s
        if not ticks > 0 or ticks != round(ticks):
            raise UsageError(f"advance({seconds}): not a positive multiple of {self._tick_s} s")

        async def advanced() -> int:
            tick = (await self._clients["plant"].read(common.Identity)).tick
            until, moved = tick + round(ticks), time.monotonic()
            while tick < until:
                if not self._scenario.realtime:
                    await self._driver.advance(tick, until)
                await asyncio.sleep(LOOK_S)
                before, tick = tick, (await self._clients["plant"].read(common.Identity)).tick
                if tick != before:
                    moved = time.monotonic()
                elif time.monotonic() - moved > max(wiring.QUIET_S, 4 * self._tick_s / self._scenario.factor):
                    raise LinkError(
                        f"the plant is at {tick * self._tick_s:g} s of plant time for {wiring.QUIET_S:g} s: "
                        f"see the logs in {self._folder / 'logs'}"
                    )
            return tick

        return float(self._call(advanced())) * self._tick_s

    def wait_until(self, condition: Callable[[], bool], within_s: float = 60.0) -> float:
        """Wait until `condition()` is true, for at most `within_s` of plant time; return the plant time then.

        The condition is looked at every 0.25 s of plant time in lock-step, and a hundred times a second in real time.
        While plant time is stopped, as without the plant, real time counts.

        Raises:
            TimeoutError: It did not become true; with what it has read last.
        """
        start, deadline = self._tick_or_none(), time.monotonic() + within_s / self._scenario.factor + wiring.QUIET_S
        while seen := self._unmet(condition):
            tick = self._tick_or_none()
            start = tick if start is None else start
            if tick is not None and start is not None and (tick - start) * self._tick_s >= within_s:
                raise TimeoutError(f"the condition was not met within {within_s:g} s of plant time: {seen}")
            if self._scenario.realtime or tick is None:
                if time.monotonic() > deadline:
                    raise TimeoutError(
                        f"the condition was not met within {within_s:g} s, and plant time does not advance: {seen}"
                    )
                time.sleep(LOOK_S)
            else:
                self.advance(self._tick_s)
        return self.time_s

    def _unmet(self, condition: Callable[[], bool]) -> str:
        """Return what a condition has read that is not met; nothing if it is."""
        services = {service: getattr(self, service) for service in wiring.SERVICES}
        for one in services.values():
            one.latest.clear()
        if condition():
            return ""
        read = (f"{service} {name} = {seen}" for service, one in services.items() for name, seen in one.latest.items())
        return ", ".join(read) or "it has read no register by name"

    def _tick_or_none(self) -> int | None:
        try:
            return int(self.plant.read("identity.tick"))
        except PeerUnreachableError:
            return None

    @contextmanager
    def fault(self, kind: str, **parameters: object) -> Iterator[None]:
        """Inject a fault during the context; at its end, wait until stopped services answer again.

        Args:
            kind: One of those of a chaos plan, such as `kill`, `pause`, `drop` or `sensor`.
            parameters: What belongs to it there, but for its times: `process="optimizer"`, `link="plant"`, ...

        Raises:
            UsageError: There is no such fault, or a parameter is missing or wrong.
        """
        fault = self._injector.prepared(kind, parameters, self.settings.model.file)
        self._call(self._injector.begin(fault))
        try:
            yield
        finally:
            service = self._call(self._injector.end(fault))
            if service is not None:
                self._call(self._clients[service].connect(wiring.START_PATIENCE_S))

    def log(self, service: str) -> Path:
        """Return the log of `plant`, `control_plc` or `optimizer_plc`: one JSON object a line."""
        if service not in wiring.SERVICES:
            raise UsageError(f"unknown service '{service}'; choose from {', '.join(wiring.SERVICES)}")
        return self._services.log(service)

    def _call(self, work: Coroutine[Any, Any, T]) -> T:
        services = self._services
        try:
            return self._loop.call(services.during(work))
        except PeerUnreachableError:
            if len(services.processes) == len(wiring.SERVICES):  # none was stopped on purpose: has one ended?
                self._loop.call(services.during(asyncio.sleep(1.0)))  # the end of its process may be known later
            raise

    async def _start(self) -> None:
        await self._stack.enter_async_context(self._services)
        await self._services.during(self._driver.connect(wiring.START_PATIENCE_S))
        await self._links.connect()
        await self._services.during(self._driver.start(self._scenario))
        if self._scenario.realtime:
            feed = self._driver.hold(0.5, lambda _: None)  # a plant that is away on purpose is looked at again
            self._stack.callback(asyncio.create_task(feed, name="load of the session").cancel)

    def _stop(self) -> None:
        async def stop() -> None:
            for client in self._clients.values():
                client.close()
            self._driver.close()
            await self._stack.aclose()

        try:
            self._loop.call(stop())
        finally:
            self._loop.close()


@contextmanager
def up(
    load: str | Path | None = None, *, mode: Literal["lockstep", "realtime"] | None = None, factor: float | None = None,
    solver: str | None = None, updating_period: Period | None = None, process: str | Path | None = None,
    seed: int | None = None, config: str | Path | None = None, folder: str | Path | None = None,
    **settings: Mapping[str, object],
) -> Iterator[LiveRig]:  # fmt: skip
    """Start plant, control PLC and optimiser PLC on free ports of localhost, and begin a session; stop them at the end.

    Example:
        with up(load="a", updating_period=2.5) as rig:
            rig.advance(15)
            print(rig.plant.read("measurement.y.T5"))

    Args:
        load: Named load such as `a`, or a CSV file with the columns time_s and load_w, whose last value is held; by
            default `2h`.
        mode: `lockstep`, the default: plant time passes only in `advance` and `wait_until`; `realtime`: by the clock.
        factor: In real time: seconds of plant time in a second; by default 1.
        solver: `ode`, `qpoases`, `osqp`, `fast-gradient`, `interior-point`, `hybrid` or `daqp`; by default `ode`.
        updating_period: Seconds, from 2 ticks to a sampling period (0.5 to 5 s); `adaptive`, the default.
        process: Process file, or a model file that was made from one; by default the cold box.
        seed: Seed of the sensors' noise, and of which frames a fault hits; by default 1.
        config: TOML file with further settings. An argument that is given comes before it.
        folder: Takes the logs; a temporary one if not given.
        settings: Sections of the configuration, such as `control_plc={"driver": "classical"}`; they come before the
            file. The environment has no influence.

    Raises:
        UsageError: An argument cannot be used.
        LinkError: A service ended, or did not answer in time.
    """
    effective = configured(
        load=load, solver=solver, updating_period=updating_period, seed=seed, config=config, sections=settings,
        process=process, mode=mode, factor=factor,
    )  # fmt: skip
    check_certificates(effective.settings)
    with contextlib.ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="coldloop-")) if folder is None else folder)
        rig = LiveRig(effective.settings, place)
        stack.callback(rig._stop)  # noqa: SLF001 the two are one
        rig._loop.call(rig._start())  # noqa: SLF001
        yield rig


class Rigs(contextlib.ExitStack):
    """The value of the fixture `coldloop_rigs`; a context at whose end all its rigs are stopped.

    Args:
        folder: Takes a folder for each rig, with the logs of its services.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._started = 0

    def up(self, **arguments: Any) -> LiveRig:  # noqa: ANN401 as `up` has them
        """Start a rig; the arguments are those of `coldloop_rig.testing.up`."""
        self._started += 1
        arguments.setdefault("folder", self._folder / f"rig{self._started}")
        return self.enter_context(up(**arguments))
