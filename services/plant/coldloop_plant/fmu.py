"""A plant that is an FMU, a model of another tool for co-simulation by FMI 2.0 or 3.0, as FMPy loads and calls it.

Its variables are connected to the signals; it is at rest when a session begins.
"""

import base64
import logging
import math
import re
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from coldloop.errors import ColdloopError, ModelFileError, foreign
from coldloop.process.declaration import Process
from coldloop_plant import numeric, own_plants

log = logging.getLogger("coldloop.plant")

NUMBERS: Final = ("Real", "Float", "Integer", "Int", "UInt", "Boolean", "Enumeration")
"""Beginnings of the types of variables that are numbers here."""
CONTINUOUS: Final = ("Real", "Float")
DOUBLE: Final = ("Real", "Float64")  # what derivatives can be asked for
MOST_UNPACKED: Final = 512 * 1024 * 1024  # bytes
ELEMENT: Final = re.compile(r"(.+)\[(\d+(?:,\s*\d+)*)\]")
ERROR: Final = 3  # Status of FMI from which on a message says what is wrong


class Port(NamedTuple):
    """A number that an FMU shows: a variable, or an element of an array of FMI 3.0."""

    reference: int
    type: str  # Type of the functions that set and get it
    place: int = 0
    size: int = 1  # Elements of the array, which are set and read together

    @property
    def is_discrete(self) -> bool:
        """Whether values are rounded to whole numbers, or to false and true."""
        return not self.type.startswith(CONTINUOUS)

    def typed(self, value: float) -> float:
        """Return a value as the FMU takes it: the nearest whole number; true from one half on."""
        if not self.is_discrete:
            return value
        return value >= 0.5 if self.type == "Boolean" else math.floor(value + 0.5)


