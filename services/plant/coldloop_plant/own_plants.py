"""Plants of other processes: a linear model, lags with dead times, a class that a user has written in Python.

Disturbances beside the load are the last states of each, and outputs where they are measured. Dead times are whole
ticks here, exactly; the prediction model approximates them. So a plant of lags is not its model, and hides its states.
The source of a class is in the model file.
"""

import hashlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ColdloopError, ModelFileError, foreign
from coldloop.kernels.cache import kernels_of
from coldloop.kernels.compiled import inlined, kernel
from coldloop.process.declaration import Process
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import LtiModel
from coldloop.process.lti_model import load as load_model
from coldloop.process.model_file import ModelHeader
from coldloop.process.sections import Lag
from coldloop.text import file_digest
from coldloop_plant.numeric import RealArray
from coldloop_plant.program import HeatLoad, MakePlant, NoiseOfSeed, PlantProgram

PYTHON: Final = "python"  # Kinds of plants: `ModelHeader.plant`
LINEAR: Final = "linear"
TRANSFER_FUNCTIONS: Final = "transfer-functions"
FMU: Final = "fmu"


def outside(w: RealArray) -> float | RealArray:
    """Return what equations are given as w: the load, or load and other disturbances where there are such."""
    return w if len(w) > 1 else float(w[0])


@dataclass(frozen=True)
class Disturbances:
    """Their courses over time, steps held; each is a state of the process, and an output where it is measured."""

    courses: tuple[LoadProfile, ...] = ()
    measured: tuple[bool, ...] = ()

    @classmethod
    def of(cls, documents: Sequence[Mapping[str, Any]]) -> Self:
        """Return the disturbances of a model file."""
        courses = (LoadProfile(tuple(each["ticks"]), tuple(each["values"])) for each in documents)
        return cls(tuple(courses), tuple(each["measured"] for each in documents))

    def at(self, tick: int) -> RealArray:
        """Return what they are from `tick` to the next, shape (k,)."""
        return np.array([course.value(tick) for course in self.courses])

    def ahead(self, tick: int, ticks: int) -> RealArray:
        """Return what they are at `ticks` ticks from `tick` on, and at the one behind them, shape (ticks + 1, k)."""
        return np.array([[each.value(tick + later) for each in self.courses] for later in range(ticks + 1)])

    def shown(self, tick: int) -> RealArray:
        """Return those that are measured."""
        return np.array([course.value(tick) for course, seen in zip(self.courses, self.measured, strict=True) if seen])


NO_DISTURBANCES: Final = Disturbances()


class DisturbedPlant(PlantProgram):
    """A plant with disturbances as its last states and outputs; the others are its kind's.

    `arguments` are those of `PlantProgram`, here and in the kinds of plants below.
    """

    whose = "the plant"  # in messages

    def __init__(self, *, disturbances: Disturbances = NO_DISTURBANCES, **arguments: Any) -> None:  # noqa: ANN401
        self.disturbances = disturbances
        super().__init__(**arguments)

    @property
    def _own(self) -> RealArray:
        """States without the disturbances."""
        return self._x[: len(self._x) - len(self.disturbances.courses)]

    def _own_outputs(self, w: RealArray) -> RealArray:
        """Return the outputs without the disturbances; `w` is load and disturbances."""
        raise NotImplementedError

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        """Return states and outputs one tick ahead, without the disturbances."""
        raise NotImplementedError

    def _calling(self) -> AbstractContextManager[None]:
        return foreign(f"{self.whose} fails at tick {self.tick}", "the simulated plant ends there", kind=ColdloopError)

    def _read(self, w: float) -> RealArray:
        with self._calling():
            own = self._own_outputs(np.append(w, self.disturbances.at(self.tick)))
        return np.append(own, self.disturbances.shown(self.tick))

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        with self._calling():
            x, y = self._own_step(np.append(w, self.disturbances.at(self.tick)))
        met, next_tick = self.disturbances, self.tick + 1
        return np.append(x, met.at(next_tick)), np.append(y, met.shown(next_tick))

    def _saved(self) -> dict[str, Any] | None:
        """Return what the plant hides beside its states, as plain data; None if nothing, or if it cannot be saved."""
        return None

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        """Return to what `_saved` returned (ValueError or KeyError if it is not of this plant)."""
        if saved is not None:
            raise ValueError("the retained state is that of another plant")

    def retained(self) -> dict[str, Any]:
        """Return what `resume` needs, as plain data."""
        saved = self._saved()
        return super().retained() | ({} if saved is None else {"own": saved})

    def resume(self, *retained: Any, own: Mapping[str, Any] | None = None, **named: Any) -> None:  # noqa: ANN401
        """Resume from what `retained` returned (ValueError or KeyError if it is not of this plant)."""
        self._return_to(own)
        super().resume(*retained, **named)


