"""Rigs for test suites: three services on localhost, their registers by name, and faults on purpose.

With pytest, the fixture `coldloop_rigs` starts them; without, `up` is a context manager:

from coldloop_rig.testing import up

with up(load="a") as rig:
    rig.advance(60)
    print(rig.plant.read("measurement.y.T5"))
"""

from coldloop_rig.testing.live_rig import LiveRig, NamedRegisters, Rigs, up

__all__ = ["LiveRig", "NamedRegisters", "Rigs", "up"]
