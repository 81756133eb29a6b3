"""The quadruple tank of Johansson, IEEE Trans. Control Systems Technology 8 (2000), minimum-phase setting."""

from math import sqrt

G = 981.0
"""cm/s2."""
AREA = (28.0, 32.0, 28.0, 32.0)
"""Of the tanks, cm2."""
OUTLET = (0.071, 0.057, 0.071, 0.057)
"""Of their outlets, cm2."""
PUMP = (3.33, 3.35)
"""cm3/(V s)."""
SPLIT = (0.70, 0.60)
"""Share of each pump's flow that goes into the lower tank."""


class QuadrupleTank:
    """Two pumps fill two lower tanks, each directly and through the upper tank of the other."""

    states = {"x1": "cm", "x2": "cm", "x3": "cm", "x4": "cm"}
    guess = (12.0, 13.0, 2.0, 1.5)

    def derivatives(self, x, u, w):
        """Return dx/dt; w is what leaks into tank 1, cm3/s."""
        q1, q2, q3, q4 = (outlet * sqrt(2 * G * max(level, 0.0)) for outlet, level in zip(OUTLET, x, strict=True))
        p1, p2 = PUMP[0] * u[0], PUMP[1] * u[1]
        return [
            (-q1 + q3 + SPLIT[0] * p1 + w) / AREA[0],
            (-q2 + q4 + SPLIT[1] * p2) / AREA[1],
            (-q3 + (1 - SPLIT[1]) * p2) / AREA[2],
            (-q4 + (1 - SPLIT[0]) * p1) / AREA[3],
        ]

    def outputs(self, x, u, w):
        """Return the levels of the lower tanks, cm."""
        return [x[0], x[1]]
