"""Oil-flooded screw compressor: fixed displacement, efficiencies over the pressure ratio, gas cooled to ambient."""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.gas_volume import gas_density
from coldloop_plant.components.parameters import require
from coldloop_plant.helium.properties import GAS_CONSTANT
from coldloop_plant.numeric import at_least

LEAST_EFFICIENCY = 0.15  # isothermal, far from the built-in ratio


class ScrewCompressor(NamedTuple):
    """A screw compressor with its motor, at fixed speed."""

    displacement: float
    """Swept volume at full speed, m3/s."""
    filling: float
    """Volumetric efficiency without a pressure rise, 0 to 1."""
    slip: float
    """Loss of volumetric efficiency per unit of pressure ratio; leakage through the rotors' gaps."""
    isothermal: float
    """Isothermal efficiency at the built-in pressure ratio, 0 to 1."""
    built_in_ratio: float
    """Pressure ratio that the rotors' ports are made for."""
    mismatch: float
    """Loss of isothermal efficiency per squared logarithm of the ratio over the built-in one."""
    motor: float
    """Efficiency of the motor, 0 to 1."""


class Compression(NamedTuple):
    """What a compressor does."""

    mass_flow: float
    """kg/s."""
    power: float
    """Electrical power, W."""


@kernel
def compress(compressor: ScrewCompressor, speed: float, P_in: float, P_out: float, T_in: float) -> Compression:
    """Return flow and power at a share `speed` of the full one, from `P_in` to `P_out` (Pa), suction at `T_in` (K).

    m = s V_d rho eta_v(r) with eta_v = filling - slip (r - 1); P = m R T ln r / (eta_iso(r) eta_motor), with
    eta_iso = isothermal - mismatch ln(r / built-in)^2. A check valve keeps gas from flowing back.
    """
    ratio = at_least(P_out / at_least(P_in, 1.0), 1.0)
    volumetric = at_least(compressor.filling - compressor.slip * (ratio - 1.0), 0.0)
    mass_flow = at_least(speed, 0.0) * compressor.displacement * gas_density(P_in, T_in) * volumetric
    detuned = np.log(ratio / compressor.built_in_ratio)
    efficiency = at_least(compressor.isothermal - compressor.mismatch * detuned * detuned, LEAST_EFFICIENCY)
    power = mass_flow * GAS_CONSTANT * T_in * np.log(ratio) / (efficiency * compressor.motor)
    return Compression(mass_flow, power)


def check_screw_compressor(name: str, compressor: ScrewCompressor) -> None:
    """Refuse parameters that no compressor has (`ParameterError`)."""
    require(name, "displacement", compressor.displacement, 0.0, 100.0)
    require(name, "filling", compressor.filling, 0.0, 1.0)
    require(name, "slip", compressor.slip, -1e-12, 0.1)
    require(name, "isothermal", compressor.isothermal, LEAST_EFFICIENCY, 1.0)
    require(name, "built_in_ratio", compressor.built_in_ratio, 1.0, 100.0)
    require(name, "mismatch", compressor.mismatch, -1e-12, 1.0)
    require(name, "motor", compressor.motor, 0.0, 1.0)