class Matrices(NamedTuple):
    """Matrices of `LtiModel` for a tick."""

    A_tick: RealArray
    B_tick: RealArray
    F_tick: RealArray
    C: RealArray
    D: RealArray
    G: RealArray
    x0: RealArray
    u0: RealArray
    y0: RealArray
    w0: float


@inlined
def times(row: RealArray, values: RealArray, rest: RealArray) -> float:
    """Return a row of a matrix times the deviations of values from rest."""
    total = 0.0
    for j in range(row.shape[0]):
        total += row[j] * (values[j] - rest[j])
    return total


@kernel
def advance_linear(m: Matrices, x: RealArray, u: RealArray, w: float, met: RealArray, y: RealArray) -> None:
    """Let x and y become those of the next tick, under u and w held; disturbances are `met` there."""
    before = x.copy()
    for i in range(x.shape[0]):
        x[i] = m.x0[i] + (times(m.A_tick[i], before, m.x0) + times(m.B_tick[i], u, m.u0) + m.F_tick[i] * (w - m.w0))
    x[x.shape[0] - met.shape[0] :] = met
    read_linear(m, x, u, w, y)


@kernel
def read_linear(m: Matrices, x: RealArray, u: RealArray, w: float, y: RealArray) -> None:
    """Write the outputs."""
    for i in range(y.shape[0]):
        y[i] = m.y0[i] + times(m.C[i], x, m.x0) + times(m.D[i], u, m.u0) + m.G[i] * (w - m.w0)


class LinearPlant(PlantProgram):
    """The model in its own place, with as many states as the process declares; actuators do not saturate."""

    def __init__(self, model: LtiModel, *, disturbances: Disturbances = NO_DISTURBANCES, **arguments: Any) -> None:  # noqa: ANN401
        parts: dict[str, Any] = {name: getattr(model, name) for name in Matrices._fields}
        self.constants = Matrices(**{name: part if name == "w0" else part.copy() for name, part in parts.items()})
        self.disturbances = disturbances
        super().__init__(x0=model.x0.tolist(), u0=model.u0.tolist(), process=model.declared, **arguments)

    def _read(self, w: float) -> RealArray:
        y = np.empty(len(self.constants.y0))
        read_linear(self.constants, self._x, self._u, w, y)
        return y

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        x, y = self._x.copy(), np.empty(len(self.constants.y0))
        advance_linear(self.constants, x, self._u, w, self.disturbances.at(self.tick + 1), y)
        return x, y


class LagTable(NamedTuple):
    """The lags side by side."""

    places: NDArray[np.int64]  # Outputs that they move
    sources: NDArray[np.int64]  # Sources that they follow: inputs, then load and disturbances
    delays: NDArray[np.int64]  # Ticks
    decay: RealArray  # Share of each lag's response that remains after a tick
    gain: RealArray
    about: RealArray  # Inputs, load and disturbances at the operating point
    y0: RealArray  # Outputs there
    measured: NDArray[np.int64]  # Disturbances that are outputs, the last ones


class LagMemory(NamedTuple):
    """State of the lags, which a tick changes."""

    response: RealArray
    """Response of each lag."""
    under_way: RealArray
    """Values of each source in the ticks of the longest dead time and now, in turn; shape (sources, ticks)."""


