"""What the vectors of the exported solver's problem hold, for who calls it: as text for a README."""

from coldloop.process.signals import INPUT_NAMES, INPUT_UNITS, OUTPUT_NAMES, OUTPUT_UNITS, SAMPLING_PERIOD_S
from optimizer_plc.qp.design import N_INPUTS, N_SLACKS
from optimizer_plc.qp.prediction import PredictionModel
from optimizer_plc.qp.problem import PredictiveProblem
from rig.text_tables import markdown_table


def problem_layout(problem: PredictiveProblem, prediction: PredictionModel) -> str:
    """Return tables of the elements of z and of the rows of Gamma, with names, units and instants."""
    design, behind = problem.design, problem.n_inputs
    inputs = zip(INPUT_NAMES, INPUT_UNITS, prediction.model.u0, design.input_scale, strict=True)
    variables = [
        (_element(N_INPUTS, i), f"{name} at the decision instant k: ({name} - {at:.6g} {unit}) / {scale:g} {unit}")
        for i, (name, unit, at, scale) in enumerate(inputs)
    ]
    for band, output in enumerate(prediction.constrained):
        for end, where in enumerate(("below", "above")):
            what = f"slack: how far {OUTPUT_NAMES[output]} is {where} its band there, {OUTPUT_UNITS[output]}"
            variables.append((_element(N_SLACKS, behind + 2 * band + end), what))
    bands = " and ".join(OUTPUT_NAMES[output] for output in prediction.constrained)
    count = 2 * len(prediction.constrained) * len(design.constraint_instants)
    constrained = _instants(design.constraint_instants)
    rows = [(f"0 to {count - 1}", f"{bands}, each below and above its band, at {constrained}")]
    if count < len(problem.Gamma):
        moved = "changes of inputs from one decision instant to the next, up and down"
        rows.append((f"{count} to {len(problem.Gamma) - 1}", moved))
    decided = f"\nDecision instants, k from 0: {_instants(design.decision_instants)}.\n"
    return "\n".join([markdown_table(("variable", "what"), variables), decided, markdown_table(("rows", "what"), rows)])


def _element(step: int, first: int) -> str:
    """Return the name of every `step`-th element of z."""
    return f"`z[{f'{step} k' if step > 1 else 'k'}{f' + {first}' if first else ''}]`"


def _instants(samples: tuple[int, ...]) -> str:
    return ", ".join(f"{sample * SAMPLING_PERIOD_S:g}" for sample in samples) + " s"
