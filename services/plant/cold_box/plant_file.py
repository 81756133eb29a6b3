"""The plant file: the parameters of a cold box and its operating point, as a lab would write them down (TOML).

Every key is optional; the defaults are the reference plant. Numbers of cells are no keys: they name the states.
"""

from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

from coldloop.process.model_range import SATURATION_BAR, SUPPLY_BAR
from plant.cold_box.physics import CELLS, PA_PER_BAR, REFERENCE, ColdBox
from plant.components.heat_exchanger import HeatExchanger
from plant.components.phase_separator import PhaseSeparator
from plant.components.return_line import ReturnLine
from plant.components.turbine import Turbine
from plant.components.valve import Valve

LISTING: Final = "`coldloop docs your-refrigerator` lists the keys"
MM2_PER_M2, G_PER_KG, L_PER_M3 = 1e6, 1e3, 1e3
NOZZLE_UNITS: Final = 1e8
"""g sqrt(K)/(s bar) in a kg sqrt(K)/(s Pa)."""


def within(low: float, high: float) -> FieldInfo:
    """Return the range of a number; texts and truth values are none."""
    info: FieldInfo = Field(strict=True, ge=low, le=high)
    return info


HeatTransfer = Annotated[float, within(10, 200_000)]
Litres = Annotated[float, within(0.1, 2000)]
Mass = Annotated[float, within(0.1, 20_000)]
Drop = Annotated[float, within(0.0001, 1)]
Flow = Annotated[float, within(0.1, 5000)]

OPERATING_INPUTS: Final = (43.0, 75.0, 36.0)  # CV155 %, NCR22_A W, CV156 %; left of the capacity maximum at 50 %
OPERATING_LEVEL: Final = 60.0  # %


class Section(BaseModel):
    """A section of a plant file."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class BathSection(Section):
    """The phase separator NS1."""

    volume_m3: Annotated[float, within(0.005, 10)] = 0.2
    """Of the vessel; 1 % of level is a hundredth of it."""
    wall_kg: Annotated[float, within(0.1, 10_000)] = 50.0
    """Aluminium that warms when the vessel is dry."""
    relief_pressure_bar: Annotated[float, within(*SATURATION_BAR)] = 1.8
    """At which its relief valve begins to open."""
    relief_span_bar: Annotated[float, within(0.01, 2)] = 0.3
    """Rise above it at which that valve is fully open."""
    relief_area_mm2: Annotated[float, within(1, 100_000)] = 400.0
    """Its flow area then."""


class JtValveSection(Section):
    """The Joule-Thomson valve CV155."""

    area_mm2: Annotated[float, within(0.05, 500)] = 3.9
    """Effective flow area when fully open."""


class TurbineSection(Section):
    """The turbine and its inlet valve CV156."""

    cv156_area_mm2: Annotated[float, within(0.5, 5000)] = 26.0
    """Effective flow area of CV156 when fully open."""
    nozzle_g_sqrt_k_per_s_bar: Annotated[float, within(0.5, 5000)] = 22.0
    """K of the choked nozzle, m = K P / sqrt(T) with m in g/s, P in bar, T in K."""
    efficiency: Annotated[float, within(0.2, 0.95)] = 0.7
    """Isentropic."""
    speed_hz_per_sqrt_j_per_kg: Annotated[float, within(0.1, 100)] = 10.0
    """Shaft speed over the square root of the isentropic enthalpy drop."""
    windage_g_per_s: Annotated[float, within(0.1, 1000)] = 15.0
    """Flow below which windage takes work."""


class ExchangerSection(Section):
    """A counter-flow exchanger."""

    ua_w_per_k: HeatTransfer
    """Heat transfer coefficient times area."""
    volume_l: Litres
    """Of the high-pressure passes."""
    aluminium_kg: Mass
    """Of the walls."""

    def component(self, cells: int) -> HeatExchanger:
        """Return the exchanger in SI units."""
        return HeatExchanger(self.ua_w_per_k, self.volume_l / L_PER_M3, self.aluminium_kg, cells)


class Nef1Section(ExchangerSection):
    """The coldest exchanger, between the bath and the mixing point."""

    ua_w_per_k: HeatTransfer = 1400.0
    volume_l: Litres = 6.0
    aluminium_kg: Mass = 15.0


class Nef2Section(ExchangerSection):
    """The exchanger between the mixing point and the turbine's inlet."""

    ua_w_per_k: HeatTransfer = 2500.0
    volume_l: Litres = 6.0
    aluminium_kg: Mass = 15.0


