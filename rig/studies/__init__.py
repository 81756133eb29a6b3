"""Studies: questions that take many runs, by name. One file each; `study.py` says what a study is."""

from typing import Final

from rig.studies.cholesky import CholeskyStudy
from rig.studies.classical import ClassicalStudy
from rig.studies.contest import ContestStudy
from rig.studies.coupling import CouplingStudy
from rig.studies.disturbances import DisturbancesStudy
from rig.studies.experiments import ADAPTIVE_2H, PLC_2H
from rig.studies.oracles import OraclesStudy
from rig.studies.penalties import PenaltiesStudy
from rig.studies.robustness import RobustnessStudy
from rig.studies.single_precision import SinglePrecision
from rig.studies.solver_comparison import SolverComparison
from rig.studies.study import Study
from rig.studies.trade_off import TradeOff
from rig.studies.trajectories import LIMITED_STUDY, TRAJECTORIES_STUDY, UNLIMITED_STUDY
from rig.studies.updating_period import UpdatingPeriodStudy

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

_APART: Final[tuple[Study, ...]] = (OraclesStudy(), RobustnessStudy(), ContestStudy(), PenaltiesStudy())
APART: Final = {study.name: study for study in _APART}
"""Those that are too long for the report."""
