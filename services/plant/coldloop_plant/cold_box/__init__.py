"""The cold box: how the components are piped together, its states, inputs and outputs, and its integration.

High-pressure helium at 80 K is cooled in NEF34; part of it drives the turbine, the rest goes on through NEF2 and NEF1
to the Joule-Thomson valve and the bath. The vapour returns through NEF1, meets the turbine's exhaust, and leaves
through NEF2 and NEF34. To make another refrigerator, write such a module: choose components, order the states, call the
components in the order in which the streams need each other.

All functions are kernels and take x (28 states, `STATE_NAMES`), u (3 inputs, `INPUT_NAMES`), w (heat load NCR22_HL, W),
real or complex. Integration is one classical Runge-Kutta step a tick, real.
"""

from collections import deque
from collections.abc import Sequence
from math import nan
from typing import Any, Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop.kernels.intrinsics import PlainTuples, borrowed, named, plain_tuples
from coldloop.process import cold_box
from coldloop.process.model_range import present_model_range
from coldloop_plant.components import expansion, heat_exchanger, phase_separator
from coldloop_plant.components.expansion import ReturnLine, Turbine, Valve
from coldloop_plant.components.heat_exchanger import HeatExchanger, HighPressureFlow, LowPressureFlow, exchange
from coldloop_plant.components.phase_separator import Content, PhaseSeparator, content
from coldloop_plant.helium import Helium, load_helium, saturation, supply_enthalpy_and_density, vapour_temperature
from coldloop_plant.numeric import PA_PER_BAR, Array, RealArray, at_least
from coldloop_plant.program import PlantProgram
from coldloop_plant.settings import MismatchSettings

OUTPUTS: Final = len(cold_box.OUTPUT_NAMES)
CELLS = (8, 6, 12)  # of NEF1, NEF2, NEF34; the states are named in coldloop.process.cold_box


class ColdBox(NamedTuple):
    """Components and boundaries of the cold box, in SI units; `cold_box.plant_file` has the reference plant's."""

    separator: PhaseSeparator  # The bath, NS1
    jt_valve: Valve  # CV155
    turbine: Turbine  # The turbine with CV156
    nef1: HeatExchanger  # The coldest exchanger, between the bath and the mixing point
    nef2: HeatExchanger  # The exchanger between the mixing point and the turbine's inlet
    nef34: HeatExchanger  # The exchanger from the turbine's inlet up to the nitrogen pre-cooler
    return_line: ReturnLine  # The low-pressure side
    P_HP: float  # Supply pressure, Pa, 5e5 to 19e5; the reference is that of the isobar's table
    P_LP: float  # Suction pressure of the compressor, Pa
    T_in: float  # Temperature after the nitrogen pre-cooler, K


class Streams(NamedTuple):
    """Flows and pressures that follow from the state at once, before the exchangers are marched."""

    m_jt: float  # Through the Joule-Thomson valve, kg/s
    h_jt: float  # Enthalpy into the bath, J/kg
    m_v: float  # Vapour from the bath, kg/s
    m_t: float  # Through the turbine, kg/s
    P_turbine: float  # Between CV156 and the nozzle, Pa
    P_mix: float  # Pressure where the turbine's exhaust joins the return, Pa
    exhaust: expansion.Expansion  # State of the gas that leaves the turbine


