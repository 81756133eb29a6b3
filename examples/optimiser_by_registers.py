"""An optimiser that takes the place of Coldloop's: a Modbus client of the control PLC, with pymodbus and nothing else.

    coldloop up --without optimizer --factor 5 --load a      # in another terminal
    python optimiser_by_registers.py

Two PI laws with a fixed updating period of 5 s: T5 by the turbine valve CV156, the level L1 by the heater NCR22_A, and
CV155 stays where it is. Put your own controller in the place of `PiLaws`. `docs/your-optimiser.md` says what the
control PLC asks; addresses are those of `docs/registers.md`.
"""

import argparse
import math
import secrets
import struct
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple, Self

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

TICK_S = 0.25
PERIOD_TICKS = 20
"""The updating period: 5 s of plant time."""
ROWS = 40
"""Rows of a sequence, one per tick: two periods, the second in case that the next sequence is late."""
ROWS_WITH_HEADER = 18
"""Rows that fit into one request (120 registers) with the header before them."""
MOST_ROWS = 20
"""Rows in a request without it: 120 registers of at most 123."""

LOW, HIGH = (20.0, 0.0, 20.0), (60.0, 150.0, 60.0)
"""Bounds of CV155 (%), NCR22_A (W), CV156 (%): `limits.low` and `limits.high` of the control PLC."""
RATE = (0.5, 10.0, 0.1)
"""Largest change in 5 s: `limits.rate`."""
L1, T5 = 0, 6
"""Places of the outputs in an update."""

IDENTITY, AWAIT_UPDATE, UPDATE, PLAN = 0, 400, 200, 408
ACKNOWLEDGEMENT, HEARTBEAT, HEADER, SEQUENCE = 420, 430, 488, 500
UPDATE_WORDS, ACKNOWLEDGEMENT_WORDS = 124, 5
MAGIC = 123.456
ACCEPTED = 1
BEGIN_AGAIN = (2, 3)
"""Verdicts late and wrong update."""

Rows = list[tuple[float, ...]]
"""A sequence: CV155 (%), NCR22_A (W), CV156 (%) for each tick."""


class FailedError(Exception):
    """The control PLC is not there, refuses, or does not answer as its register map says."""


class Update(NamedTuple):
    """What the control PLC has latched at an updating instant."""

    session: int
    number: int
    tick: int
    playing: int
    """Number of the sequence being played; the next one is higher."""
    load: float
    u: tuple[float, ...]
    """Inputs applied from this tick on."""
    y: tuple[float, ...]
    """Measured outputs; not a number where a measurement is bad."""
    x: tuple[float, ...]
    """States at this tick; simulated, so a real plant would not show them."""


