"""Arrow arrays by their buffers are those that pyarrow makes itself, and come back as they were."""

import numpy as np
import pyarrow as pa
import pytest

from coldloop_rig.results.columns import number_array, numbers_of, text_array


@pytest.mark.parametrize("kind", [pa.int64(), pa.int32(), pa.float32(), pa.float64()])
def test_numbers_with_gaps_are_what_pyarrow_makes_of_them(kind: pa.DataType) -> None:
    values, unknown = np.arange(19.0), np.arange(19) % 5 == 2
    array = number_array(values, kind, unknown)
    array.validate(full=True)
    assert array.equals(pa.array(values.tolist(), mask=unknown).cast(kind))
    assert number_array(values, kind).equals(pa.array(values.tolist()).cast(kind))


@pytest.mark.parametrize("kind", [pa.int64(), pa.float32()])
def test_numbers_come_back_also_from_the_middle_of_an_array(kind: pa.DataType) -> None:
    values, unknown = np.arange(40.0), np.arange(40) % 7 == 3
    expected = np.where(unknown, np.nan, values)
    array = number_array(values, kind, unknown)
    np.testing.assert_array_equal(numbers_of(array), expected)
    np.testing.assert_array_equal(numbers_of(array.slice(11, 20)), expected[11:31])
    np.testing.assert_array_equal(numbers_of(number_array(values, kind).slice(3)), values[3:])
    assert not len(numbers_of(array.slice(0, 0)))


def test_texts_are_what_pyarrow_makes_of_them() -> None:
    texts = ["mpc", None, "", "höchste", "mpc"]
    array = text_array(texts)
    array.validate(full=True)
    assert array.equals(pa.array(texts, type=pa.string()))
    assert text_array([]).equals(pa.array([], type=pa.string()))


def test_texts_chosen_in_runs_are_repeated() -> None:
    places = np.repeat([1, 0, 2, 1], [3, 4, 1, 2])
    texts = ["hold", "mpc", None]
    array = text_array(texts, places)
    array.validate(full=True)
    assert array.to_pylist() == [texts[place] for place in places]
