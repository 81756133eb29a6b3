"""FMUs: models of other tools, for co-simulation by FMI 2.0 or 3.0, as FMPy loads and calls them."""

import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from coldloop.errors import ColdloopError, ModelFileError
from plant.numeric import RealArray

REALS: Final = ("Real", "Float64")
ERROR: Final = 3
"""Status of FMI from which on a message says what is wrong."""


class Fmu:
    """The file, unpacked for as long as this object lives; its instances do not know of one another.

    Args:
        path: The FMU.

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
        try:
            self.description = fmpy.read_model_description(str(path))
            platforms = fmpy.supported_platforms(str(path))
        except Exception as error:
            raise ModelFileError(f"{path}: not a readable FMU: {error}") from error
        self.variables = {each.name: each for each in self.description.modelVariables}
        slave = self.description.coSimulation
        self._check(slave, platforms, fmpy.platform)
        self.keeps_state = bool(slave.canGetAndSetFMUstate and slave.canSerializeFMUstate)
        """Whether a state of it can be saved, and be returned to."""
        self.has_derivatives = bool(slave.providesDirectionalDerivative)
        self._folder = tempfile.mkdtemp(prefix="coldloop-fmu-")
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        fmpy.extract(str(path), self._folder)

    def _check(self, slave: Any, platforms: Sequence[str], here: str) -> None:  # noqa: ANN401 FMPy has no types
        where, version = self.path, str(self.description.fmiVersion)
        if not version.startswith(("2.0", "3.0")):
            raise ModelFileError(f"{where}: is of FMI {version}; get one of FMI 2.0 or 3.0 from the tool that made it")
        if slave is None:
            raise ModelFileError(f"{where}: has no co-simulation; get one with it from the tool that made it")
        if here not in platforms:
            others = ", ".join(platforms) or "none"
            raise ModelFileError(f"{where}: has no library for {here}, but for {others}; get it made for this platform")
        if slave.canBeInstantiatedOnlyOncePerProcess:
            raise ModelFileError(
                f"{where}: allows one instance in a process only; a plant is made anew for each session"
            )

    def instance(self, start: Mapping[str, float]) -> "FmuInstance":
        """Return an instance at time 0, initialised with start values by name of variable.

        Raises:
            ModelFileError: It cannot be.
        """
        return FmuInstance(self, self._folder, start)

    def reference(self, name: str) -> int:
        """Return the value reference of a real variable.

        Raises:
            ModelFileError: There is none of this name, it is no single real number.
        """
        variable = self.variables.get(name)
        if variable is None:
            some = ", ".join(each.name for each in self.variables.values() if each.causality in ("input", "output"))
            raise ModelFileError(f"{self.path}: has no variable {name}; inputs and outputs are {some}"[:400])
        if variable.type not in REALS or variable.dimensions:
            raise ModelFileError(f"{self.path}: {name} is no single real number")
        return int(variable.valueReference)


class FmuInstance:
    """A running instance of an FMU; made by `Fmu.instance`.

    Raises:
        ModelFileError: It cannot be made or initialised.
    """

    def __init__(self, fmu: Fmu, folder: str, start: Mapping[str, float]) -> None:
        from fmpy.simulation import instantiate_fmu  # noqa: PLC0415

        self._fmu = fmu
        self._said = said = list[str]()

        def note(*arguments: Any) -> None:  # noqa: ANN401 of FMI 2: component, name, status, category, text; of 3: ...
            if arguments[-3] >= ERROR and arguments[-1]:
                said[:] = [arguments[-1].decode(errors="replace")]

        try:
            self._slave = instantiate_fmu(folder, fmu.description, "CoSimulation", logger=note, debug_logging=True)
            weakref.finalize(self, self._slave.freeInstance)
            self._initialise(start)
        except Exception as error:
            raise ModelFileError(f"{fmu.path}: cannot be started: {' '.join(said) or error}") from error

    def _initialise(self, start: Mapping[str, float]) -> None:
        for name, value in start.items():
            variable = self._fmu.variables[name]
            kind = variable.type
            typed = (
                float(value) if kind.startswith(("Real", "Float")) else bool(value) if kind == "Boolean" else int(value)
            )
            getattr(self._slave, f"set{kind}")([variable.valueReference], [typed])
        if self._is_fmi2:
            self._slave.setupExperiment(startTime=0.0)
        self._slave.enterInitializationMode()
        self._slave.exitInitializationMode()

    @property
    def _is_fmi2(self) -> bool:
        return str(self._fmu.description.fmiVersion) == "2.0"

    def put(self, references: Sequence[int], values: Sequence[float]) -> None:
        """Set real variables."""
        if references:
            (self._slave.setReal if self._is_fmi2 else self._slave.setFloat64)(references, values)

    def read(self, references: Sequence[int]) -> RealArray:
        """Return real variables."""
        if not references:
            return np.zeros(0)
        return np.array(
            (self._slave.getReal if self._is_fmi2 else self._slave.getFloat64)(references), dtype=np.float64
        )

    def step(self, time_s: float, length_s: float) -> None:
        """Do a step from a time.

        Raises:
            ColdloopError: The FMU does not.
        """
        try:
            answer = self._slave.doStep(time_s, length_s)
        except Exception as error:
            raise ColdloopError(
                f"{self._fmu.path}: stopped at {time_s:g} s: {' '.join(self._said) or error}"
            ) from error
        if answer and answer[1]:
            raise ColdloopError(f"{self._fmu.path}: has ended its simulation at {time_s:g} s")

    def derivatives(self, of: Sequence[int], by: Sequence[int]) -> RealArray:
        """Return partial derivatives at the present state, shape (of, by)."""
        return np.array([self._slave.getDirectionalDerivative(of, [one], [1.0]) for one in by], dtype=np.float64).T

    def state(self) -> bytes:
        """Return the whole state."""
        held = self._slave.getFMUState()
        content: bytes = self._slave.serializeFMUState(held)
        self._slave.freeFMUState(held)
        return content

    def return_to(self, state: bytes) -> None:
        """Return to a state."""
        held = self._slave.deserializeFMUState(state)
        self._slave.setFMUState(held)
        self._slave.freeFMUState(held)