class ControlPlc:
    """The control PLC, by its registers.

    A block is described by one letter per value as in `struct`: H is a uint16 (one register), I a uint32 and f a
    float32 (two registers).

    Args:
        host: Its address.
        port: Its port.
        model: First 32 bits of the digest of the model file that is predicted by; without, what the control PLC has.
    """

    def __init__(self, host: str, port: int, model: int | None = None) -> None:
        # a request that waits for an update is answered within 1 s; nothing is sent twice without our knowledge
        self._client = ModbusTcpClient(host, port=port, timeout=5.0, retries=0)
        self._low_first = False
        self.holder = 1 + secrets.randbelow(0xFFFFFFFF)
        self._own_model = model
        self.model = 0

    def __enter__(self) -> Self:
        """Connect; find out the word order by the first value, which is the same in every register map."""
        if not self._client.connect():  # type: ignore[no-untyped-call]
            raise FailedError("no connection: is `coldloop up --without optimizer` running?")
        words = self._ask(self._client.read_holding_registers(IDENTITY, count=8))
        self._low_first = False
        self._low_first = round(self._values("f", words[:2])[0], 3) != MAGIC
        magic, _, _, _, model = self._values("fIHHI", words)
        if round(magic, 3) != MAGIC:
            raise FailedError(f"the first value is {magic}, not {MAGIC}: not a control PLC, or another address base")
        self.model = model if self._own_model is None else self._own_model
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()  # type: ignore[no-untyped-call]

    # -- registers and values --------------------------------------------------------------------------------------

    def _ordered(self, letters: str, words: list[int]) -> list[int]:
        """Return registers with the high word of each 32-bit value first, or, the other way round, as they are sent."""
        if not self._low_first:
            return words
        place, ordered = 0, []
        for letter in letters:
            size = struct.calcsize(f">{letter}") // 2
            ordered += words[place : place + size][::-1]
            place += size
        return ordered

    def _words(self, letters: str, *values: float) -> list[int]:
        """Return values as registers."""
        raw = struct.pack(f">{letters}", *values)
        return self._ordered(letters, list(struct.unpack(f">{len(raw) // 2}H", raw)))

    def _values(self, letters: str, words: list[int]) -> tuple[Any, ...]:
        return struct.unpack(f">{letters}", self._bytes(letters, words))

    def _bytes(self, letters: str, words: list[int]) -> bytes:
        return struct.pack(f">{len(words)}H", *self._ordered(letters, words))

    def _sealed(self, letters: str, *values: float) -> list[int]:
        """Return a block that ends with a CRC-32."""
        return self._words(f"{letters}I", *values, crc_of(struct.pack(f">{letters}", *values)))

    def _opened(self, letters: str, words: list[int]) -> tuple[Any, ...]:
        """Return the values of such a block."""
        raw = self._bytes(f"{letters}I", words)
        *values, crc = struct.unpack(f">{letters}I", raw)
        if crc != crc_of(raw[:-4]):
            raise FailedError("a block arrived damaged: its CRC is wrong")
        return tuple(values)

    @staticmethod
    def _ask(answer: ModbusPDU) -> list[int]:
        """Return the registers of an answer."""
        if answer.isError():
            why = {3: "a value it does not accept", 6: "another optimiser has the lease"}.get(answer.exception_code)
            raise FailedError(f"refused with exception {answer.exception_code:02}: {why or 'see docs/link.md'}")
        return list(answer.registers)

    def _exchange(self, written: int, words: list[int], read: int, count: int) -> list[int]:
        """Write and read in one request (function 23): what is read is of after the write."""
        exchange = self._client.readwrite_registers
        return self._ask(exchange(read_address=read, read_count=count, write_address=written, values=words))

    # -- the contract ----------------------------------------------------------------------------------------------

    def beat(self) -> None:
        """Say who we are and which model we know: takes the lease of the optimiser's registers."""
        self._ask(self._client.write_registers(HEARTBEAT, self._sealed("HII", 0, self.model, self.holder)))

    def await_update(self, session: int, number: int) -> Update:
        """Wait up to 1 s for an update, or for a fresh one with session 0; return the newest, new or not.

        Its session is 0 where there is none.
        """
        asked = self._sealed("II", session, number)
        words = self._exchange(AWAIT_UPDATE, asked, UPDATE, UPDATE_WORDS)
        session, number, tick, playing, load, *rest = self._opened("IIII" + "f" * 57, words)
        # the rest: inputs until this tick, inputs from it on, the 22 outputs, the simulated states
        return Update(session, number, tick, playing, load, tuple(rest[3:6]), tuple(rest[6:28]), tuple(rest[28:]))

    def plan(self, update: Update) -> None:
        """Say when the next updating instant is; no load step cuts it short, no shortage, no reading is suspect."""
        sealed = self._sealed("IIffI", update.number, update.tick + PERIOD_TICKS, 0.0, 0.0, 0)
        self._ask(self._client.write_registers(PLAN, sealed))

    def send(self, update: Update, rows: Rows) -> int:
        """Send the sequence that answers an update, from its next updating instant on; return the verdict."""
        number = update.playing + 1
        header = (number, update.number, update.tick + PERIOD_TICKS, len(rows), PERIOD_TICKS, self.model)
        # of header and rows, also with the high word first; here 0 is a CRC like any other
        crc = zlib.crc32(struct.pack(">IIIHHI", *header))
        crc = zlib.crc32(b"".join(struct.pack(">3f", *row) for row in rows), crc)
        for first in range(ROWS_WITH_HEADER, len(rows), MOST_ROWS):
            part = [word for row in rows[first : first + MOST_ROWS] for word in self._words("fff", *row)]
            self._ask(self._client.write_registers(SEQUENCE + 6 * first, part))
        words = self._words("IIIHHII", *header, crc)
        words += [word for row in rows[:ROWS_WITH_HEADER] for word in self._words("fff", *row)]
        answer = self._exchange(HEADER, words, ACKNOWLEDGEMENT, ACKNOWLEDGEMENT_WORDS)
        acknowledged, verdict = self._opened("IH", answer)
        if acknowledged != number:
            raise FailedError(f"sequence {acknowledged} was acknowledged after sequence {number}")
        return int(verdict)


