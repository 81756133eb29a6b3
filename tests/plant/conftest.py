import struct
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import pytest

from coldloop.modbus.requests import DeviceIdentity, RequestHandler, Written
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop.registers.bank import ALL_ROLES, Caller, RefusedAccessError
from coldloop.registers.codec import Seal, codec_of
from coldloop.registers.common import EVENT_ROWS, Event, EventKind
from coldloop.registers.declaration import Role
from coldloop.registers.plant import Actuators, Measurement
from coldloop_plant.cold_box import ColdBox, advance, evaluated
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.helium import Helium, load_helium
from coldloop_plant.kinds import plant_maker
from coldloop_plant.numeric import RealArray
from coldloop_plant.runtime import RackRegisters
from coldloop_plant.settings import PlantSettings
from tests.harness.records import PLANT_MAP, sealed

R = TypeVar("R", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Plant:
    """The nonlinear reference plant at its operating point."""

    model: LtiModel
    helium: Helium
    box: ColdBox = REFERENCE

    def rates(self, x: RealArray, u: RealArray, w: float) -> RealArray:
        return evaluated(x, u, w, self.box, self.helium)[0]

    def outputs(self, x: RealArray, u: RealArray, w: float) -> dict[str, float]:
        values = evaluated(x, u, w, self.box, self.helium)[1]
        return dict(zip(self.model.output_names, values.tolist(), strict=True))

    def simulate(self, x: RealArray, u: RealArray, w: float, seconds: float, dt: float = 0.25) -> RealArray:
        for _ in range(round(seconds / dt)):
            x = advance(x, u, w, dt, self.box, self.helium)
        return x


@pytest.fixture(scope="session")
def model_path() -> Path:
    return DEFAULT_MODEL_FILE


@pytest.fixture(scope="session")
def model(model_path: Path) -> LtiModel:
    return load(model_path)


@pytest.fixture(scope="session")
def helium() -> Helium:
    return load_helium()


@pytest.fixture(scope="session")
def plant(model: LtiModel, helium: Helium) -> Plant:
    return Plant(model, helium)


@pytest.fixture
def rest(model: LtiModel) -> tuple[RealArray, RealArray, float]:
    """State, inputs and load at the operating point, free to change."""
    return np.array(model.x0), np.array(model.u0), model.w0


# -- the rack ----------------------------------------------------------------------------------------------------------

HEADER = read_header(DEFAULT_MODEL_FILE)


class Refused(NamedTuple):
    """The exception code of a request that was refused."""

    code: int


class RackClient:
    """A client of a rack, PDU by PDU."""

    def __init__(self, rack: "RackOnTheBus", caller: Caller, number: int) -> None:
        self._rack = rack
        self.caller = caller
        self.number = number
        """Its holder number; 0 is a simple client, which neither seals nor says what it has read back."""
        self._requests = RequestHandler(rack.bank, DeviceIdentity(product="", revision=""), caller)

    def request(self, pdu: bytes) -> bytes | Refused:
        """Return the answer's data."""
        try:
            outcome = self._requests.handle(pdu)
            if not isinstance(outcome, Written):
                return outcome[2:]
            for block in outcome.blocks:
                self._rack.registers.on_write(block, self.caller)
            return outcome.answer()[2:]
        except RefusedAccessError as refusal:
            return Refused(refusal.exception_code)

    def read(self, record: type[R], row: int = 0) -> R:
        """Read a record; a sealed one is intact."""
        block = PLANT_MAP.block_of(record)
        address = block.address + row * block.row_words
        data = self.request(struct.pack(">BHH", 3, address, block.row_words))
        assert isinstance(data, bytes)
        return self._decoded(record, data)

    @staticmethod
    def _decoded(record: type[R], data: bytes) -> R:
        block = PLANT_MAP.block_of(record)
        codec = codec_of(block)
        assert not block.sealed or codec.seal_of(data) is Seal.INTACT
        return cast("R", codec.decode(data))

    def write(self, record: tuple[Any, ...], row: int = 0) -> Refused | None:
        """Write a record."""
        block = PLANT_MAP.block_of(type(record))
        data = codec_of(block).encode(record)
        head = struct.pack(">BHHB", 16, block.address + row * block.row_words, len(data) // 2, len(data))
        answer = self.request(head + data)
        return answer if isinstance(answer, Refused) else None

    def outputs(self, *u: float, **changed: int) -> Actuators:
        """Return outputs for the present tick, by default with what has been read back."""
        rack = self._rack.registers.rack
        outputs = Actuators(rack.tick, tuple(u), rack.session.number, self.number)._replace(**changed)
        return outputs if not self.number else sealed(outputs)

    def exchange(self, outputs: Actuators) -> Measurement | Refused:
        """Write outputs and read the measurement in one request; in lock-step the plant moves on after it."""
        actuators, measurement = PLANT_MAP.block_of(Actuators), PLANT_MAP.block_of(Measurement)
        data = codec_of(actuators).encode(outputs)
        head = struct.pack(
            ">BHHHHB", 23, measurement.address, measurement.row_words, actuators.address, actuators.row_words, len(data)
        )
        answer = self.request(head + data)
        self._rack.registers.move_on()
        return answer if isinstance(answer, Refused) else self._decoded(Measurement, answer)

    def send(self, *u: float, **changed: int) -> Measurement:
        """Exchange outputs, which are not refused."""
        answer = self.exchange(self.outputs(*u, **changed))
        assert isinstance(answer, Measurement), answer
        return answer

    def closes(self) -> None:
        """Close the connection."""
        self._rack.registers.closed(self.caller)


class RackOnTheBus:
    """A rack whose clocks are the test's."""

    def __init__(self, **configuration: Any) -> None:  # noqa: ANN401 - any part of the configuration
        session = {"autostart": True} | configuration.pop("session", {})
        plant = {"load": "a", "rate_limited": False, **configuration}  # most tests are about who may move the outputs
        settings = PlantSettings.model_validate({"session": session, "plant": plant})
        make_plant = plant_maker(HEADER, settings.plant)
        self.now = 1000.0
        self.registers = RackRegisters(
            settings,
            HEADER,
            make_plant,
            first_generation=1,
            age=self._age,
            now=lambda: self.now,
            utc=lambda: 1e9 + self.now,
        )
        self.bank = self.registers.bank
        self._connections = count(1)
        self._moved_at = self.now
        self.operator = self.client("operator", roles=frozenset({Role.OPERATOR}))

    def client(self, name: str, number: int = 0, roles: frozenset[Role] = ALL_ROLES) -> RackClient:
        """Return a client over a new connection."""
        return RackClient(self, Caller(name, roles, next(self._connections)), number)

    def _age(self) -> float:
        rack = self.registers.rack
        return (self.now - self._moved_at) / 0.25 if rack.session.pace.realtime and rack.moving else 0.0

    @property
    def tick(self) -> int:
        return self.registers.rack.tick

    def passes(self, ticks: int) -> None:
        """Let the plant move by the clock, without the control PLC."""
        for _ in range(ticks):
            self.now += 0.25
            self._moved_at = self.now
            self.registers.advance()

    def shown(self) -> Measurement:
        return self.operator.read(Measurement)

    def events(self, kind: EventKind) -> list[Event]:
        """Return the events of a kind, as the registers show them."""
        rows = [self.operator.read(Event, row) for row in range(EVENT_ROWS)]
        return sorted(event for event in rows if event.kind == kind)


@pytest.fixture
def switch_on() -> type[RackOnTheBus]:
    """Make racks."""
    return RackOnTheBus