class Fmu:
    """The file, unpacked for as long as this object lives; its instances do not know of one another.

    Raises:
        ModelFileError: It cannot be read, or not be run here.
    """

    def __init__(self, path: Path) -> None:
        try:
            import fmpy  # noqa: PLC0415 an extra: plants of other kinds do without it
        except ImportError:
            raise ModelFileError(f"{path}: an FMU needs FMPy: pip install 'coldloop[fmu]'") from None
        self.path = path
        if not path.is_file():
            raise ModelFileError(f"{path}: no such file; plant.fmu names an FMU beside the process file")
        self.folder = self._unpacked(MOST_UNPACKED)
        self.findings: tuple[str, ...] = ()
        """Violations of the standard in its description that do not keep it from being run."""
        with foreign(f"{path}: not a readable FMU", "get it anew from the tool that made it"):
            try:
                self.description = fmpy.read_model_description(self.folder)
            except Exception as error:  # noqa: BLE001 tools do not keep to the standard, and their FMUs run
                self.findings = tuple(" ".join(str(one).split()) for one in getattr(error, "problems", [error]))
                self.description = fmpy.read_model_description(self.folder, validate=False)
            platforms = fmpy.supported_platforms(self.folder)
        self.variables = {each.name: each for each in self.description.modelVariables}
        slave, version = self.description.coSimulation, str(self.description.fmiVersion)
        if not version.startswith(("2.0", "3.0")):
            raise ModelFileError(f"{path}: is of FMI {version}; get one of FMI 2.0 or 3.0 from the tool that made it")
        if slave is None:
            raise ModelFileError(f"{path}: has no co-simulation; get one with it from the tool that made it")
        if fmpy.platform not in platforms:
            others = ", ".join(platforms) or "none"
            raise ModelFileError(
                f"{path}: has no library for {fmpy.platform}, but for {others}; get it made for this platform"
            )
        self.keeps_state = bool(slave.canGetAndSetFMUstate and slave.canSerializeFMUstate)
        """Whether a state of it can be saved, and be returned to."""
        self.has_derivatives = bool(slave.providesDirectionalDerivative)
        self.is_single = bool(slave.canBeInstantiatedOnlyOncePerProcess)
        """Whether a new instance ends the one before it."""
        self.end_former: Callable[[], object] | None = None  # Ends the instance that a new one takes the place of

    def _unpacked(self, most: int) -> str:
        """Return a folder with the members of the archive; zipfile gives no more of one than its directory says."""
        folder = tempfile.gettempdir()
        with foreign(f"{self.path}: not a readable FMU", "get it anew from where it comes from"):
            try:
                folder = tempfile.mkdtemp(prefix="coldloop-fmu-")
                weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
                with zipfile.ZipFile(self.path) as archive:
                    if sum(one.file_size for one in archive.infolist()) > most:
                        raise ModelFileError(f"{self.path}: unpacks to more than {most >> 20} MiB; get a smaller one")
                    archive.extractall(folder)
            except OSError as error:
                raise ModelFileError(
                    f"{self.path}: cannot be unpacked into {folder}: {error.strerror or error}; free space there, or "
                    "set TMPDIR to another folder"
                ) from error
        return folder

    def port(self, name: str) -> Port:
        """Return the number of this name; elements of an array, as `x[1]` or `x[2,1]`, count from 1, row by row.

        Raises:
            ModelFileError: There is none, or it is no number.
        """
        element = None if name in self.variables else ELEMENT.fullmatch(name)
        variable = self.variables.get(element[1] if element else name)
        if variable is None or (element and not variable.dimensions):
            some = ", ".join(each.name for each in self.variables.values() if each.causality in ("input", "output"))
            raise ModelFileError(f"{self.path}: has no variable {name}; inputs and outputs are {some}"[:400])
        if not variable.type.startswith(NUMBERS):
            raise ModelFileError(f"{self.path}: {name} is no number")
        shape = tuple(variable.shape) if variable.dimensions else ()
        index = [int(one) - 1 for one in element[2].split(",")] if element else [0] * len(shape)
        if (
            len(index) != len(shape)
            or (not element and math.prod(shape) > 1)
            or not all(0 <= i < size for i, size in zip(index, shape, strict=True))
        ):
            raise ModelFileError(
                f"{self.path}: {name} is no single number: elements are "
                f"{variable.name}[{','.join('1' for _ in shape)}] to {variable.name}[{','.join(map(str, shape))}]"
            )
        place = int(np.ravel_multi_index(index, shape)) if shape else 0
        kind = variable.type.replace("Enumeration", "Integer" if self.is_fmi2 else "Int64")
        return Port(int(variable.valueReference), kind, place, math.prod(shape))

    @property
    def is_fmi2(self) -> bool:
        """Whether it is of FMI 2.0."""
        return str(self.description.fmiVersion) == "2.0"


@dataclass(frozen=True)
class Wiring:
    """Variables of an FMU that are signals, and how it is run; what a model file says of it."""

    inputs: Sequence[str]
    outputs: Sequence[str]
    load: str | None
    disturbances: Sequence[str]  # Others than the load
    states: Sequence[str]  # Variables that are its states, if it shows them
    start: Mapping[str, float]  # Start values of variables
    steps_per_tick: int
    rest_ticks: int = 0  # Ticks from its start until it rests at the operating point


