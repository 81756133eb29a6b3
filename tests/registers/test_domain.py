"""What a register cannot have is found where a record is decoded."""

import math

import pytest

from coldloop.process.declaration import LAST_NUMBER, LAST_TICK
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop.registers.codec import DomainError, check_record, codec_of
from coldloop.registers.common import Alarm
from coldloop.registers.control_plc import LatchedUpdate, Status, Update
from coldloop.registers.plant import MAX_AGE, Measurement
from tests.harness.records import CONTROL_MAP, PLANT_MAP, map_of

HEADER = read_header(DEFAULT_MODEL_FILE)
MEASURED = Measurement(7, HEADER.w0, HEADER.y0, HEADER.x0, 3, HEADER.u0, 5, 1, 1, 0, 0.5)
UPDATE = Update(3, 1, 7, 1, HEADER.w0, HEADER.u0, HEADER.u0, HEADER.y0, HEADER.x0)


def decoded(record: Measurement | Update) -> tuple[object, ...]:
    """Return a record after its way over the bus."""
    codec = codec_of((PLANT_MAP if isinstance(record, Measurement) else CONTROL_MAP).block_of(type(record)))
    return codec.decode_checked(codec.encode(record))


@pytest.mark.parametrize("age", [math.nan, math.inf, -math.inf, -1e9, -0.001, 2 * MAX_AGE, 3.4e38])
def test_an_age_that_cannot_be_is_no_answer(age: float) -> None:
    with pytest.raises(DomainError, match="age"):
        decoded(MEASURED._replace(age=age))


@pytest.mark.parametrize(
    "record",
    [
        MEASURED._replace(tick=LAST_TICK + 1),
        MEASURED._replace(u=(43.0, math.nan, 36.0)),
        MEASURED._replace(u=(43.0, -1.0, 36.0)),
        MEASURED._replace(generation=0),
        MEASURED._replace(verdict=9),
        UPDATE._replace(update=LAST_NUMBER + 1),
        UPDATE._replace(playing=0xFFFF_FFFF),
        UPDATE._replace(load=math.inf),
        UPDATE._replace(x=(3.4e38, *HEADER.x0[1:])),
        UPDATE._replace(u_before=(43.0, 75.0, math.nan)),
        UPDATE._replace(y=(*HEADER.y0[:-1], -3.4e38)),
    ],
)
def test_other_values_that_cannot_be_are_no_answer_either(record: Measurement | Update) -> None:
    with pytest.raises(DomainError):
        decoded(record)


def test_sensors_that_show_no_number_are_for_the_program_to_judge() -> None:
    broken = (math.nan, *HEADER.y0[1:])
    for record in (MEASURED._replace(y=broken, load=math.nan), UPDATE._replace(y=broken)):
        answer = decoded(record)
        assert isinstance(answer, type(record))
        assert math.isnan(answer.y[0])


def test_registers_that_nobody_has_written_are_read() -> None:
    codec = codec_of(PLANT_MAP.block_of(Measurement))
    assert codec.decode_checked(bytes(codec.size))[0] == 0


@pytest.mark.parametrize("record", [Alarm(state=9), Alarm(times=-1), Alarm(raised=2**32), LatchedUpdate(1, 2**32)])
def test_a_record_of_a_file_is_checked_as_one_of_the_bus(record: tuple[int, ...]) -> None:
    with pytest.raises(DomainError):
        check_record(record, map_of(type(record)))


def test_the_numbers_of_an_enumeration_end_with_it() -> None:
    codec = codec_of(CONTROL_MAP.block_of(Status))
    with pytest.raises(DomainError, match="mode = 5 is above 4"):
        codec.decode_checked(codec.encode(Status(5, 0, 0, 0, 0, 0, 0, 0, 0, 0.0, 0.0)))
