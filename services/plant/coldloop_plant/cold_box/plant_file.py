"""The plant file: the parameters of a cold box and its operating point, as a lab would write them down (TOML).

Every key is optional; the defaults are the reference plant. Numbers of cells are no keys: they name the states. The end
of a key names its unit; components have SI units.
"""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final

from pydantic import Field, model_validator
from pydantic.fields import FieldInfo

from coldloop.process import model_file, model_range, sections
from coldloop_plant.cold_box import CELLS, ColdBox
from coldloop_plant.components import expansion, heat_exchanger, phase_separator

IN_SI: Final = {
    "_g_sqrt_k_per_s_bar": (1.0, 1e8),  # kg sqrt(K)/(s Pa)
    "_bar": (1e5, 1.0),
    "_mm2": (1.0, 1e6),
    "_l": (1.0, 1e3),
    "_l_per_s": (1.0, 1e3),
    "_g_per_s": (1.0, 1e3),
    "_kj_per_k": (1e3, 1.0),
}
"""A unit's multiple of that of SI, as numerator and denominator; the first unit counts that a key ends with."""


def within(low: float, high: float) -> FieldInfo:
    """Return the range of a number; texts and truth values are none."""
    info: FieldInfo = Field(strict=True, ge=low, le=high)
    return info


class Section(sections.Section):
    """A section of a plant file."""

    @property
    def si(self) -> tuple[float, ...]:
        """Its values in the order of its keys, in SI."""
        found = []
        for key, value in self:
            numerator, denominator = next((ratio for unit, ratio in IN_SI.items() if key.endswith(unit)), (1.0, 1.0))
            found.append(value * numerator / denominator)
        return tuple(found)


LISTING: Final = "`coldloop docs your-refrigerator` lists the keys"

HeatTransfer = Annotated[float, within(10, 200_000)]
Litres = Annotated[float, within(0.1, 2000)]
Mass = Annotated[float, within(0.1, 20_000)]
Drop = Annotated[float, within(0.0001, 1)]
Flow = Annotated[float, within(0.1, 5000)]

OPERATING_INPUTS: Final = (43.0, 75.0, 36.0)  # CV155 %, NCR22_A W, CV156 %; left of the capacity maximum at 50 %
OPERATING_LEVEL: Final = 60.0  # %


class BathSection(Section):
    """The phase separator NS1: the fields of `PhaseSeparator`."""

    volume_m3: Annotated[float, within(0.005, 10)] = 0.2
    wall_kg: Annotated[float, within(0.1, 10_000)] = 50.0
    relief_pressure_bar: Annotated[float, within(*model_range.SATURATION_BAR)] = 1.8
    relief_span_bar: Annotated[float, within(0.01, 2)] = 0.3
    relief_area_mm2: Annotated[float, within(1, 100_000)] = 400.0


class JtValveSection(Section):
    """The Joule-Thomson valve CV155."""

    area_mm2: Annotated[float, within(0.05, 500)] = 3.9
    """Effective flow area when fully open."""


class TurbineSection(Section):
    """The turbine: the effective flow area of its inlet valve CV156 when fully open, and the fields of `Turbine`."""

    cv156_area_mm2: Annotated[float, within(0.5, 5000)] = 26.0
    nozzle_g_sqrt_k_per_s_bar: Annotated[float, within(0.5, 5000)] = 22.0
    """K of the choked nozzle, m = K P / sqrt(T) with m in g/s, P in bar, T in K."""
    efficiency: Annotated[float, within(0.2, 0.95)] = 0.7
    speed_hz_per_sqrt_j_per_kg: Annotated[float, within(0.1, 100)] = 10.0
    windage_g_per_s: Annotated[float, within(0.1, 1000)] = 15.0


class ExchangerSection(Section):
    """A counter-flow exchanger: the fields of `HeatExchanger`."""

    ua_w_per_k: HeatTransfer
    volume_l: Litres
    aluminium_kg: Mass

    def component(self, cells: int) -> heat_exchanger.HeatExchanger:
        """Return the exchanger in SI units."""
        conductance, volume, aluminium = self.si
        return heat_exchanger.HeatExchanger(conductance, volume, aluminium, cells)


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
    """Boundary conditions of the cold box: the last fields of `ColdBox`."""

    p_hp_bar: Annotated[float, within(*model_range.SUPPLY_BAR)] = 16.0
    p_lp_bar: Annotated[float, within(model_range.SATURATION_BAR[0], 2)] = 1.05
    t_in_k: Annotated[float, within(30, 300)] = 80.0


class OperatingPointSection(Section):
    """Operating point at which the plant is at rest and its model linearised."""

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
    """The parameters of a `ColdBox`; a section that is given in part has the rest of its default."""

    bath: BathSection = BathSection()
    cv155: JtValveSection = JtValveSection()
    turbine: TurbineSection = TurbineSection()
    nef1: ExchangerSection = ExchangerSection(ua_w_per_k=1400.0, volume_l=6.0, aluminium_kg=15.0)
    nef2: ExchangerSection = ExchangerSection(ua_w_per_k=2500.0, volume_l=6.0, aluminium_kg=15.0)
    nef34: ExchangerSection = ExchangerSection(ua_w_per_k=11_000.0, volume_l=30.0, aluminium_kg=80.0)
    return_line: ReturnLineSection = ReturnLineSection()
    boundaries: BoundariesSection = BoundariesSection()

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, given: Any) -> Any:  # noqa: ANN401 whatever a file holds
        if not isinstance(given, Mapping):
            return given
        usual = {name: field.default.model_dump() for name, field in cls.model_fields.items()}
        return {
            key: usual[key] | part if key in usual and isinstance(part, dict) else part for key, part in given.items()
        }

    @property
    def box(self) -> ColdBox:
        """The cold box, in SI units."""
        cv156, *turbine = self.turbine.si
        cold_drop, cold_flow, warm_drop, warm_flow = self.return_line.si
        supply, suction, T_in = self.boundaries.si
        return ColdBox(
            separator=phase_separator.PhaseSeparator(*self.bath.si),
            jt_valve=expansion.Valve(*self.cv155.si),
            turbine=expansion.Turbine(expansion.Valve(cv156), *turbine),
            nef1=self.nef1.component(CELLS[0]),
            nef2=self.nef2.component(CELLS[1]),
            nef34=self.nef34.component(CELLS[2]),
            return_line=expansion.ReturnLine(cold_drop / cold_flow**2, warm_drop / warm_flow**2),
            P_HP=supply,
            P_LP=suction,
            T_in=T_in,
        )


REFERENCE: Final = BoxParameters().box


class PlantFile(BoxParameters):
    """A cold box and its operating point."""

    kind: ClassVar[str] = model_file.COLD_BOX
    """Name of the kind of plant that it describes."""
    operating_point: OperatingPointSection = OperatingPointSection()

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the plant in a model file; empty for the reference plant."""
        return {} if self.box == REFERENCE else self.model_dump(exclude={"operating_point"})

    def scaled(self, key: str, factor: float) -> ColdBox:
        """Return the cold box with one parameter, such as `nef1.ua_w_per_k`, multiplied by a factor."""
        section, _, name = key.partition(".")
        part = getattr(self, section)
        changed = part.model_copy(update={name: factor * getattr(part, name)})
        return self.model_copy(update={section: changed}).box