@kernel
def advance_lags(c: LagTable, m: LagMemory, tick: int, u: RealArray, w: RealArray, y: RealArray) -> None:
    """Go one tick forward from `tick` with u and w held; y are the outputs then, without disturbances."""
    ticks = m.under_way.shape[1]
    for i in range(c.about.shape[0]):
        m.under_way[i, tick % ticks] = (u[i] if i < u.shape[0] else w[i - u.shape[0]]) - c.about[i]
    for k in range(c.decay.shape[0]):
        arriving = m.under_way[c.sources[k], (tick - c.delays[k]) % ticks]
        m.response[k] = c.decay[k] * m.response[k] + (1.0 - c.decay[k]) * c.gain[k] * arriving
    read_lags(c, m, y)


@kernel
def read_lags(c: LagTable, m: LagMemory, y: RealArray) -> None:
    """Write the outputs without disturbances."""
    for i in range(y.shape[0]):
        y[i] = c.y0[i]
    for k in range(c.places.shape[0]):
        y[c.places[k]] += m.response[k]


class TransferFunctionPlant(DisturbedPlant):
    """The lags, each with its own state and what is on its way to it.

    Outputs, inputs, load with disturbances are y0, u0, w0 at the operating point.
    """

    def __init__(
        self, lags: Sequence[Lag], *, y0: Sequence[float], u0: Sequence[float], w0: Sequence[float], process: Process,
        disturbances: Disturbances = NO_DISTURBANCES, **arguments: Any,  # noqa: ANN401 of the base
    ) -> None:  # fmt: skip
        own = len(process.states) - len(disturbances.courses)
        sources = (*process.input_names, process.load.name, *process.state_names[own:])
        delays = [round(lag.delay_s / process.tick_s) for lag in lags]
        self.constants = LagTable(
            places=np.array([process.output_names.index(lag.output) for lag in lags]),
            sources=np.array([sources.index(lag.source) for lag in lags]),
            delays=np.array(delays),
            decay=np.exp([-process.tick_s / lag.time_constant_s for lag in lags]),
            gain=np.array([lag.gain for lag in lags]),
            about=np.array([*u0, *w0]),
            y0=np.array(y0),
            measured=np.flatnonzero(disturbances.measured),
        )
        self.memory = LagMemory(np.zeros(len(lags)), np.zeros((len(sources), max(delays) + 1)))
        x0 = [*[0.0] * own, *w0[1:]]
        super().__init__(disturbances=disturbances, x0=x0, u0=u0, process=process, **arguments)

    def _warm_up(self) -> None:
        memory, self.memory = self.memory, LagMemory(*(part.copy() for part in self.memory))
        super()._warm_up()
        self.memory = memory

    def _room(self) -> RealArray:
        return np.empty(len(self.process.outputs) - sum(self.disturbances.measured))

    def _own_outputs(self, w: RealArray) -> RealArray:  # noqa: ARG002 nothing acts at once
        y = self._room()
        read_lags(self.constants, self.memory, y)
        return y

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        y = self._room()
        advance_lags(self.constants, self.memory, self.tick, self._u, w, y)
        return self._own, y

    def _saved(self) -> dict[str, Any]:
        return {name: part.tolist() for name, part in self.memory._asdict().items()}

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        kept = LagMemory(**{name: np.array((saved or {})[name], dtype=np.float64) for name in LagMemory._fields})
        if any(part.shape != ours.shape for part, ours in zip(kept, self.memory, strict=True)):
            raise ValueError("the retained state is that of another plant")
        self.memory = kept


NAME: Final = r"[A-Za-z][A-Za-z0-9_]{0,31}"  # Pattern of the name of a signal or a state