@inlined
def streams(x: Array, u: Array, box: ColdBox, helium: Helium) -> Streams:
    """Return the flows at the state `x` under the inputs `u`."""
    h_jt, rho_jt = supply_enthalpy_and_density(box.P_HP, x[1 + box.nef1.cells], helium)
    m_jt = expansion.cold_valve_flow(box.jt_valve, u[0], x[1 + box.nef1.cells], rho_jt, box.P_HP, x[0])
    T_turbine = x[1 + box.nef1.cells + box.nef2.cells + box.nef34.cells]
    h_turbine, rho_turbine = supply_enthalpy_and_density(box.P_HP, T_turbine, helium)
    m_t, P_turbine = expansion.turbine_flow(box.turbine, u[2], box.P_HP, T_turbine, rho_turbine)
    thin = phase_separator.thinness(box.separator, x[0], x[1], helium)
    m_v, P_mix = expansion.return_flow(box.return_line, x[0], box.P_LP, m_t, thin)
    if P_mix.real > expansion.CRITICAL_RATIO * P_turbine.real:
        back = expansion.Back(box.return_line, x[0], box.P_LP, thin)
        m_t, P_turbine, m_v, P_mix = expansion.throttled_flow(box.turbine, u[2], box.P_HP, T_turbine, rho_turbine, back)
    exhaust = expansion.expand(box.turbine, m_t, h_turbine, P_turbine, P_mix, helium)
    return Streams(m_jt, h_jt, m_v, m_t, P_turbine, P_mix, exhaust)


@inlined
def mix(vapour: LowPressureFlow, s: Streams, helium: Helium) -> LowPressureFlow:
    """Return the low-pressure flow after the turbine's exhaust has joined the vapour from NEF1."""
    flow = s.m_v + s.m_t
    h = (s.m_v * vapour.h + s.m_t * s.exhaust.h_out) / at_least(flow, 1e-12)
    return LowPressureFlow(flow, s.P_mix, vapour_temperature(s.P_mix, h, saturation(s.P_mix, helium), helium), h)


@kernel
def evaluate(
    x: Array, u: Array, w: float, box: ColdBox, helium: Helium, dx: Array, y: Array, is_supply_held: bool = True  # noqa: FBT001, FBT002 compiled
) -> tuple[Streams, LowPressureFlow, float, Content]:  # fmt: skip
    """Write the rates of the states into `dx` (28, per second) and the outputs into `y` (22, `OUTPUT_UNITS`).

    If the supply is not held at constant pressure, in the place of the rates of the cells is the heat that they give to
    the low-pressure gas (W). Returns the flows, what leaves at the warm end of the low-pressure side, what the bath's
    relief valve blows into the recovery line (kg/s), and what the bath holds.
    """
    s = streams(x, u, box, helium)
    first2 = 2 + box.nef1.cells
    first34 = first2 + box.nef2.cells
    sat = saturation(x[0], helium)
    heat = at_least(u[1], 0.0) + w
    top = phase_separator.outflow(box.separator, x[0], x[1], sat, helium)
    relief = phase_separator.bath_relief(box.separator, x[0], top.rho)
    bath = content(box.separator, x[0], x[1], helium)
    dx[0], dx[1] = phase_separator.separate(bath, s.m_jt, s.h_jt, s.m_v + relief, top.h, heat)

    vapour = LowPressureFlow(s.m_v, x[0], top.T, top.h)
    into_nef1 = HighPressureFlow(s.m_jt, x[first34 - 1], box.P_HP)
    cold = exchange(box.nef1, x[2:first2], into_nef1, vapour, helium, dx[2:first2], is_supply_held)
    mixed = mix(cold, s, helium)
    into_nef2 = HighPressureFlow(s.m_jt, x[first34 + box.nef34.cells - 1], box.P_HP)
    middle = exchange(box.nef2, x[first2:first34], into_nef2, mixed, helium, dx[first2:first34], is_supply_held)
    into_nef34 = HighPressureFlow(s.m_jt + s.m_t, box.T_in, box.P_HP)
    warm = exchange(box.nef34, x[first34:], into_nef34, middle, helium, dx[first34:], is_supply_held)

    exhaust_saturation = saturation(s.P_mix, helium)
    y[0], y[1] = phase_separator.level(box.separator, x[1]), s.exhaust.speed
    y[2], y[3], y[4], y[5] = top.T, x[first2 - 1], cold.T, into_nef1.T
    y[6] = vapour_temperature(s.P_mix, s.exhaust.h_out, exhaust_saturation, helium)
    y[7], y[8], y[9], y[10], y[11] = into_nef2.T, mixed.T, middle.T, box.T_in, warm.T
    y[12] = x[0] / PA_PER_BAR  # P1 to P10
    y[13] = y[15] = y[20] = box.P_HP / PA_PER_BAR
    y[14] = y[16] = y[18] = y[19] = s.P_mix / PA_PER_BAR
    y[17] = s.P_turbine / PA_PER_BAR
    y[21] = box.P_LP / PA_PER_BAR
    return s, warm, relief, bath


