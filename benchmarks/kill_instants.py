"""Kills or suspends a service at random instants and measures the recovery."""

import argparse
import random
import tempfile
from pathlib import Path

from coldloop.config import Configuration, load_configuration
from coldloop.process.cold_box import TICK_S
from coldloop.session import TimeMode
from coldloop_chaos.faults import ChaosPlan, ProcessStop
from coldloop_chaos.report import ChaosProgress, Evaluation, perform, summary_lines, write_report
from coldloop_rig.results.run_folder import claim_folder
from coldloop_rig.settings import Settings

IN_FLIGHT_MS = 20.0
"""In real time the signal comes up to so much after a tick, with the rig moving on: anywhere in a scan or a solve."""
HOURS = 8


def make_plan(options: argparse.Namespace) -> ChaosPlan:
    """Return a plan with all the instants in one run."""
    draw = random.Random(options.seed)  # noqa: S311 not for secrets
    faults = []
    for number in range(1, options.count + 1):
        values = {
            "process": options.service,
            "at_s": number * options.gap + TICK_S * draw.randrange(round(0.5 * options.gap / TICK_S)),
            "duration_s": options.outage,
            "offset_ms": draw.uniform(0, IN_FLIGHT_MS),
        }
        faults.append(ProcessStop(kind="kill" if options.signal == "kill" else "pause", **values))
    duration_s = (options.count + 2) * options.gap
    draws = int(duration_s // (HOURS * 3600)) + 1
    return ChaosPlan(
        name=f"{options.signal}-{options.service}",
        description=f"{options.count} times {options.signal} {options.service}",
        load=tuple(f"{HOURS}h@{number}" for number in range(1, draws + 1)),
        duration_s=duration_s,
        seed=options.seed,
        mode=TimeMode(options.mode),
        factor=options.factor,
        faults=tuple(faults),
    )


def tell(evaluation: Evaluation) -> None:
    """Print what became of it."""
    rows = evaluation.rows
    alarms = [row.alarms[0] for row in rows if row.alarms]
    earliest, latest = (max(times, default=0.0) for times in (
        [alarm.after_done_s for alarm in alarms], [alarm.after_s for alarm in alarms],
    ))  # fmt: skip
    back = [row.back_s for row in rows if row.back_s is not None]
    print(f"{len(rows)} instants")
    print(f"largest step/limit: {max((row.largest_step for row in rows), default=0.0):.6f}")
    print(f"first alarm at most {latest:g} s after the last tick seen before the signal, {earliest:g} s after the "
          f"first one seen when it had worked; none in {len(rows) - len(alarms)}")  # fmt: skip
    print(f"back to MPC after at most {max(back, default=0.0):g} s; not before the next one in {len(rows) - len(back)}")


def patient(patience_s: float) -> Configuration[Settings]:
    """Return the default settings with another patience: with hundreds of instants, what lock-step waits adds up."""
    assignment = f"control_plc.ladder.optimizer_patience_s={patience_s}"
    return load_configuration(Settings, environment={}, assignments=[assignment])


def main() -> int:
    """Do all of it in one run, and print; return 1 when the run failed."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("--service", choices=("optimizer", "control", "plant"), default="optimizer")
    parser.add_argument("--signal", choices=("kill", "stop"), default="kill")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--mode", choices=[mode.value for mode in TimeMode], default="lockstep")
    parser.add_argument("--factor", type=float, default=20.0, help="in real time")
    parser.add_argument("--outage", type=float, default=20.0, help="plant time until it is started again, s")
    parser.add_argument(
        "--patience", type=float, default=5.0, help="control_plc.ladder.optimizer_patience_s, real time"
    )
    parser.add_argument("--gap", type=float, default=120.0,
                        help="plant time from one instant to the next, about, s; in real time a process takes some "
                        "seconds to start, which at factor 20 is a hundred of plant time")  # fmt: skip
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder for the results (default: none are kept)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        claim_folder(folder, force=False)
        plan = make_plan(options)
        with ChaosProgress(plan) as progress:
            experiment = perform(plan, patient(options.patience), folder, progress, arguments={}, formats=["png"])
        write_report(folder, experiment)
    tell(experiment.evaluation)
    print(*summary_lines(experiment.trace, experiment.evaluation), sep="\n")
    if experiment.failure is not None:
        print(f"failed: {experiment.failure}")
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
