"""Coldloop beside general tools: exchanges a second of the same data between two processes, and one predictive problem.

Each exchange carries the data of plant and control PLC in a tick: 51 numbers one way and 4 the other. Neither
side computes anything, so a framework's figure is its upper limit; Coldloop's lock-step (`lockstep.py`, of the same
run) has plant, control PLC and solver in it. Coldloop and mosaik act in turn, the one on what the other has just sent;
so does HELICS, and again with both sides at once, which hides one of the two ways but is another coupling. The problem
(`peer_problem.py`) is stated in do-mpc, with every sample of the horizon a decision, and solved by IPOPT; Coldloop
solves the same one, and that of the paper's seven instants.

Needs the packages of `peers.txt`, in an environment of their own: `python -m venv peers && peers/bin/pip install -r
peers.txt && peers/bin/python peers.py`.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

PLANT_NUMBERS: Final = 51
CONTROL_NUMBERS: Final = 4
OWN_PYTHON: Final = Path(__file__).parents[1] / ".venv" / "bin" / "python"
CORES: Final = ("tcp", "zmq", "ipc")


# -- HELICS ------------------------------------------------------------------------------------------------------------


def helics_federate(core: str, name: str, other: str, numbers: int, exchanges: int, *, in_turn: bool) -> float:
    """Exchange vectors once a second of simulated time; return exchanges a second of real time.

    In turn, the plant has the halves of seconds: each side sees what the other made of its last vector, as a controller
    and a plant do, and Coldloop's control PLC and rack. Otherwise both send and receive at the same time.
    """
    import helics as h  # noqa: PLC0415 in its own environment

    info = h.helicsCreateFederateInfo()
    h.helicsFederateInfoSetCoreTypeFromString(info, core)
    h.helicsFederateInfoSetCoreInitString(info, "--federates=1")
    h.helicsFederateInfoSetTimeProperty(info, h.HELICS_PROPERTY_TIME_DELTA, 0.5 if in_turn else 1.0)
    federate = h.helicsCreateValueFederate(name, info)
    output = h.helicsFederateRegisterGlobalPublication(federate, name, h.HELICS_DATA_TYPE_VECTOR, "")
    received = h.helicsFederateRegisterSubscription(federate, other, "")
    h.helicsFederateEnterExecutingMode(federate)
    is_first = in_turn and name == "plant"
    start = time.perf_counter()
    for tick in range(1, exchanges + 1):
        if not in_turn:
            h.helicsPublicationPublishVector(output, [float(tick)] * numbers)
        h.helicsFederateRequestTime(federate, tick - 0.5 if is_first else float(tick))
        heard, expected = h.helicsInputGetVector(received), tick - 1 if is_first else tick
        if expected and heard != [float(expected)] * (PLANT_NUMBERS + CONTROL_NUMBERS - numbers):
            raise RuntimeError("what the other side has sent for this tick did not arrive")
        if in_turn:
            h.helicsPublicationPublishVector(output, [float(tick)] * numbers)
    elapsed = time.perf_counter() - start
    h.helicsFederateDisconnect(federate)
    h.helicsFederateFree(federate)
    return exchanges / elapsed


def helics_exchanges(core: str, exchanges: int, *, in_turn: bool) -> float:
    """Return exchanges a second between two processes and a broker."""
    import helics as h  # noqa: PLC0415

    broker = h.helicsCreateBroker(core, "", "-f 2")
    command = [sys.executable, __file__, "--helics-control", core, "--exchanges", str(exchanges)]
    command += ["--in-turn"] if in_turn else []
    with subprocess.Popen(command) as control:
        rate = helics_federate(core, "plant", "control", PLANT_NUMBERS, exchanges, in_turn=in_turn)
        control.wait(60)
    h.helicsBrokerWaitForDisconnect(broker, 10_000)
    h.helicsCloseLibrary()
    return rate


# -- mosaik ------------------------------------------------------------------------------------------------------------


def mosaik_side(numbers: int) -> Any:  # noqa: ANN401 a class of a package that may not be there
    """Return a simulator that sends so many numbers in each step."""
    import mosaik_api_v3  # noqa: PLC0415

    model = {"public": True, "params": [], "attrs": ["told", "heard"]}

    class Side(mosaik_api_v3.Simulator):  # type: ignore[misc]
        """One side of the exchange."""

        def __init__(self) -> None:
            super().__init__({"api_version": "3.0", "type": "time-based", "models": {"Side": model}})
            self.tick = 0

        def create(self, num: int, model: str, **_: object) -> list[dict[str, str]]:
            """Make the entity."""
            return [{"eid": f"side{number}", "type": model} for number in range(num)]

        def step(self, time: int, inputs: object, max_advance: int) -> int:  # noqa: ARG002
            """Do nothing for a step."""
            self.tick = time
            return time + 1

        def get_data(self, outputs: dict[str, list[str]]) -> dict[str, dict[str, list[float]]]:
            """Return the numbers."""
            return {entity: {"told": [float(self.tick)] * numbers} for entity in outputs}

    return Side()


def mosaik_exchanges(exchanges: int) -> float:
    """Return exchanges a second between two simulators in separate processes."""
    import mosaik  # noqa: PLC0415

    command = f"{sys.executable} {__file__} --mosaik-side {{}} %(addr)s"
    sides = {name: {"cmd": command.format(count)} for name, count in
             (("Plant", PLANT_NUMBERS), ("Control", CONTROL_NUMBERS))}  # fmt: skip
    with mosaik.World(sides) as world:
        plant, control = (world.start(name).Side() for name in sides)
        world.connect(plant, control, ("told", "heard"))
        world.connect(
            control, plant, ("told", "heard"), time_shifted=True, initial_data={"told": [0.0] * CONTROL_NUMBERS}
        )
        start = time.perf_counter()
        world.run(until=exchanges, print_progress=False)
        return exchanges / (time.perf_counter() - start)


# -- do-mpc ------------------------------------------------------------------------------------------------------------


def do_mpc_controller(problem: dict[str, Any]) -> Any:  # noqa: ANN401 a class of a package that may not be there
    """Return do-mpc's controller for a problem of `peer_problem.py`; slacks of the bands are inputs of its model."""
    import casadi  # noqa: PLC0415
    import do_mpc  # noqa: PLC0415

    m = {name: casadi.DM(value) for name, value in problem.items() if name != "horizon"}
    model = do_mpc.model.Model("discrete")
    x, before = (
        model.set_variable("_x", name, shape=(size, 1)) for name, size in (("x", m["A"].shape[0]), ("before", 3))
    )
    u, slack = (model.set_variable("_u", name, shape=(size, 1)) for name, size in (("u", 3), ("slack", 4)))
    later = m["A"] @ x + m["B"] @ u + m["F"] * m["w"]
    weights = casadi.vertcat(*(m["violation"][row] for row in (0, 0, 1, 1)))
    cost = casadi.dot(m["Q"], later**2) + casadi.dot(m["R"], u**2) + casadi.dot(weights, slack**2)
    for name, value in (("cost", cost), ("y", m["C"] @ later + m["D"] @ u + m["G"] * m["w"]), ("move", u - before)):
        model.set_expression(name, value)
    model.set_rhs("x", later)
    model.set_rhs("before", u)
    model.setup()
    controller = do_mpc.controller.MPC(model)
    controller.settings.n_horizon, controller.settings.t_step = problem["horizon"], 5.0
    controller.settings.supress_ipopt_output()
    controller.set_objective(mterm=casadi.DM(0), lterm=model.aux["cost"])
    for side, sign in (("low", "lower"), ("high", "upper")):
        controller.bounds[sign, "_u", "u"] = problem[f"u_{side}"]
    controller.bounds["lower", "_u", "slack"] = 0.0
    for row in range(2):
        y = model.aux["y"][row]
        controller.set_nl_cons(f"low {row}", -y - model.u["slack"][2 * row], ub=-problem["y_low"][row])
        controller.set_nl_cons(f"high {row}", y - model.u["slack"][2 * row + 1], ub=problem["y_high"][row])
    for row, rate in enumerate(problem["rate"]):
        for sign in (1, -1):
            controller.set_nl_cons(f"rate {row} {sign}", sign * model.aux["move"][row], ub=rate)
    controller.setup()
    return controller


