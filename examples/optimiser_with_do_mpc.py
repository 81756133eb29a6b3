"""An optimiser that takes the place of Coldloop's, with do-mpc as its controller and the Modbus client beside it.

    coldloop up --without optimizer --factor 5 --load a      # in another terminal
    python optimiser_with_do_mpc.py MODEL

MODEL is the model file that the control PLC has: the shipped one is `shared/coldloop/process/data/cold_box_model.json`,
`coldloop model --out FILE` makes others. From it come a linear model of a period of 5 s, bounds and rates are
constraints, and the bands of L1 and T5 are soft ones. States are those of the update, which are simulated: with a real
plant an estimator would be in their place. Needs do-mpc (LGPL-3, as CasADi in it) and pymodbus, nothing of Coldloop.
"""

import json
import signal
import statistics
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import casadi
import numpy as np
from numpy.typing import NDArray
from optimiser_by_registers import (
    HIGH,
    L1,
    LOW,
    PERIOD_TICKS,
    RATE,
    T5,
    TICK_S,
    ControlPlc,
    Rows,
    Update,
    allowed,
    optimise,
    option_parser,
)

with warnings.catch_warnings(action="ignore"):  # it names its parts that are not installed; none is needed here
    import do_mpc

HORIZON = 60
"""Periods that are looked ahead: 5 min."""
BAND_LOW, BAND_HIGH = (59.1, 9.3), (60.9, 15.7)
"""Bands of L1 (%) and T5 (K), each with a margin inside it: 0.1 % and 0.3 K."""
BAND_PENALTY = 100.0
"""Cost per period and % of L1 or K of T5 outside."""
SCALE = (10.0, 50.0, 10.0)
"""Inputs that are this far from the operating point cost 1 in each period."""
MOVE_WEIGHT = 0.1
"""Cost of a change by the whole rate."""
CORRECTION = 0.2
"""Share of what the model has missed by that is believed at once; the rest may be noise, or a load step."""

STATES = 28
"""States that an update shows; a model of the whole refrigerator has more."""

Array = NDArray[np.float64]


class Model(NamedTuple):
    """x' = A x + B u + F w over a period, y = C x + D u + G w; deviations from the operating point (x0, u0, w0, y0)."""

    digest: int
    """First 32 bits of that of the file."""
    A: Array
    B: Array
    F: Array
    C: Array
    """Of L1 and T5, as D, G and y0."""
    D: Array
    G: Array
    x0: Array
    u0: Array
    w0: float
    y0: Array


def read_model(path: Path) -> Model:
    """Return the model of a file for a period, composed of the model of a tick that the file has.

    Raises:
        OSError: There is no such file.
        KeyError: It is not a model file.
        ValueError: That neither, or the states are not those of an update.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    tick = {name: np.array(content[f"{name}_tick"]) for name in "ABF"}
    n, m = tick["B"].shape
    if n != STATES:
        raise ValueError(f"{n} states, an update shows {STATES}")
    held = np.eye(n + m + 1)  # inputs and load stay
    held[:n] = np.hstack([tick["A"], tick["B"], tick["F"][:, np.newaxis]])
    period = np.linalg.matrix_power(held, PERIOD_TICKS)[:n]
    C, D, G, y0 = (np.array(content[name])[[L1, T5]] for name in ("C", "D", "G", "y0"))
    x0, u0 = np.array(content["x0"]), np.array(content["u0"])
    digest = int(content["digest"][:8], 16)
    return Model(digest, period[:, :n], period[:, n : n + m], period[:, -1], C, D, G, x0, u0, content["w0"], y0)


def described(model: Model) -> Any:  # noqa: ANN401 do-mpc has no types
    """Return do-mpc's description of the plant: its inputs `u`, its states `x` and, for the rates, the inputs `before`.

    Its parameters are added in each period: `states` to x, `outputs` to L1 and T5.
    """
    plant = do_mpc.model.Model("discrete")
    x = plant.set_variable("_x", "x", shape=(len(model.x0), 1))
    before = plant.set_variable("_x", "before", shape=(len(model.u0), 1))
    u = plant.set_variable("_u", "u", shape=(len(model.u0), 1))
    states = plant.set_variable("_p", "states", shape=(len(model.x0), 1))
    outputs = plant.set_variable("_p", "outputs", shape=(len(model.y0), 1))
    later = casadi.DM(model.A) @ x + casadi.DM(model.B) @ u + states
    plant.set_expression("y", casadi.DM(model.C) @ later + casadi.DM(model.D) @ u + outputs)
    plant.set_expression("move", u - before)
    plant.set_expression("away", casadi.sumsqr(u / casadi.DM(SCALE)))
    plant.set_rhs("x", later)
    plant.set_rhs("before", u)
    plant.setup()
    return plant


def controller_of(plant: Any, model: Model) -> Any:  # noqa: ANN401 do-mpc has no types
    """Return do-mpc's controller of such a plant; `set_p_fun` and `setup` are still to be called."""
    controller = do_mpc.controller.MPC(plant)
    controller.settings.n_horizon, controller.settings.t_step = HORIZON, PERIOD_TICKS * TICK_S
    controller.settings.store_lagr_multiplier = False
    controller.settings.supress_ipopt_output()
    controller.set_objective(mterm=casadi.DM(0), lterm=plant.aux["away"])
    controller.set_rterm(u=MOVE_WEIGHT / np.array(RATE) ** 2)
    controller.bounds["lower", "_u", "u"] = np.array(LOW) - model.u0
    controller.bounds["upper", "_u", "u"] = np.array(HIGH) - model.u0
    y, move = plant.aux["y"], plant.aux["move"]
    for name, moved in (("faster", move), ("slower", -move)):
        controller.set_nl_cons(name, moved, ub=np.array(RATE))
    for name, outside in (("above", y - (BAND_HIGH - model.y0)), ("below", BAND_LOW - model.y0 - y)):
        controller.set_nl_cons(name, outside, ub=0.0, soft_constraint=True, penalty_term_cons=BAND_PENALTY)
    return controller


