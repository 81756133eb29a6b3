"""The cold box at its operating point, and its linear model as both PLCs run it, as text."""

from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from coldloop.errors import ModelFileError, printable
from coldloop.process.cold_box import L1, T5
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.model_file import COLD_BOX
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_plant.cold_box import ColdBox
from coldloop_plant.cold_box import model as cold_box
from coldloop_plant.cold_box.plant_file import PlantFile
from coldloop_plant.helium import load_helium
from coldloop_plant.kinds import kind_named
from coldloop_plant.settings import StationSettings

DEFAULT_CONTROL: Final = StationSettings()
HORIZON_S = 100.0
"""Time after which the gains are given: the level integrates, so there are no final ones."""


def describe_model(
    in_use: Path, plant: PlantFile, design: ControlDesign, control: StationSettings = DEFAULT_CONTROL
) -> tuple[LtiModel, str, ColdBox]:
    """Solve for the operating point and linearise there; return the model and its description.

    The cold box with them has the temperature after the pre-cooler that it has at steady state.

    Args:
        in_use: Model file that is configured, which is compared by its digest.
        plant: The cold box or the refrigerator, and its operating point.
        design: Whose bands the outputs at rest are compared with.
        control: Of a refrigerator's pressures; its weights decide the gains.

    Raises:
        NoEquilibriumError: The plant does not come to rest there; one line that says why.
    """
    helium = load_helium()
    if plant.kind == COLD_BOX:
        found = cold_box.operating_point(plant, helium)
        at_rest = cold_box.AtRest(found, plant.box, cold_box.model_at(found, plant.box, helium, plant.parameters))
    else:
        at_rest = kind_named(plant.kind).at_rest(plant, control)
    rest, box, model, lines_of_kind = at_rest
    error = cold_box.linearisation_error(rest.x, rest.u, rest.w, box, helium)
    values = sorted(np.linalg.eigvals(model.A), key=lambda value: -value.real)
    texts = [f"{v.real:.4f}" if abs(v.imag) < 1e-12 else f"{v.real:.4f}{v.imag:+.4f}i" for v in values]
    held = model.discretised(HORIZON_S)
    effects = np.column_stack([model.C @ held.B + model.D, model.C @ held.F + model.G])
    given = zip(model.input_names, rest.u, model.input_units, strict=True)
    inputs = ", ".join(f"{name} {value:g} {unit}" for name, value, unit in given)
    found_outputs = zip(model.output_names, rest.y, model.output_units, strict=True)
    outputs = [f"{name} {value:.4f} {unit}" for name, value, unit in found_outputs]
    signals = zip((*model.input_names, model.load_name), (*model.input_units, model.load_unit), strict=True)
    kink = "kink       derivatives differ on both sides: the second law limits cells of NEF1 or NEF2; less UA there"
    lines = [
        f"operating point: {inputs}, load {rest.w:.2f} W; cold power {rest.w + rest.u[1]:.2f} W",
        f"residual   {rest.residual:.2e} per second (2 kPa, 1 % of level, 1 K)",
        *(f"outputs    {'  '.join(outputs[i : i + 6])}" for i in range(0, len(outputs), 6)), *lines_of_kind,
        *(f"eigenvalues {'  '.join(texts[i : i + 10])} /s" for i in range(0, len(texts), 10)),
        f"derivatives within {error:.1e} of extrapolated central differences (scaled)",
        *(f"after {HORIZON_S:g} s of +1 {unit} {name}: L1 {effects[L1, i]:+.5f} %, T5 {effects[T5, i]:+.5f} K"
          for i, (name, unit) in enumerate(signals)),
        *([kink] if error >= 1e-3 else []), *_band_lines(rest, design), f"model      sha256 {model.digest}",
    ]  # fmt: skip
    with suppress(ModelFileError):  # the command then says what is wrong with it
        configured = load(in_use)
        lines.append(f"in use     sha256 {configured.digest} ({in_use})")
        lines += [f"           {printable(configured.note)}"] if configured.note else []
    return model, "\n".join(lines) + "\n", box


def held_line(box: ColdBox, level: float, design: ControlDesign, limits: InputLimits) -> str:
    """Return which loads are held with L1 as in its file and T5 within its band: some seconds of computing."""
    openings = [np.linspace(limits.low[k], limits.high[k], count) for k, count in ((0, 21), (2, 3))]  # CV155, CV156
    heater, warmth = (limits.low[1], limits.high[1]), (design.output_low[1], design.output_high[1])
    try:
        with np.errstate(all="ignore"):
            least, largest = cold_box.held_loads(box, load_helium(), level, openings[0], heater, openings[1], warmth)
    except ValueError:
        return "holds      no load with T5 within its band\n"
    loads = f"[{max(least.w, 0.0):.0f},{max(largest.w - cold_box.LOOP_MARGIN, 0.0):.0f}]"
    return f"holds      loads of {loads} W at least: --set optimizer_plc.program.holdable_load_w={loads}\n"


def _band_lines(rest: cold_box.Equilibrium, design: ControlDesign) -> list[str]:
    """Return the settings to change where a steady-state output is outside its band."""
    bands = zip((L1, T5), ("L1", "T5"), ("%", "K"), design.output_low, design.output_high, strict=True)
    return [
        f"outside    {name} rests at {rest.y[k]:.2f} {unit}, its band is {low:g} to {high:g} {unit}: set"
        " optimizer_plc.program.design.output_low and output_high, and the bands of control_plc.alarms"
        for k, name, unit, low, high in bands
        if not low <= rest.y[k] <= high
    ]