def do_mpc_solved(problem: dict[str, Any], repeat: int) -> tuple[float, float]:
    """Return the time (s) that do-mpc takes for a problem, beginning at its last solution, and the cost."""
    import numpy as np  # noqa: PLC0415

    controller = do_mpc_controller(problem)
    at_rest = np.zeros((len(problem["A"]) + 3, 1))
    controller.x0 = at_rest
    controller.set_initial_guess()
    times = []
    for _ in range(repeat + 1):
        start = time.perf_counter()
        controller.make_step(at_rest)
        times.append(time.perf_counter() - start)
        if not controller.solver_stats["success"]:
            raise RuntimeError("IPOPT has not solved it")
    cost = sum(float(value) for value in controller.opt_aux_num["_aux", :, 0, "cost"])
    return statistics.median(times[1:]), cost


def compare_problem(coldloop: Path, repeat: int) -> None:
    """Print the times and costs of one problem."""
    own = subprocess.run([coldloop, Path(__file__).with_name("peer_problem.py")], check=True, capture_output=True)
    answer = json.loads(own.stdout)
    for name, (seconds, cost) in answer["own"].items():
        print(f"Coldloop, {name}: {seconds * 1000:.2f} ms a problem, J {cost:.3f}", flush=True)
    seconds, cost = do_mpc_solved(answer["problem"], repeat)
    print(f"do-mpc, every sample: {seconds * 1000:.2f} ms a problem, J {cost:.3f}", flush=True)


