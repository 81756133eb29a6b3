"""How long programs take to start: a run of 10 s in one process, and each service from its start to its first answer.

Warm: the kernels are compiled. `--cold` measures the first start on a machine, too, in a cache of its own. Time on the
processor is that of the program and of those that it starts.
"""

import argparse
import os
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Final

from coldloop.config import PREFIX, to_environment
from coldloop_rig.cosim.wiring import HOST, SERVICES, ReservedPorts, endpoints_on, wired
from coldloop_rig.settings import Settings

READ_MAGIC: Final = bytes((0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 2))
"""Function 3: two registers from 0 on, which hold 123.456 in every map."""
PATIENCE_S: Final = 300.0
CACHE: Final = "COLDLOOP_CACHE_DIR"
LOOK_S: Final = 0.005


def answered(port: int) -> bool:
    """Return whether a server answers a request for its first registers."""
    try:
        with socket.create_connection((HOST, port), timeout=5.0) as client:
            client.sendall(READ_MAGIC)
            return len(client.recv(64)) > 9
    except OSError:
        return False


def service_start(service: str, environment: Mapping[str, str]) -> float:
    """Return the time (s) from the start of a service to its first answer."""
    settings = Settings()
    with ReservedPorts(len(SERVICES)) as ports:
        port = ports.numbers[SERVICES.index(service)]
        own = to_environment(wired(settings, endpoints_on(ports.numbers, settings)))
        start = time.perf_counter()
        with subprocess.Popen(
            [sys.executable, "-m", f"coldloop_{service}", "--with-parent"],
            env={**environment, **own}, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL,
        ) as process:  # fmt: skip
            try:
                while not answered(port):
                    if process.poll() is not None or time.perf_counter() - start > PATIENCE_S:
                        raise RuntimeError(f"{service} does not answer")
                    time.sleep(LOOK_S)
                return time.perf_counter() - start
            finally:
                process.terminate()


def short_run(environment: Mapping[str, str]) -> float:
    """Return the time (s) of a run of 10 s of plant time in one process, with its figure."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "coldloop_rig", "run", "--in-process", "--duration", "10s", "--out", folder]
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, env=environment)
        return time.perf_counter() - start


def on_processor(measure: Callable[[], float]) -> tuple[float, float]:
    """Return what is measured, and the time (s) on the processor of the programs that it has started."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    elapsed = measure()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return elapsed, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeat", type=int, default=5, help="the medians are printed")
    parser.add_argument("--cold", action="store_true", help="the first start on a machine, too: takes a minute or more")
    options = parser.parse_args()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(PREFIX)}
    cases: dict[str, Callable[[], float]] = {"run of 10 s": lambda: short_run(environment)}
    cases |= {name: lambda name=name: service_start(name, environment) for name in SERVICES}
    for name, measure in cases.items():
        if options.cold:
            with tempfile.TemporaryDirectory() as cache:
                environment[CACHE] = cache
                elapsed, busy = on_processor(measure)
            del environment[CACHE]
            print(f"{name}, cold: {elapsed:.2f} s, {busy:.2f} s on the processor", flush=True)
        measure()
        pairs = [on_processor(measure) for _ in range(options.repeat)]
        elapsed, busy = (statistics.median(each) for each in zip(*pairs, strict=True))
        print(f"{name}, warm: {elapsed:.2f} s, {busy:.2f} s on the processor", flush=True)


if __name__ == "__main__":
    main()