class Equations(Protocol):
    """Equations of a plant's class: dx/dt = f(x, u, w) and y = h(x, u, w), in physical units and seconds."""

    states: Mapping[str, str]  # Name and unit of each state, in order
    guess: Sequence[float]  # Start of the search for the operating point
    steps_per_tick: int  # Steps of the integration in a tick

    def derivatives(self, x: RealArray, u: RealArray, w: float | RealArray) -> RealArray | Sequence[float]:
        """Return dx/dt."""

    def outputs(self, x: RealArray, u: RealArray, w: float | RealArray) -> RealArray | Sequence[float]:
        """Return y."""


def made_by(source: str, name: str, where: str) -> Any:  # noqa: ANN401 whatever the user has written
    """Return what a Python source calls by a name; `where` names it in messages.

    Raises:
        ModelFileError: The source does not run, or has nothing of this name: one line.
    """
    digest = hashlib.sha256(source.encode()).hexdigest()[:12]  # another file may have a class of this name
    module = ModuleType(f"coldloop_plant_{name}_{digest}")
    sys.modules[module.__name__] = module  # dataclasses look there
    with foreign(f"{where}: {name} cannot be made"):
        exec(compile(source, where, "exec"), vars(module))  # noqa: S102 it is what the user has written
        return getattr(module, name)


def equations_of(source: str, name: str, where: str) -> Equations:
    """Return an instance of a class of a Python source; `where` names it in messages.

    Raises:
        ModelFileError: The source does not run, or the class lacks something: one line.
    """
    kind = made_by(source, name, where)
    with foreign(f"{where}: {name} cannot be made"):
        made: Any = kind()
        made.steps_per_tick = int(getattr(made, "steps_per_tick", 1))
        states, guess = dict(made.states), np.array(made.guess, dtype=np.float64)
    for needed in ("derivatives", "outputs"):
        if not callable(getattr(made, needed, None)):
            raise ModelFileError(
                f"{where}: {name} has no {needed}(x, u, w); `coldloop docs your-plant` says what it needs"
            )
    if not isinstance(made.states, Mapping) or not all(re.fullmatch(NAME, str(each)) for each in states):
        raise ModelFileError(f'{where}: states of {name} are a dict of names and units, such as {{"T": "K"}}')
    if guess.shape != (len(states),):
        raise ModelFileError(f"{where}: guess of {name} has {guess.size} numbers, there are {len(states)} states")
    if made.steps_per_tick < 1:
        raise ModelFileError(f"{where}: steps_per_tick of {name} is {made.steps_per_tick}; it is 1 or more")
    found: Equations = made
    return found


def evaluated(function: Callable[..., Any], *at: Any, size: int, where: str) -> RealArray:  # noqa: ANN401
    """Return what derivatives() or outputs() give at a point, shape (size,).

    Raises:
        ModelFileError: It fails there, or returns something else: one line.
    """
    name = getattr(function, "__name__", "it")
    with foreign(f"{where}: {name}() fails"):
        found = np.asarray(function(*at), dtype=np.float64)
    if found.shape != (size,):
        raise ModelFileError(f"{where}: {name}() returns {found.size} numbers, not {size}")
    return found


def runge_kutta(equations: Equations, x: RealArray, u: RealArray, w: float | RealArray, tick_s: float) -> RealArray:
    """Return the state a tick ahead by the classical method of fourth order, in equal steps."""
    h = tick_s / equations.steps_per_tick

    def slope(at: RealArray) -> RealArray:
        return np.asarray(equations.derivatives(at, u, w), dtype=np.float64)

    for _ in range(equations.steps_per_tick):
        a = slope(x)
        b = slope(x + h / 2 * a)
        c = slope(x + h / 2 * b)
        d = slope(x + h * c)
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return x


