"""Arrow arrays from and to numbers, by their buffers: pyarrow's own conversions import pandas wherever it is installed.

That takes longer than a short run does.
"""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray


def number_array(values: ArrayLike, kind: pa.DataType, unknown: NDArray[np.bool_] | None = None) -> pa.Array:
    """Return N numbers as an array of a numeric type; null where they are unknown."""
    data = np.ascontiguousarray(values, kind.to_pandas_dtype())
    validity = None if unknown is None else pa.py_buffer(np.packbits(~unknown, bitorder="little"))
    return pa.Array.from_buffers(kind, len(data), [validity, pa.py_buffer(data)])


def text_array(texts: Sequence[str | None], places: NDArray[np.int64] | None = None) -> pa.Array:
    """Return texts as an array; null where there is none.

    Args:
        texts: All texts that there are.
        places: For each row which of them it has, in long runs; by default each is a row.
    """
    chosen = np.arange(len(texts)) if places is None else places
    raw = [(text or "").encode() for text in texts]
    offsets = np.zeros(len(chosen) + 1, np.int32)
    np.cumsum(np.array([len(text) for text in raw], int)[chosen], out=offsets[1:])
    starts = np.flatnonzero(np.diff(chosen, prepend=-1))
    lengths = np.diff(starts, append=len(chosen))
    data = b"".join([raw[chosen[start]] * length for start, length in zip(starts, lengths, strict=True)])
    known = np.array([text is not None for text in texts], bool)[chosen]
    buffers = [pa.py_buffer(part) for part in (np.packbits(known, bitorder="little"), offsets, data)]
    return pa.Array.from_buffers(pa.string(), len(chosen), buffers)


def numbers_of(column: pa.Array) -> NDArray[np.float64]:
    """Return a numeric column as numbers; what is null is NaN."""
    validity, data = column.buffers()
    rows = slice(column.offset, column.offset + len(column))
    values = np.frombuffer(data, column.type.to_pandas_dtype())[rows].astype(float)
    if column.null_count:
        known = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")[rows]
        values[known == 0] = np.nan
    return values
