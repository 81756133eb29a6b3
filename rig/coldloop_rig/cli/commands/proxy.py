"""`coldloop proxy`: a link to any Modbus/TCP server, disturbed by plan: late, lost, doubled, damaged, cut, refused."""

import argparse
import sys

from coldloop.errors import UsageError
from coldloop_rig.cli.commands.options import HostPort, endpoint

LOCAL = "127.0.0.1"


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("plan", type="read", metavar="PLAN", help="TOML file with the faults (`coldloop docs chaos`)")
    parser.add_argument("--listen", type=_listener, required=True, metavar="[HOST:]PORT",
                        help="where clients connect; at 127.0.0.1 unless an address is named")  # fmt: skip
    parser.add_argument("--to", type=endpoint, required=True, metavar="HOST:PORT", help="the server behind it")
    parser.add_argument("--seed", type=int, help="decides which frames are hit, instead of the plan's")


def _listener(text: str) -> HostPort:
    return endpoint(text if ":" in text else f"{LOCAL}:{text}")


def execute(options: argparse.Namespace) -> int:
    """Pass frames on until Ctrl-C."""
    from coldloop.modbus.endpoints import Endpoint
    from coldloop_rig.chaos.lone_proxy import disturb
    from coldloop_rig.chaos.plan import find_link_plan
    from coldloop_rig.until_interrupted import run_until_interrupted

    plan = find_link_plan(options.plan, {} if options.seed is None else {"seed": options.seed})
    if options.listen == options.to:
        raise UsageError(f"--listen {options.to.host}:{options.to.port} is the server itself; listen at another port")
    target = Endpoint(host=options.to.host, port=options.to.port)
    return 130 if run_until_interrupted(lambda: disturb(plan, options.listen, target, _say)) else 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
