"""The quadruple tank as an FMU of FMI 2.0 that hides its states; quadruple_tank_fmu.toml says how to build it."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Real
from quadruple_tank import QuadrupleTank

LONGEST_STEP_S = 0.25
"""Of the classical Runge-Kutta method."""


class QuadrupleTankFmu(Fmi2Slave):
    """Two pumps and a leak; the levels of four tanks, of which the lower two are shown."""

    def __init__(self, **kwargs):
        """Declare the variables."""
        super().__init__(**kwargs)
        self.tank = QuadrupleTank()
        self.pump_1 = self.pump_2 = 3.0
        self.leak = 0.0
        self.level_1, self.level_2, self.level_3, self.level_4 = self.tank.guess
        for name in ("pump_1", "pump_2", "leak"):
            self.register_variable(Real(name, start=getattr(self, name), causality=Fmi2Causality.input))
        for name in ("level_1", "level_2"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        for name in ("level_3", "level_4"):
            self.register_variable(Real(name, causality=Fmi2Causality.local))

    def do_step(self, current_time, step_size):
        """Integrate over a communication step; returns whether that went well."""
        count = max(1, round(step_size / LONGEST_STEP_S))
        x, h = [self.level_1, self.level_2, self.level_3, self.level_4], step_size / count
        for _ in range(count):
            a = self.slope(x)
            b = self.slope([xi + h / 2 * d for xi, d in zip(x, a, strict=True)])
            c = self.slope([xi + h / 2 * d for xi, d in zip(x, b, strict=True)])
            d = self.slope([xi + h * d for xi, d in zip(x, c, strict=True)])
            x = [xi + h / 6 * (p + 2 * q + 2 * r + s) for xi, p, q, r, s in zip(x, a, b, c, d, strict=True)]
        self.level_1, self.level_2, self.level_3, self.level_4 = x
        return True

    def slope(self, x):
        """Return dx/dt."""
        return self.tank.derivatives(x, (self.pump_1, self.pump_2), self.leak)
