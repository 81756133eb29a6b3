"""Studies: questions that take many runs, by name. One file each; `study.py` says what a study is."""

from typing import Final

from coldloop_rig.studies.beyond.any_process import CompareStudy, PeriodsStudy
from coldloop_rig.studies.beyond.contest import ClassicalStudy, ContestStudy
from coldloop_rig.studies.beyond.penalties import PenaltiesStudy
from coldloop_rig.studies.beyond.refrigerator import CouplingStudy, DisturbancesStudy
from coldloop_rig.studies.beyond.robustness import RobustnessStudy
from coldloop_rig.studies.paper.reference_plc import CholeskyStudy, SinglePrecision
from coldloop_rig.studies.paper.solver_comparison import SolverComparison
from coldloop_rig.studies.paper.trajectories import (
    ADAPTIVE_2H,
    LIMITED_STUDY,
    PLC_2H,
    TRAJECTORIES_STUDY,
    UNLIMITED_STUDY,
    TradeOff,
)
from coldloop_rig.studies.paper.updating_period import UpdatingPeriodStudy
from coldloop_rig.studies.study import Study

_ALL: Final[tuple[Study, ...]] = (
    CholeskyStudy(),
    UNLIMITED_STUDY,
    LIMITED_STUDY,
    SolverComparison(),
    TRAJECTORIES_STUDY,
    UpdatingPeriodStudy(),
    PLC_2H,
    ADAPTIVE_2H,
    TradeOff(),
    ClassicalStudy(),
    SinglePrecision(),
    CouplingStudy(),
    DisturbancesStudy(),
)

STUDIES: Final = {study.name: study for study in _ALL}
"""Those of the report, in the order of the paper."""

_APART: Final[tuple[Study, ...]] = (RobustnessStudy(), ContestStudy(), PenaltiesStudy(), PeriodsStudy(), CompareStudy())
APART: Final = {study.name: study for study in _APART}
"""Those that are too long for the report."""
