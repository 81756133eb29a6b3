"""Compile the numerical kernels of a service or of the rig before they are needed: `python precompile.py SERVICE`."""  # noqa: INP001 a program

import sys
from typing import TYPE_CHECKING

from coldloop.model_file import read_header
from coldloop.model_settings import DEFAULT_MODEL_FILE
from coldloop.registers.plant import Measurement

if TYPE_CHECKING:
    from optimizer_plc.settings import ProgramSettings


def plant() -> None:
    """Go one tick forward with each plant."""
    from plant.kinds import plant_maker  # noqa: PLC0415 not in every image
    from plant.program import LoadProfile  # noqa: PLC0415
    from plant.settings import PlantKind, PlantSection  # noqa: PLC0415

    header = read_header(DEFAULT_MODEL_FILE)
    for kind in PlantKind:
        plant_maker(header, PlantSection(kind=kind))(LoadProfile((0,), (header.w0,)), 1).advance()


def control_plc() -> None:
    """Compile nothing: this service has no kernels."""


def optimizer_plc() -> None:
    """Let each solver that has kernels of its own answer two updates of a plant that stands still."""
    from optimizer_plc.settings import SINGLE_PRECISION_SOLVERS, ProgramSettings  # noqa: PLC0415

    for solver in SINGLE_PRECISION_SOLVERS:
        _answer_two_updates(ProgramSettings(solver=solver))


def _answer_two_updates(settings: "ProgramSettings") -> None:
    from coldloop.limits import InputLimits  # noqa: PLC0415
    from coldloop.lti_model import load  # noqa: PLC0415
    from control_plc.program import make_program  # noqa: PLC0415
    from control_plc.settings import ControlSection  # noqa: PLC0415
    from optimizer_plc.computing_settings import Arithmetic  # noqa: PLC0415
    from optimizer_plc.program import OptimizerProgram  # noqa: PLC0415

    model = load(DEFAULT_MODEL_FILE)
    limits = InputLimits()
    OptimizerProgram(model, settings.model_copy(update={"arithmetic": Arithmetic.FLOAT32}), limits)
    optimizer = OptimizerProgram(model, settings, limits)
    header = read_header(DEFAULT_MODEL_FILE)
    control = make_program(header, ControlSection(), limits)
    control.restart(1)
    updates = 0
    while updates < 2:
        if control.awaiting_sequence:
            control.offer(optimizer.solve())
        tick = control.begin_scan().tick
        update = control.end_scan(Measurement(tick, header.w0, header.y0, header.x0, 1))
        if update is not None:
            control.accept_plan(optimizer.plan(update))
            updates += 1


def hmi() -> None:
    """Compile nothing: the page has no kernels."""


def rig() -> None:
    """Let a minute pass in one process with each plant: compiled loops, and the programs for what is unusual."""
    from plant.settings import PlantKind  # noqa: PLC0415 not in every image
    from rig import simulate  # noqa: PLC0415 not in the images

    for kind in PlantKind:
        simulate(load="a", duration_s=60, plant={"kind": kind})


if __name__ == "__main__":
    {"plant": plant, "control_plc": control_plc, "optimizer_plc": optimizer_plc, "hmi": hmi, "rig": rig}[sys.argv[1]]()
