"""The cold box at its operating point, and its linear model as both PLCs run it, as text."""

from pathlib import Path

import numpy as np

from coldloop.errors import ModelFileError, printable
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.signals import L1, T5
from plant.cold_box.equilibrium import Equilibrium, find_equilibrium
from plant.cold_box.linearisation import linearisation_error
from plant.cold_box.model import OPERATING_INPUTS, OPERATING_LEVEL, build_model
from plant.cold_box.physics import REFERENCE
from plant.helium.properties import load_helium

HORIZON_S = 100.0
"""Time after which the gains are given: the level integrates, so there are no final ones."""


def describe_model(in_use: Path) -> tuple[LtiModel, str]:
    """Solve for the operating point and linearise there; return the model and its description.

    Args:
        in_use: Model file that is configured, which is compared by its digest.
    """
    helium = load_helium()
    rest = find_equilibrium(np.array(OPERATING_INPUTS), OPERATING_LEVEL, REFERENCE, helium)
    model = build_model(REFERENCE)
    error = linearisation_error(rest.x, rest.u, rest.w, REFERENCE, helium)
    lines = [
        *_equilibrium_lines(model, rest),
        *_eigenvalue_lines(model, error),
        *_gain_lines(model),
        f"model      sha256 {model.digest}",
        *_in_use_line(in_use),
    ]
    return model, "\n".join(lines) + "\n"


def _in_use_line(file: Path) -> list[str]:
    """Return digest and note of the configured model; nothing where there is none, which the command then says."""
    try:
        model = load(file)
    except ModelFileError:
        return []
    note = [f"           {printable(model.note)}"] if model.note else []
    return [f"in use     sha256 {model.digest} ({file})", *note]


def _equilibrium_lines(model: LtiModel, rest: Equilibrium) -> list[str]:
    inputs = ", ".join(
        f"{name} {value:g} {unit}"
        for name, value, unit in zip(model.input_names, rest.u, model.input_units, strict=True)
    )
    outputs = [
        f"{name} {value:.4f} {unit}"
        for name, value, unit in zip(model.output_names, rest.y, model.output_units, strict=True)
    ]
    return [
        f"operating point: {inputs}, load {rest.w:.2f} W; cold power {rest.w + rest.u[1]:.2f} W",
        f"residual   {rest.residual:.2e} per second (2 kPa, 1 % of level, 1 K)",
        *(f"outputs    {'  '.join(outputs[i : i + 6])}" for i in range(0, len(outputs), 6)),
    ]


def _eigenvalue_lines(model: LtiModel, error: float) -> list[str]:
    values = sorted(np.linalg.eigvals(model.A), key=lambda value: -value.real)
    texts = [f"{v.real:.4f}" if abs(v.imag) < 1e-12 else f"{v.real:.4f}{v.imag:+.4f}i" for v in values]
    return [
        *(f"eigenvalues {'  '.join(texts[i : i + 10])} /s" for i in range(0, len(texts), 10)),
        f"derivatives within {error:.1e} of extrapolated central differences (scaled)",
    ]


def _gain_lines(model: LtiModel) -> list[str]:
    held = model.discretised(HORIZON_S)
    effects = np.column_stack([model.C @ held.B + model.D, model.C @ held.F + model.G])
    names = (*model.input_names, model.load_name)
    units = (*model.input_units, model.load_unit)
    return [
        f"after {HORIZON_S:g} s of +1 {unit} {name}: L1 {effects[L1, i]:+.5f} %, T5 {effects[T5, i]:+.5f} K"
        for i, (name, unit) in enumerate(zip(names, units, strict=True))
    ]