def main() -> None:
    """Measure and print, or be one side of a measurement."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--exchanges", type=int, default=3000)
    parser.add_argument("--coldloop", type=Path, default=OWN_PYTHON, help="an interpreter that has Coldloop")
    parser.add_argument("--helics-control", choices=CORES, help=argparse.SUPPRESS)
    parser.add_argument("--in-turn", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--mosaik-side", type=int, help=argparse.SUPPRESS)
    parser.add_argument("address", nargs="?", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.helics_control:
        helics_federate(
            options.helics_control, "control", "plant", CONTROL_NUMBERS, options.exchanges, in_turn=options.in_turn
        )
        return
    if options.mosaik_side:
        import mosaik_api_v3  # noqa: PLC0415

        sys.argv = [sys.argv[0], options.address]
        mosaik_api_v3.start_simulation(mosaik_side(options.mosaik_side))
        return
    if options.coldloop.is_file():
        lockstep = [options.coldloop, Path(__file__).with_name("lockstep.py"), "--ticks", str(options.exchanges)]
        print(
            "Coldloop:", subprocess.run(lockstep, check=True, capture_output=True, text=True).stdout.strip(), flush=True
        )
        compare_problem(options.coldloop, repeat=5)
    peers: dict[str, Callable[[], float]] = {"mosaik": lambda: mosaik_exchanges(options.exchanges)}
    peers |= {
        f"HELICS {core}, {'in turn' if in_turn else 'both at once'}":
            lambda core=core, in_turn=in_turn: helics_exchanges(core, options.exchanges, in_turn=in_turn)
        for core in CORES for in_turn in (True, False)
    }  # fmt: skip
    for name, measure in peers.items():
        print(f"{name}: {measure():.0f} exchanges/s", flush=True)


if __name__ == "__main__":
    main()
