"""Process files of plants with a mode that grows: a stirred tank, and a pendulum on a cart, which has no loops."""

from pathlib import Path
from typing import Final

TANK: Final = '''"""The tank of Henson and Seborg (1997) at the middle one of its steady states, of 0.047 /s."""
from math import exp


class Tank:
    states = {"Ca": "mol/l", "T": "K"}
    guess = [0.5, 350.0]
    steps_per_tick = 4

    def derivatives(self, x, u, w):
        reaction = 7.2e10 * exp(-8750.0 / x[1]) * x[0]
        cooling = 5e4 / (100.0 * 1000.0 * 0.239) * (u[0] - x[1])
        return [(1.0 - x[0] - reaction) / 60.0, (w - x[1] + 5e4 / (1000.0 * 0.239) * reaction + cooling) / 60.0]

    def outputs(self, x, u, w):
        return [x[1]]
'''
TANK_FILE: Final = """
name = "stirred-tank"
tick_s = 1.0
ticks_per_sample = 6
plant = { python = "plant.py:Tank" }
load = { name = "feed_T", unit = "K", at = 350.0, span = [345.0, 355.0] }
[[inputs]]
name = "Tc"
unit = "K"
at = 300.0
low = 280.0
high = 320.0
rate = 5.0
[[outputs]]
name = "T"
unit = "K"
range = [280.0, 460.0]
noise = 0.1
band = [348.0, 352.0]
loop = { input = "Tc", gain = 8.0, integral_time_s = 60.0 }
"""
PENDULUM: Final = '''"""A pendulum, upright on a cart: 6.8 /s."""
from math import cos, sin


class Pendulum:
    states = {"p": "m", "v": "m/s", "angle": "rad", "speed": "rad/s"}
    guess = [0.0, 0.0, 0.0, 0.0]
    steps_per_tick = 2

    def derivatives(self, x, u, w):
        s, c = sin(x[2]), cos(x[2])
        force = u[0] + w - 0.5 * x[1]
        acceleration = (force + 0.2 * s * (0.25 * x[3] ** 2 - 9.81 * c)) / (1.0 + 0.2 * s * s)
        return [x[1], acceleration, x[3], (9.81 * s - acceleration * c) / 0.25]

    def outputs(self, x, u, w):
        return [x[0], x[2]]
'''
PENDULUM_FILE: Final = """
name = "pendulum"
tick_s = 0.01
ticks_per_sample = 5
plant = { python = "plant.py:Pendulum" }
load = { name = "push", unit = "N", at = 0.0, span = [-1.0, 1.0] }
[[inputs]]
name = "F"
unit = "N"
at = 0.0
low = -10.0
high = 10.0
rate = 200.0
[[outputs]]
name = "p"
unit = "m"
range = [-2.0, 2.0]
noise = 0.001
band = [-0.5, 0.5]
[[outputs]]
name = "angle"
unit = "rad"
range = [-1.0, 1.0]
noise = 0.001
band = [-0.1, 0.1]
"""


def stirred_tank(folder: Path) -> Path:
    return _written(folder, TANK, TANK_FILE)


def pendulum(folder: Path) -> Path:
    return _written(folder, PENDULUM, PENDULUM_FILE)


def _written(folder: Path, plant: str, declared: str) -> Path:
    (folder / "plant.py").write_text(plant, encoding="utf-8")
    (folder / "process.toml").write_text(declared, encoding="utf-8")
    return folder / "process.toml"
