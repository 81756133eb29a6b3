"""Whether several runs in one compiled loop would be faster than one after the other.

Two ways. Abreast: all plants of a batch do a tick before any does the next, with the same bits; a processor could then
do work of one while another waits. Lanes: the same table look-ups for independent pressures, in a loop that the
compiler may turn into vector instructions, against look-ups each of which needs the one before: the most that a plant
rewritten for vectors could gain in its tables.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.process.cold_box import TICK_S
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_plant.cold_box import ColdBox, advance
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.helium import Helium, load_helium, saturation

Array = NDArray[np.float64]


@kernel
def in_turn(x: Array, u: Array, w: float, ticks: int, box: ColdBox, helium: Helium) -> None:
    """Let each plant x[k] (28,) do all its ticks before the next one."""
    for k in range(x.shape[0]):
        for _ in range(ticks):
            x[k] = advance(x[k], u, w, TICK_S, box, helium)


@kernel
def abreast(x: Array, u: Array, w: float, ticks: int, box: ColdBox, helium: Helium) -> None:
    """Let all plants do a tick before any does the next."""
    for _ in range(ticks):
        for k in range(x.shape[0]):
            x[k] = advance(x[k], u, w, TICK_S, box, helium)


@kernel
def chained(P: Array, helium: Helium) -> float:
    """Return the sum of temperatures along P (n,), where each look-up needs the one before."""
    total = 0.0
    for i in range(P.shape[0]):
        total += saturation(P[i] + 1e-300 * total, helium).T
    return total


@kernel
def independent(P: Array, helium: Helium, T: Array) -> None:
    """Write the temperatures along P (n,) into T (n,)."""
    for i in range(P.shape[0]):
        T[i] = saturation(P[i], helium).T


def microseconds(work: Callable[[], object], count: int, repeat: int) -> float:
    """Return the median time of one of `count` equal parts of a call."""
    work()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        times.append((time.perf_counter() - start) / count * 1e6)
    return statistics.median(times)


def plants_us(batch: int, ticks: int, repeat: int) -> tuple[float, float]:
    """Return the time of a plant's tick, in turn and abreast."""
    header, helium = read_header(DEFAULT_MODEL_FILE), load_helium()
    x0 = np.tile(np.array(header.x0), (batch, 1))
    u = np.array(header.u0) + np.array([1.0, 5.0, 1.0])
    ends, times = [], []
    for way in (in_turn, abreast):
        x = x0.copy()
        way(x, u, header.w0, ticks, REFERENCE, helium)
        ends.append(x)
        times.append(microseconds(
            lambda way=way: way(x0.copy(), u, header.w0, ticks, REFERENCE, helium), batch * ticks, repeat
        ))  # fmt: skip
    if not np.array_equal(*ends):
        raise RuntimeError("in turn and abreast end in different states")
    return times[0], times[1]


def look_ups_us(count: int, repeat: int) -> tuple[float, float]:
    """Return the time of a look-up, chained and independent."""
    helium, P = load_helium(), np.linspace(1.0e5, 1.8e5, count)
    T = np.empty_like(P)
    return (
        microseconds(lambda: chained(P, helium), count, repeat),
        microseconds(lambda: independent(P, helium, T), count, repeat),
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ticks", type=int, default=2000, help="of each plant")
    parser.add_argument("--look-ups", type=int, default=100_000)
    parser.add_argument("--repeat", type=int, default=5, help="the medians are printed")
    options = parser.parse_args()
    for batch in (2, 4, 8):
        turn, side = plants_us(batch, options.ticks, options.repeat)
        print(f"{batch} plants: a tick takes {turn:.1f} us in turn and {side:.1f} us abreast: ratio {side / turn:.2f}")
    chain, free = look_ups_us(options.look_ups, options.repeat)
    print(f"a look-up takes {1e3 * chain:.1f} ns chained and {1e3 * free:.1f} ns independent: ratio {free / chain:.2f}")


if __name__ == "__main__":
    main()