class FmuSimulation:
    """An instance at time 0, initialised with the wiring's start values, and with its signals connected.

    All of it raises `ColdloopError` where the FMU fails; making it `ModelFileError`.
    """

    def __init__(self, fmu: Fmu, wiring: Wiring, tick_s: float) -> None:
        from fmpy.simulation import instantiate_fmu  # noqa: PLC0415

        names = [*wiring.inputs, *([wiring.load] if wiring.load else []), *wiring.disturbances]
        self.inputs = [fmu.port(name) for name in names]
        self.outputs = [fmu.port(name) for name in wiring.outputs]
        self.states = [fmu.port(name) for name in wiring.states]
        self._fmu = fmu
        self._wiring = wiring
        self._step_s = tick_s / wiring.steps_per_tick
        self._steps = 0
        self._said = said = list[str]()
        if fmu.end_former is not None:
            fmu.end_former()

        def note(*arguments: Any) -> None:  # noqa: ANN401 of FMI 2: component, name, status, category, text; of 3: ...
            if arguments[-3] >= ERROR and arguments[-1]:
                said[:] = [arguments[-1].decode(errors="replace")]

        with foreign(f"{fmu.path}: cannot be started", said=said):
            self._slave = instantiate_fmu(fmu.folder, fmu.description, "CoSimulation", logger=note, debug_logging=True)
            self._end = weakref.finalize(self, self._slave.freeInstance)
            self._set([fmu.port(name) for name in wiring.start], list(wiring.start.values()))
            if fmu.is_fmi2:
                self._slave.setupExperiment(startTime=0.0)
            self._slave.enterInitializationMode()
            self._slave.exitInitializationMode()
        if fmu.is_single:
            fmu.end_former = self._end

    @contextmanager
    def _calling(self, what: str) -> Iterator[None]:
        if not self._end.alive:
            raise ColdloopError(f"{self._fmu.path}: allows one instance at a time, and another has taken its place")
        self._said.clear()
        with foreign(f"{self._fmu.path}: {what}", said=self._said):
            yield

    def put(self, u: numeric.RealArray, w: numeric.RealArray) -> None:
        """Set inputs, load (which may be none) and other disturbances, to the nearest value that each can have."""
        with self._calling("does not take its inputs"):
            self._set(self.inputs, [*u.tolist(), *w[0 if self._wiring.load else 1 :].tolist()])

    def _set(self, ports: Sequence[Port], values: Sequence[float]) -> None:
        wholes: dict[str, dict[int, list[float]]] = {}
        for port, value in zip(ports, values, strict=True):
            alike = wholes.setdefault(port.type, {})
            if port.reference not in alike:
                alike[port.reference] = [0.0] if port.size == 1 else self._get(port.type, {port.reference: port.size})
            alike[port.reference][port.place] = port.typed(value)
        for kind, alike in wholes.items():
            getattr(self._slave, f"set{kind}")(list(alike), [value for whole in alike.values() for value in whole])

    def read(self, ports: Sequence[Port]) -> numeric.RealArray:
        """Return variables."""
        found = np.empty(len(ports))
        with self._calling("does not give its variables"):
            for kind in dict.fromkeys(port.type for port in ports):
                alike = {port.reference: port.size for port in ports if port.type == kind}
                flat = self._get(kind, alike)
                first = dict(zip(alike, accumulate(alike.values(), initial=0), strict=False))
                for i, port in enumerate(ports):
                    if port.type == kind:
                        found[i] = flat[first[port.reference] + port.place]
        return found

    def _get(self, kind: str, counts: Mapping[int, int]) -> list[float]:
        sizes = () if self._fmu.is_fmi2 else (sum(counts.values()),)
        return list(getattr(self._slave, f"get{kind}")(list(counts), *sizes))

    def tick(self) -> None:
        """Go one tick forward.

        Raises:
            ColdloopError: The FMU does not.
        """
        for _ in range(self._wiring.steps_per_tick):
            time_s = self._steps * self._step_s
            with self._calling(f"stopped at {time_s:g} s"):
                answer = self._slave.doStep(time_s, self._step_s)
            if answer and answer[1]:
                raise ColdloopError(f"{self._fmu.path}: has ended its simulation at {time_s:g} s")
            self._steps += 1

    def rest(self, u: numeric.RealArray, w: numeric.RealArray) -> None:
        """Go to rest with inputs and disturbances, for as many ticks as that was found to take."""
        self.put(u, w)
        for _ in range(self._wiring.rest_ticks):
            self.tick()

    def derivatives(self, of: Sequence[Port]) -> numeric.RealArray:
        """Return partial derivatives by states, inputs, load and k other disturbances, shape (of, n + m + 1 + k)."""
        unknown = [port.reference for port in of]
        by = [*self.states, *self.inputs]
        with self._calling("directional derivatives fail"):
            columns = [self._slave.getDirectionalDerivative(unknown, [one.reference], [1.0]) for one in by]
            found = np.array(columns, dtype=np.float64).T
        no_load = len(self.states) + len(self._wiring.inputs)
        return found if self._wiring.load else np.insert(found, no_load, 0.0, axis=1)

    def saved(self) -> dict[str, Any]:
        """Return the state as plain data."""
        with self._calling("cannot save its state"):
            held = self._slave.getFMUState()
            content: bytes = self._slave.serializeFMUState(held)
            self._slave.freeFMUState(held)
        return {"steps": self._steps, "state": base64.b64encode(content).decode()}

    def return_to(self, saved: Mapping[str, Any]) -> None:
        """Return to a state that `saved` returned."""
        with self._calling("cannot return to a state"):
            held = self._slave.deserializeFMUState(base64.b64decode(saved["state"]))
            self._slave.setFMUState(held)
            self._slave.freeFMUState(held)
        self._steps = int(saved["steps"])