@kernel
def evaluated(x: Array, u: Array, w: float, box: ColdBox, helium: Helium) -> tuple[Array, Array]:
    """Return dx/dt, shape (28,), in `STATE_UNITS` per second, and y, shape (22,), in `OUTPUT_UNITS`."""
    dx, y = np.empty_like(x), np.empty(OUTPUTS, dtype=x.dtype)
    evaluate(x, u, w, box, helium, dx, y)
    return dx, y


@kernel
def advance(x: RealArray, u: RealArray, w: float, dt: float, box: ColdBox, helium: Helium) -> RealArray:
    """Return the state after `dt` seconds (shape (28,)), with inputs and load held.

    Stable up to dt = 0.5 s everywhere, and up to 1.6 s near the operating point. Loops run in a fixed order, so that
    the result is the same to the bit everywhere.
    """
    slope = np.empty(x.shape[0])
    evaluate(x, u, w, box, helium, slope, np.empty(OUTPUTS))
    return advance_along(x, slope, u, w, dt, box, helium)


@kernel
def advance_along(
    x: RealArray, slope: RealArray, u: RealArray, w: float, dt: float, box: ColdBox, helium: Helium
) -> RealArray:
    """Return the state after `dt` seconds, where `slope` (28,), dx/dt at `x`, is known; it is overwritten."""
    n = x.shape[0]
    y = np.empty(OUTPUTS)
    stage, total = np.empty(n), np.empty(n)
    stages, slopes = np.empty((4, n)), np.empty((4, n))
    account = phase_separator.start_account(content(box.separator, x[0], x[1], helium), slope)
    for i in range(n):
        stages[0, i], slopes[0, i] = x[i], slope[i]
        total[i] = slope[i]
        stage[i] = x[i] + 0.5 * dt * slope[i]
    for k, weight, ahead in ((1, 2.0, 0.5), (2, 2.0, 1.0), (3, 1.0, 0.0)):
        _, _, _, held = evaluate(stage, u, w, box, helium, slope, y)
        account = phase_separator.add_to_account(account, held, slope, weight)
        for i in range(n):
            stages[k, i], slopes[k, i] = stage[i], slope[i]
            total[i] += weight * slope[i]
            stage[i] = x[i] + (ahead * dt * slope[i] if k < 3 else dt / 6.0 * total[i])
    phase_separator.settle_account(box.separator, account, dt / 6.0, stage, helium)
    nef2 = 2 + box.nef1.cells
    nef34 = nef2 + box.nef2.cells
    if heat_exchanger.widest_move(stages, stage, 2, nef34 + box.nef34.cells) > heat_exchanger.COARSE:  # seldom
        heat_exchanger.settle_cells(box.nef1, 2, box.P_HP, stages, slopes, dt, stage, helium)
        heat_exchanger.settle_cells(box.nef2, nef2, box.P_HP, stages, slopes, dt, stage, helium)
        heat_exchanger.settle_cells(box.nef34, nef34, box.P_HP, stages, slopes, dt, stage, helium)
    return stage


@kernel
def advance_tick(
    x: RealArray, slope: RealArray, held: RealArray, acting: RealArray, y: RealArray, box: ColdBox, helium: Helium
) -> None:
    """Let `x` (28,) and the outputs `y` (22,) become those a tick ahead, with inputs and load `acting` (4,).

    `slope` (28,) becomes dx/dt there. It is that at `x` from the tick before where what was `held` (4,) then still
    acts, which saves one of five evaluations; `held` becomes what acts.
    """
    u, w = acting[:3], acting[3]
    if not np.all(held == acting):
        evaluate(x, u, w, box, helium, slope, y)
    x[:] = advance_along(x, slope, u, w, cold_box.TICK_S, box, helium)
    evaluate(x, u, w, box, helium, slope, y)
    held[:] = acting