class Nef34Section(ExchangerSection):
    """The exchanger from the turbine's inlet up to the nitrogen pre-cooler."""

    ua_w_per_k: HeatTransfer = 11_000.0
    volume_l: Litres = 30.0
    aluminium_kg: Mass = 80.0


class ReturnLineSection(Section):
    """The low-pressure side, by a pressure drop at a flow for each half; drops go with the square of the flow."""

    cold_drop_bar: Drop = 0.05
    """From the bath to the mixing point,"""
    cold_flow_g_per_s: Flow = 28.0
    """with this flow."""
    warm_drop_bar: Drop = 0.06
    """From the mixing point to the compressor,"""
    warm_flow_g_per_s: Flow = 73.0
    """with this flow."""


class BoundariesSection(Section):
    """What the cold box is given."""

    p_hp_bar: Annotated[float, within(*SUPPLY_BAR)] = 16.0
    """Supply pressure."""
    p_lp_bar: Annotated[float, within(SATURATION_BAR[0], 2)] = 1.05
    """Suction pressure of the compressor."""
    t_in_k: Annotated[float, within(30, 300)] = 80.0
    """Temperature after the nitrogen pre-cooler."""


class OperatingPointSection(Section):
    """Where the plant is at rest, and its model linear."""

    cv155_pct: Annotated[float, within(0, 100)] = OPERATING_INPUTS[0]
    ncr22_a_w: Annotated[float, within(0, 1000)] = OPERATING_INPUTS[1]
    cv156_pct: Annotated[float, within(0, 100)] = OPERATING_INPUTS[2]
    level_pct: Annotated[float, within(5, 95)] = OPERATING_LEVEL
    """L1; the load is what the box then cools beside its heater."""

    @property
    def inputs(self) -> tuple[float, float, float]:
        """CV155 %, NCR22_A W, CV156 %."""
        return (self.cv155_pct, self.ncr22_a_w, self.cv156_pct)


class BoxParameters(Section):
    """The parameters of a cold box."""

    bath: BathSection = BathSection()
    cv155: JtValveSection = JtValveSection()
    turbine: TurbineSection = TurbineSection()
    nef1: Nef1Section = Nef1Section()
    nef2: Nef2Section = Nef2Section()
    nef34: Nef34Section = Nef34Section()
    return_line: ReturnLineSection = ReturnLineSection()
    boundaries: BoundariesSection = BoundariesSection()

    @property
    def box(self) -> ColdBox:
        """The cold box, in SI units."""
        bath, turbine, line, given = self.bath, self.turbine, self.return_line, self.boundaries
        return ColdBox(
            separator=PhaseSeparator(
                bath.volume_m3, bath.wall_kg, bath.relief_pressure_bar * PA_PER_BAR, bath.relief_span_bar * PA_PER_BAR,
                bath.relief_area_mm2 / MM2_PER_M2,
            ),
            jt_valve=Valve(self.cv155.area_mm2 / MM2_PER_M2),
            turbine=Turbine(
                Valve(turbine.cv156_area_mm2 / MM2_PER_M2), turbine.nozzle_g_sqrt_k_per_s_bar / NOZZLE_UNITS,
                turbine.efficiency, turbine.speed_hz_per_sqrt_j_per_kg, turbine.windage_g_per_s / G_PER_KG,
            ),
            nef1=self.nef1.component(CELLS[0]),
            nef2=self.nef2.component(CELLS[1]),
            nef34=self.nef34.component(CELLS[2]),
            return_line=ReturnLine(
                line.cold_drop_bar * PA_PER_BAR / (line.cold_flow_g_per_s / G_PER_KG) ** 2,
                line.warm_drop_bar * PA_PER_BAR / (line.warm_flow_g_per_s / G_PER_KG) ** 2,
            ),
            P_HP=given.p_hp_bar * PA_PER_BAR,
            P_LP=given.p_lp_bar * PA_PER_BAR,
            T_in=given.t_in_k,
        )  # fmt: skip


class PlantFile(BoxParameters):
    """A cold box and its operating point."""

    operating_point: OperatingPointSection = OperatingPointSection()

    @property
    def parameters(self) -> dict[str, Any]:
        """What a model file says of the plant; nothing where it is the reference plant."""
        return {} if self.box == REFERENCE else self.model_dump(exclude={"operating_point"})

    def scaled(self, key: str, factor: float) -> ColdBox:
        """Return the cold box with one parameter, such as `nef1.ua_w_per_k`, multiplied by a factor."""
        section, _, name = key.partition(".")
        part = getattr(self, section)
        changed = part.model_copy(update={name: factor * getattr(part, name)})
        return self.model_copy(update={section: changed}).box
