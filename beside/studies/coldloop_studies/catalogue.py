"""All studies by name."""

from typing import Final

from coldloop_studies.beyond.any_process import CompareStudy, PeriodsStudy
from coldloop_studies.beyond.contest import ClassicalStudy, ContestStudy
from coldloop_studies.beyond.penalties import PenaltiesStudy
from coldloop_studies.beyond.refrigerator import CouplingStudy, DisturbancesStudy
from coldloop_studies.beyond.robustness import RobustnessStudy
from coldloop_studies.paper.reference_plc import CholeskyStudy, SinglePrecision
from coldloop_studies.paper.solver_comparison import SolverComparison
from coldloop_studies.paper.trajectories import (
    ADAPTIVE_2H,
    LIMITED_STUDY,
    PLC_2H,
    TRAJECTORIES_STUDY,
    UNLIMITED_STUDY,
    TradeOff,
)
from coldloop_studies.paper.updating_period import UpdatingPeriodStudy
from coldloop_studies.study import Study

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
"""Studies of the report, in the order of the paper."""

_APART: Final[tuple[Study, ...]] = (RobustnessStudy(), ContestStudy(), PenaltiesStudy(), PeriodsStudy(), CompareStudy())
APART: Final = {study.name: study for study in _APART}
"""Studies that are too long for the report."""
