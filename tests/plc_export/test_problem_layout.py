"""What a README says of the elements of z and of the rows is what the problem makes of them."""

import re

import numpy as np

from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_export.folder import problem_layout
from coldloop_export.golden import paper_settings
from coldloop_rig.plc_sizing.budget import problem_of

PROBLEM, PREDICTION = problem_of(paper_settings(DEFAULT_MODEL_FILE))
TEXT = problem_layout(PROBLEM, PREDICTION)
K, INSTANT = 2, 20
"""A decision instant, and when it is, s."""


def element(described: str) -> int:
    """Return the element of z at decision instant K of the line that begins so."""
    found = re.search(rf"^\| `z\[(\d+) k(?: \+ (\d+))?\]` \| {re.escape(described)}", TEXT, re.MULTILINE)
    assert found, described
    return int(found[1]) * K + int(found[2] or 0)


def test_inputs_are_where_it_says_in_the_unit_that_it_says() -> None:
    assert "k from 0: 5, 10, 20, 40, 80, 250, 500 s" in TEXT
    for column, (described, value) in enumerate(
        {
            "CV155 at the decision instant k: (CV155 - 43 %) / 10 %": 53.0,
            "NCR22_A at the decision instant k: (NCR22_A - 75 W) / 50 W": 125.0,
            "CV156 at the decision instant k: (CV156 - 36 %) / 10 %": 46.0,
        }.items()
    ):
        z = np.zeros(PROBLEM.size, np.float32)
        z[element(described)] = 1.0
        before, then = PROBLEM.knots_to_samples[[INSTANT // 5 - 2, INSTANT // 5 - 1]] @ z[column : PROBLEM.n_inputs : 3]
        assert (before < 1.0, then) == (True, 1.0)
        u0, scale = PREDICTION.model.u0[column], PROBLEM.design.input_scale[column]
        assert u0 + scale * then == value


def test_slacks_widen_the_rows_that_it_says() -> None:
    for described, first in (
        ("slack: how far L1 is below", 0), ("slack: how far L1 is above", 1),
        ("slack: how far T5 is below", 2), ("slack: how far T5 is above", 3),
    ):  # fmt: skip
        (rows,) = np.nonzero(PROBLEM.Gamma[:, element(described)])
        at_instant = 4 * PROBLEM.design.constraint_instants.index(INSTANT // 5) + first
        assert at_instant in rows
        assert {int(row) % 4 for row in rows} == {first}
        assert max(rows) < 56
    assert "| 0 to 55 | L1 and T5" in TEXT
    assert f"| 56 to {len(PROBLEM.Gamma) - 1} | changes of inputs" in TEXT