class FmuPlant(own_plants.DisturbedPlant):
    """An FMU as the plant, at rest at its operating point at tick 0; whether it can return to a state is known."""

    def __init__(
        self, simulation: FmuSimulation, *, keeps_state: bool, process: Process,
        disturbances: own_plants.Disturbances = own_plants.NO_DISTURBANCES, **arguments: Any,  # noqa: ANN401 of the base
    ) -> None:  # fmt: skip
        self._simulation = simulation
        self._keeps_state = keeps_state
        self._hidden = np.zeros(len(process.states) - len(disturbances.courses))
        x0 = np.append(self._shown(), disturbances.at(0))
        super().__init__(disturbances=disturbances, x0=x0.tolist(), process=process, **arguments)

    def _shown(self) -> numeric.RealArray:
        """Return the states; zeros where the FMU hides them."""
        states = self._simulation.read(self._simulation.states)
        return states if len(states) else self._hidden

    def _warm_up(self) -> None:
        """Do nothing: a tick would move it."""

    def _own_outputs(self, w: numeric.RealArray) -> numeric.RealArray:
        self._simulation.put(self._u, w)
        return self._simulation.read(self._simulation.outputs)

    def _own_step(self, w: numeric.RealArray) -> tuple[numeric.RealArray, numeric.RealArray]:
        self._simulation.put(self._u, w)
        self._simulation.tick()
        return self._shown(), self._simulation.read(self._simulation.outputs)

    def _saved(self) -> dict[str, Any] | None:
        return self._simulation.saved() if self._keeps_state else None

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        if saved is None or not self._keeps_state:
            raise ValueError("the FMU cannot return to a state")
        try:
            self._simulation.return_to(saved)
        except ModelFileError as error:
            raise ValueError(str(error)) from error


def fmu_maker(
    fmu: Fmu, wiring: Wiring, u0: Sequence[float], w0: Sequence[float], tick_s: float
) -> Callable[[], FmuSimulation]:
    """Return what makes the FMU at rest at its operating point; the way there is simulated once where it keeps states.

    Raises:
        ColdloopError: It does not get there.
    """
    first = FmuSimulation(fmu, wiring, tick_s)
    first.rest(np.array(u0), np.array(w0))
    at_rest = first.saved() if fmu.keeps_state else None
    if at_rest is None:
        log.info("the FMU cannot save its state: after a restart of this service no session is resumed")

    def make() -> FmuSimulation:
        made = FmuSimulation(fmu, wiring, tick_s)
        if at_rest is None:
            made.rest(np.array(u0), np.array(w0))
        else:
            made.return_to(at_rest)
        return made

    return make
