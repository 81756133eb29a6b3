"""Compiled loops of other processes leave what the programs leave."""

from pathlib import Path
from typing import Final

import pytest

from coldloop_rig.process_file.making import made_from
from tests.harness.process_configurations import CASES
from tests.harness.process_files import PROCESSES
from tests.process.both_ways import both_ways

USUALLY: Final = {"matrices", "foreseen"}


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in USUALLY else pytest.mark.night) for name in CASES]
)
def test_compiled_loops_leave_what_the_programs_leave(name: str, tmp_path: Path) -> None:
    case, model = CASES[name], tmp_path / "model.json"
    made_from(PROCESSES[case.process](tmp_path)).model.save(model)
    left = both_ways(model, 1500, case.load, case.assignments)
    assert left.same == [True] * 4, "trace, updates, events, sensors"
    assert left.late == 0, "kernels that were compiled in the session of the programs"
    assert left.ticks >= case.ticks
    assert left.updates >= case.updates * left.all_updates
    assert case.events <= left.events