@contextmanager
def interrupted_afterwards() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block: CasADi takes it for a failure of the solver, and continues."""
    pressed: list[bool] = []
    handler = signal.signal(signal.SIGINT, lambda *_: pressed.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
    if pressed:
        raise KeyboardInterrupt


class DoMpc:
    """A controller: do-mpc, from the state at the next updating instant on."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._controller = controller_of(described(model), model)
        self._added = self._controller.get_p_template(1)
        self._controller.set_p_fun(lambda _: self._added)
        with warnings.catch_warnings(action="ignore"):  # of CasADi, about a call in do-mpc
            self._controller.setup()
        self._controller.set_initial_guess()
        self._missed_x, self._missed_y = np.zeros(len(model.x0)), np.zeros(len(model.y0))
        self._predicted: tuple[int, Array] | None = None
        self.solved_s: list[float] = []
        """How long each problem took."""

    def __call__(self, update: Update) -> Rows:
        """Return the inputs from the next updating instant on, the second period in case that its sequence is late.

        Until then the sequence being played goes on, which is constant. Without a solution it goes on for longer.
        """
        x, u, load = update.x - self._model.x0, update.u - self._model.u0, update.load - self._model.w0
        self._correct(update, x, u, load)
        states = self._model.F * load + self._missed_x
        ahead = self._model.A @ x + self._model.B @ u + states
        self._predicted = update.tick + PERIOD_TICKS, ahead
        moves = self._solved(ahead, u, np.concatenate([states, self._model.G * load + self._missed_y]))
        rows, before = [], update.u
        for wanted in moves:
            before = allowed(before, wanted + self._model.u0)
            rows += [before] * PERIOD_TICKS
        return rows

    def _correct(self, update: Update, x: Array, u: Array, load: float) -> None:
        """Estimate what the model misses the states by in a period, and the outputs at any time."""
        if self._predicted is not None and self._predicted[0] == update.tick:
            self._missed_x += CORRECTION * (x - self._predicted[1])
        y = self._model.C @ x + self._model.D @ u + self._model.G * load + self._missed_y
        missed = np.array([update.y[L1], update.y[T5]]) - self._model.y0 - y
        self._missed_y += CORRECTION * np.nan_to_num(missed)  # nothing by a bad measurement

    def _solved(self, x: Array, before: Array, added: Array) -> list[Array]:
        """Return the inputs of the next two periods, as deviations."""
        start = time.perf_counter()
        self._added["_p", 0] = added
        self._controller.u0 = before
        with interrupted_afterwards():
            self._controller.make_step(np.concatenate([x, before])[:, np.newaxis])
        self._controller.reset_history()  # nobody reads it
        self.solved_s.append(time.perf_counter() - start)
        if not self._controller.solver_stats["success"]:
            self._controller.opt_x_num = self._controller.opt_x(0.0)  # where the next one begins
            return [before, before]
        return [self._controller.opt_x_num["_u", period, 0].full()[:, 0] for period in range(2)]


def main() -> None:
    """Optimise until Ctrl-C; say how long that took."""
    parser = option_parser("An optimiser for Coldloop's control PLC, with do-mpc.")
    parser.add_argument("model", type=Path, help="the model file that the control PLC has")
    options = parser.parse_args()
    try:
        model = read_model(options.model)
    except (OSError, KeyError, ValueError) as error:
        parser.error(f"{options.model}: no model of this plant ({error!r})")
    controller = DoMpc(model)
    with suppress(KeyboardInterrupt):
        optimise(ControlPlc(options.host, options.port, model.digest), controller, f"{options.host}:{options.port}")
    if times := [1000.0 * seconds for seconds in controller.solved_s]:
        print(f"{len(times)} problems, {statistics.median(times):.0f} ms each, the longest {max(times):.0f} ms")


if __name__ == "__main__":
    main()
