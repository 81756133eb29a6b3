"""What the vectors of the exported solver's problem hold, for who calls it: as text for a README."""

from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem
from coldloop_rig.text_tables import markdown_table


def problem_layout(problem: PredictiveProblem, prediction: PredictionModel) -> str:
    """Return tables of the elements of z and of the rows of Gamma, with names, units and instants."""
    design, behind = problem.design, problem.n_inputs
    process = prediction.process
    inputs = zip(process.input_names, process.input_units, prediction.model.u0, design.input_scale, strict=True)
    variables = [
        (
            _element(design.n_inputs, i),
            f"{name} at the decision instant k: ({name} - {at:.6g} {unit}) / {scale:g} {unit}",
        )
        for i, (name, unit, at, scale) in enumerate(inputs)
    ]
    for band, output in enumerate(prediction.constrained):
        for end, where in enumerate(("below", "above")):
            one = process.outputs[output]
            what = f"slack: how far {one.name} is {where} its band there, {one.unit}"
            variables.append((_element(design.n_slacks, behind + 2 * band + end), what))
    bands = " and ".join(process.output_names[output] for output in prediction.constrained)
    count = 2 * len(prediction.constrained) * len(design.constraint_instants)
    constrained = _instants(design.constraint_instants, process.sampling_period_s)
    rows = [(f"0 to {count - 1}", f"{bands}, each below and above its band, at {constrained}")]
    if count < len(problem.Gamma):
        moved = "changes of inputs from one decision instant to the next, up and down"
        rows.append((f"{count} to {len(problem.Gamma) - 1}", moved))
    decided = f"\nDecision instants, k from 0: {_instants(design.decision_instants, process.sampling_period_s)}.\n"
    return "\n".join([markdown_table(("variable", "what"), variables), decided, markdown_table(("rows", "what"), rows)])


def _element(step: int, first: int) -> str:
    """Return the name of every `step`-th element of z."""
    return f"`z[{f'{step} k' if step > 1 else 'k'}{f' + {first}' if first else ''}]`"


def _instants(samples: tuple[int, ...], sampling_period_s: float) -> str:
    return ", ".join(f"{sample * sampling_period_s:g}" for sample in samples) + " s"