@kernel
def advance_program_tick(
    x: RealArray, slope: RealArray, held: RealArray, acting: RealArray, y: RealArray, box: PlainTuples,
    helium: PlainTuples,
) -> None:  # fmt: skip
    """Do `advance_tick`; parameters and tables come as `plain_tuples`."""
    advance_tick(x, slope, held, acting, y, named(ColdBox, box), named(Helium, borrowed(helium)))


class ColdBoxProgram(PlantProgram):
    """The simulated cold box, advanced tick by tick.

    Its state at tick 0 is that of the model file, so that trajectories agree to the bit everywhere. `arguments` are
    those of `PlantProgram`.
    """

    def __init__(self, *, box: ColdBox, x0: Sequence[float], **arguments: Any) -> None:  # noqa: ANN401 of the base
        self.box = box
        self._box, self._helium = plain_tuples(box), plain_tuples(load_helium())
        self._slope = np.empty(len(x0))
        self._held = np.full(4, nan)  # Inputs and load that the slope of the state was computed with
        super().__init__(x0=x0, **arguments)

    def resume(self, *retained: Any, **named: Any) -> None:  # noqa: ANN401 of the base
        """Resume from what `retained` returned (ValueError if it is not of this plant)."""
        super().resume(*retained, **named)
        self._held[:] = nan

    def _warm_up(self) -> None:
        super()._warm_up()
        self._held[:] = nan

    def between_ticks(self) -> tuple[RealArray, RealArray, RealArray]:
        """Return the state, its slope, and the inputs and the load that the slope is for."""
        return self._x.copy(), self._slope.copy(), self._held.copy()

    def take_over_slope(self, tick: int, x: RealArray, slope: RealArray, held: RealArray, y: RealArray) -> None:
        """Go on from another tick with what `between_ticks` and `measure` would return there."""
        self.take_over(tick, x, held[:3], y)
        self._slope, self._held = slope.copy(), held.copy()

    @property
    def model_range(self) -> int:
        """Parts outside the property tables at the current tick, bits of `ModelRange`."""
        return present_model_range(self._x, self.box.P_HP / PA_PER_BAR, self.box.P_LP / PA_PER_BAR)

    def _read(self, w: float) -> RealArray:
        return evaluated(self._x, self._u, w, self.box, load_helium())[1]

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        x, y, acting = self._x.copy(), np.empty(OUTPUTS), np.array((*self._u.tolist(), w))
        advance_program_tick(x, self._slope, self._held, acting, y, self._box, self._helium)
        return x, y


class MismatchedPlant(ColdBoxProgram):
    """Inputs act later and the heater otherwise, the load is another than is announced, L1 is shown by a wrong scale.

    Of the mismatch these are the last four fields; the load among `arguments` is that which is announced.
    """

    def __init__(self, *, mismatch: MismatchSettings, u0: Sequence[float], **arguments: Any) -> None:  # noqa: ANN401
        self._mismatch = mismatch
        self._on_their_way = self._filled(u0)
        super().__init__(u0=u0, **arguments)

    def resume(self, *retained: Any, **named: Any) -> None:  # noqa: ANN401 of the base
        """Resume from what `retained` returned; inputs that were on their way have arrived."""
        super().resume(*retained, **named)
        self._on_their_way = self._filled(self._u.tolist())

    def _filled(self, u: Sequence[float]) -> deque[RealArray]:
        """Return inputs on their way that are all the same."""
        return deque([np.array(u, dtype=float)] * self._mismatch.delay_ticks)

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        self._on_their_way.append(self._u)
        u = self._on_their_way.popleft().copy()
        u[1] *= self._mismatch.heater
        asked, self._u = self._u, u
        reached = super()._step(w * self._mismatch.load)
        self._u = asked
        return reached

    def _sample(self, y: RealArray) -> tuple[float, ...]:
        y = np.array(y)
        y[cold_box.L1] *= self._mismatch.level_gauge
        return super()._sample(y)
