"""After a step of the integrator the cold box holds what the stages of the step brought it."""

from coldloop.kernels.compiled import inlined
from coldloop_plant.cold_box.physics import ColdBox
from coldloop_plant.components.cell_account import COARSE, settle_cells, widest_move
from coldloop_plant.components.phase_separator import Account, settle_account
from coldloop_plant.helium.properties import Helium
from coldloop_plant.numeric import RealArray


@inlined
def settle_box(
    box: ColdBox,
    account: Account,
    stages: RealArray,
    slopes: RealArray,
    dt: float,
    x: RealArray,
    helium: Helium,
) -> None:
    """Correct the bath and the cells in `x`, whose first 28 states are the cold box's, where they need it.

    Args:
        box: Parameters.
        account: Of the bath in this step, with the weights 1, 2, 2, 1.
        stages: States at the stages, shape (4, N).
        slopes: Their rates, shape (4, N).
        dt: Step, s.
        x: State after the step, shape (N,).
        helium: Tables.
    """
    settle_account(box.separator, account, dt / 6.0, x, helium)
    first2 = 2 + box.nef1.cells
    if widest_move(stages, x, 2, first2 + box.nef2.cells + box.nef34.cells) <= COARSE:
        return  # as nearly always
    settle_cells(box.nef1, 2, box.P_HP, stages, slopes, dt, x, helium)
    settle_cells(box.nef2, first2, box.P_HP, stages, slopes, dt, x, helium)
    settle_cells(box.nef34, first2 + box.nef2.cells, box.P_HP, stages, slopes, dt, x, helium)