class PythonPlant(DisturbedPlant):
    """A user's plant, integrated tick by tick.

    Where the model has other states, the equations begin with the states `rest`, which are hidden: `x0` is shown.
    """

    def __init__(self, equations: Equations, *, rest: Sequence[float] | None = None, **arguments: Any) -> None:  # noqa: ANN401 of the base
        self._equations = equations
        self._hidden = None if rest is None else np.array(rest, dtype=np.float64)
        self.whose = f"the plant's class {type(equations).__name__}"
        super().__init__(**arguments)

    def _warm_up(self) -> None:
        if self._hidden is None:  # else a tick would move what is hidden
            super()._warm_up()

    def _own_outputs(self, w: RealArray) -> RealArray:
        return self._seen(self._own if self._hidden is None else self._hidden, w)

    def _seen(self, x: RealArray, w: RealArray) -> RealArray:
        return np.asarray(self._equations.outputs(x, self._u, outside(w)), dtype=np.float64)

    def _own_step(self, w: RealArray) -> tuple[RealArray, RealArray]:
        before = self._own if self._hidden is None else self._hidden
        x = runge_kutta(self._equations, before, self._u, outside(w), self.process.tick_s)
        if self._hidden is None:
            return x, self._seen(x, w)
        self._hidden = x
        return self._own, self._seen(x, w)

    def _saved(self) -> dict[str, Any] | None:
        return None if self._hidden is None else {"hidden": self._hidden.tolist()}

    def _return_to(self, saved: Mapping[str, Any] | None) -> None:
        if self._hidden is None:
            super()._return_to(saved)
        elif saved is None or len(saved["hidden"]) != len(self._hidden):
            raise ValueError("the retained state is that of another plant")
        else:
            self._hidden = np.array(saved["hidden"], dtype=np.float64)


def fmu_of(header: ModelHeader) -> Path:
    """Return the FMU that a model was made from: where it was then, or beside the model file.

    Raises:
        ModelFileError: There is another file than it was made from, or none.
    """
    source = Path(header.plant_parameters["file"])
    for place in (source, header.file.parent / source.name):
        if place.is_file() and file_digest(place, error=ModelFileError) == header.parameters_digest:
            return place
    raise ModelFileError(
        f"{header.file}: made from another {source} than is there or beside it; make it again, `coldloop process`"
    )


def own_plant_maker(header: ModelHeader, noise_of_seed: NoiseOfSeed) -> MakePlant:
    """Return what makes the plant of a model file at its operating point, for a load and a seed.

    Raises:
        ModelFileError: The plant cannot be made.
    """
    process, parameters = header.declared, header.plant_parameters
    disturbances = Disturbances.of(parameters.get("disturbances", ()))
    w0 = (header.w0, *header.x0[len(header.x0) - len(disturbances.courses) :])
    given: dict[str, Any] = {"u0": header.u0, "disturbances": disturbances, "process": process}
    plant: Callable[..., PlantProgram]  # each session has an instance of its own, for a class may have a memory
    if header.plant == FMU:
        from coldloop_plant.fmu import Fmu, FmuPlant, Wiring, fmu_maker  # noqa: PLC0415 few plants are FMUs

        fmu = Fmu(fmu_of(header))
        at_rest = fmu_maker(fmu, Wiring(**parameters["wiring"]), header.u0, w0, process.tick_s)

        def plant(**arguments: Any) -> PlantProgram:  # noqa: ANN401 as below
            return FmuPlant(at_rest(), keeps_state=fmu.keeps_state, **given, **arguments)

    elif header.plant == PYTHON:
        made_now = partial(equations_of, parameters["source"], parameters["class"], parameters["file"])
        made_now()  # a source that does not run is refused before a session begins

        def plant(**arguments: Any) -> PlantProgram:  # noqa: ANN401
            return PythonPlant(made_now(), rest=parameters.get("rest"), x0=header.x0, **given, **arguments)

    elif header.plant == TRANSFER_FUNCTIONS:
        lags = [Lag.model_validate(lag) for lag in parameters["lags"]]
        plant = partial(TransferFunctionPlant, lags, y0=header.y0, w0=w0, **given)
    else:
        plant = partial(LinearPlant, load_model(header.file), disturbances=disturbances)

    def make(load: HeatLoad, seed: int) -> PlantProgram:
        with kernels_of(f"the {process.name}", about_s=3):
            return plant(load=load, noise=noise_of_seed(seed))

    return make