def crc_of(raw: bytes) -> int:
    """Return the CRC of a block, from its values with the high word first; 0 would be none, so it is 1 then."""
    return zlib.crc32(raw) or 1


def allowed(before: tuple[float, ...], wanted: Iterable[float]) -> tuple[float, ...]:
    """Return the inputs that are closest to the wanted ones, within bounds and by no more than a rate from `before`."""
    nearest = []
    for u, target, low, high, rate in zip(before, wanted, LOW, HIGH, RATE, strict=True):
        nearest.append(min(max(u + min(max(target - u, -rate), rate), low), high))
    return tuple(nearest)


class PiLaw:
    """du = K (e - e_before + T / T_i e) about the input that is really applied, so that nothing winds up."""

    def __init__(self, gain: float, integral_time_s: float, setpoint: float) -> None:
        self._gain, self._share, self._setpoint = gain, PERIOD_TICKS * TICK_S / integral_time_s, setpoint
        self._before: float | None = None

    def change(self, measured: float) -> float:
        """Return the wanted change of the input; none without a measurement."""
        if not math.isfinite(measured):
            self._before = None
            return 0.0
        error = self._setpoint - measured
        before, self._before = self._before, error
        return self._gain * (error - (error if before is None else before) + self._share * error)


class PiLaws:
    """A controller: L1 by NCR22_A, T5 by CV156. CV155 stays where it is."""

    def __init__(self) -> None:
        self._level = PiLaw(gain=-100.0, integral_time_s=300.0, setpoint=60.0)
        self._temperature = PiLaw(gain=-5.0, integral_time_s=240.0, setpoint=10.4)

    def __call__(self, update: Update) -> Rows:
        """Return the inputs from the next updating instant on.

        Until then the sequence being played goes on, which is constant. So they count from the inputs applied now.
        """
        changes = (0.0, self._level.change(update.y[L1]), self._temperature.change(update.y[T5]))
        wanted = (u + change for u, change in zip(update.u, changes, strict=True))
        return [allowed(update.u, wanted)] * ROWS


def answered(plc: ControlPlc, law: Callable[[Update], Rows]) -> Iterator[tuple[Update, int]]:
    """Answer one update after the other; yield each with the verdict on its sequence."""
    plc.beat()
    session = number = 0  # a fresh update, whatever the session
    while True:
        update = plc.await_update(session, number)
        if not update.session:
            continue  # nothing is latched: no session, or an operator drives
        if update.session == session and update.number < number:  # none has come within 1 s
            if update.number + 1 < number:  # the session has begun again, and counts from 0
                session = number = 0
            continue
        plc.plan(update)  # at once: the control PLC waits for nothing else
        verdict = plc.send(update, law(update))
        yield update, verdict
        # after a plan or a sequence that came too late the next update could be late, too: a fresh one is not
        session, number = (0, 0) if verdict in BEGIN_AGAIN else (update.session, update.number + 1)


def optimise(plc: ControlPlc, law: Callable[[Update], Rows], where: str) -> None:
    """Optimise for ever; a control PLC that is absent or lost is looked for."""
    told = ""
    while True:
        try:
            with plc:
                for update, verdict in answered(plc, law):
                    told = ""
                    outcome = "accepted" if verdict == ACCEPTED else f"rejected, verdict {verdict}"
                    print(
                        f"{update.tick * TICK_S:9.2f} s  update {update.number}  load {update.load:5.1f} W  "
                        f"L1 {update.y[L1]:6.3f} %  T5 {update.y[T5]:6.3f} K  {outcome}",
                        flush=True,
                    )
        except (FailedError, ModbusException) as error:
            if str(error) != told:
                told = str(error)
                print(f"{where}: {told}; tried again every second", file=sys.stderr, flush=True)
            time.sleep(1.0)


def option_parser(description: str) -> argparse.ArgumentParser:
    """Return the options of an optimiser: where the control PLC is."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5021, help="of the control PLC (default: 5021)")
    return parser


def main() -> None:
    """Optimise until Ctrl-C."""
    options = option_parser("An optimiser for Coldloop's control PLC, by registers alone.").parse_args()
    with suppress(KeyboardInterrupt):
        optimise(ControlPlc(options.host, options.port), PiLaws(), f"{options.host}:{options.port}")


if __name__ == "__main__":
    main()
