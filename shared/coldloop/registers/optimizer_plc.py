"""Register map of the optimiser PLC: the results of each update, and the settings of a session."""

from functools import cache
from typing import Annotated, Final, NamedTuple

from coldloop.process.declaration import Process
from coldloop.registers import common
from coldloop.registers import declaration as reg
from coldloop.registers.control_plc import Verdict
from coldloop.registers.declaration import Block, Numbers, RegisterMap, Role, Worded

HISTORY_ROWS: Final = 256
PREDICTED_SAMPLES: Final = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 80, 100)
"""Sampling periods ahead at which predicted outputs are shown."""
INPUT_SAMPLES: Final = (1, 2, 4, 8, 16, 50, 100)
"""Sampling periods ahead at which planned inputs are shown."""


def _ahead(process: Process, samples: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(f"{sample * process.sampling_period_s:g}s" for sample in samples)


def _predicted(process: Process) -> reg.Field:
    fields = [
        (f"{one.name.lower()}.{time}", reg.f32(f"Predicted {one.name}", unit=one.unit))
        for one in process.banded
        for time in _ahead(process, PREDICTED_SAMPLES)
    ]
    names, each = zip(*fields, strict=True) if fields else ((), ())
    return reg.f32("Predicted output", elements=names, units=tuple(one.unit for one in each), each=each)


def _planned(process: Process) -> reg.Field:
    names = tuple(f"{name}.{time}" for time in _ahead(process, INPUT_SAMPLES) for name in process.input_names)
    return reg.f32("Planned input", elements=names, units=process.input_units * len(INPUT_SAMPLES))


class OptimizerSession(NamedTuple):
    """Settings of a session, taken when its first update arrives."""

    session: Annotated[int, reg.u32("Number of the session", low=1)]
    realtime: Annotated[int, reg.u16("{}: answers are delayed as by the PLC", high=1, values=common.TimeBaseKind)]
    factor: Annotated[float, reg.f32("Seconds of plant time in one second of real time", low=0.01, high=10_000)]
    updating_period: Annotated[
        int,
        lambda process: reg.u16(
            "Fixed updating period, 2 or more; 0 is adaptive", unit=process.tick_unit, high=process.ticks_per_sample
        ),
    ]


class ControlLinkState(Worded):
    """State of the optimiser's link to the control PLC."""

    SEARCHING = 0
    """The control PLC does not answer."""
    INTRODUCING = 1
    """It answers: its identity and model are being checked."""
    WAITING = 2
    """For the next update."""
    COMPUTING = 3
    DELIVERING = 4
    OTHER_MASTER = 5
    """Another optimiser holds the lease."""
    WRONG_MODEL = 6
    """The control PLC runs another model."""


class ControlLinkStatus(NamedTuple):
    """The optimiser's link to the control PLC."""

    state: Annotated[int, reg.u16("{}", values=ControlLinkState)] = ControlLinkState.SEARCHING
    holder: Annotated[int, reg.u32("Number chosen by this optimiser")] = 0
    breaks: Annotated[int, reg.u32("Times that the link was lost")] = 0
    damaged: Annotated[int, reg.u32("Answers with a broken seal")] = 0
    rejected: Annotated[int, reg.u32("Sequences that the control PLC has rejected")] = 0
    interrupted: Annotated[int, reg.u32("Computations abandoned for a newer update")] = 0


class Optimization(NamedTuple):
    """Result of the optimiser between two updating instants. Costs are those of the augmented cost function J.

    A cost may be infinite, and a rate no number, where nothing was iterated.
    """

    update: Annotated[int, reg.u32("Update")]
    tick: Annotated[int, reg.u32("Tick of the updating instant t_i")]
    tau_u: Annotated[int, reg.in_ticks(reg.u16("Updating period t_{i+1} - t_i"))]
    q: Annotated[int, reg.u16("q(t_i): the number of the period that the rule chose in the ladder of periods")]
    iterations: Annotated[int, reg.u16("Iterations done: what fits into that period, or fewer if more change nothing")]
    verdict: Annotated[int, reg.u16("Verdict of the control PLC on the sequence", values=Verdict)]
    j_effective: Annotated[float, reg.f32("J_i: the profile being played, at the state reached", finite=False)]
    j_hot_start: Annotated[float, reg.f32("J+_i: the shifted profile, at the predicted state", finite=False)]
    j_delivered: Annotated[float, reg.f32("Ĵ_{i+1}: the delivered profile, at the predicted state", finite=False)]
    j_dev: Annotated[float, reg.f32("Predicted deviation cost of the delivered profile", finite=False)]
    j_cst: Annotated[float, reg.f32("Predicted constraint violation cost of the delivered profile", finite=False)]
    violation: Annotated[
        float, reg.f32("Largest violated row, max(Gamma p - gamma, 0), of the delivered profile", finite=False)
    ]
    efficiency: Annotated[float, reg.f32("E^r of Algorithm 1", finite=False)]
    mismatch: Annotated[float, reg.f32("D^r of Algorithm 1", finite=False)]
    contraction: Annotated[float, reg.f32("K^r of Algorithm 1", finite=False)]
    gamma: Annotated[float, reg.f32("Γ of Algorithm 1, the gradient that decides the next step in q", finite=False)]
    load_mismatch: Annotated[float, reg.of_load("Estimated load mismatch", finite=False)]


class UpdatingRuleKind(Worded):
    """Kind of rule that decides the updating period."""

    FIXED = 0, "fixed period"
    """It is always the same."""
    ALGORITHM_1 = 1, "Algorithm 1"
    """The rule of the paper."""
    CONTRACTION = 2, "contraction rule"
    """The rule of this project."""
    OUTSIDE = 3, "other"
    """Somebody else's."""


class UpdatingRuleStatus(NamedTuple):
    """The rule that decides the updating period in this session, and the time that the computation takes."""

    rule: Annotated[int, reg.u16("{}", values=UpdatingRuleKind)] = UpdatingRuleKind.FIXED
    q_first: Annotated[int, reg.u16("q of the first period, and of one that follows an interruption")] = 0
    q_min: Annotated[int, reg.u16("Least q that the rule chooses")] = 0
    q_max: Annotated[int, reg.u16("Largest q that the rule chooses")] = 0
    delta: Annotated[int, reg.u16("Step of Algorithm 1 in q; 0 for other rules")] = 0
    slots: Annotated[float, reg.f32("Time reserved in a period for the preparation", unit="s")] = 0.0
    preparation: Annotated[float, reg.f32("Duration of the preparation", unit="s")] = 0.0
    iteration: Annotated[float, reg.f32("Duration of an iteration", unit="s")] = 0.0


class OperatingLimits(NamedTuple):
    """Limits that the optimiser keeps the process within: bands of constrained outputs, bounds and rates of inputs."""

    output_low: Annotated[Numbers, reg.of_banded("Low end of the band")]
    output_high: Annotated[Numbers, reg.of_banded("High end of the band")]
    input_low: Annotated[Numbers, reg.of_inputs("Lowest value")]
    input_high: Annotated[Numbers, reg.of_inputs("Highest value")]
    input_rate: Annotated[Numbers, reg.of_inputs("Largest change in a sampling period")]


class Prediction(NamedTuple):
    """Prediction for the last delivered sequence. Behind the horizon: the value at its end."""

    update: Annotated[int, reg.u32("Update that the prediction belongs to")]
    tick: Annotated[int, reg.u32('Tick at which its sequence begins, t_{i+1}; element "5s" is 5 s later')]
    y: Annotated[Numbers, _predicted]
    """Values of one output that has a band after the other, at `PREDICTED_SAMPLES`."""
    u: Annotated[Numbers, _planned]
    crc: Annotated[int, reg.u32("CRC-32 of the registers before")] = 0


def outputs_of(prediction: Prediction) -> tuple[Numbers, ...]:
    """Return the prediction of each output that has a band, at `PREDICTED_SAMPLES`."""
    samples = len(PREDICTED_SAMPLES)
    return tuple(prediction.y[start : start + samples] for start in range(0, len(prediction.y), samples))


class ModelDeviation(NamedTuple):
    """Deviation of the plant from its model, as the filter estimates it; also 0 where nothing is estimated."""

    load: Annotated[float, reg.of_load("{word} beyond what is measured or, unmeasured, usual", finite=False)]
    u: Annotated[Numbers, reg.of_inputs("Acts like so much more of the input", finite=False)]
    y: Annotated[Numbers, reg.of_outputs("Constant difference of the reading from the model's", finite=False)]
    surprise: Annotated[
        Numbers,
        reg.of_outputs(
            "How far the reading was from what prediction and other readings say, over what the filter expects: "
            "root mean square over a minute; about 1 or less is as designed",
            unit="",
            finite=False,
        ),
    ]


@cache
def optimizer_map(process: Process) -> RegisterMap:
    """Return the map of the optimiser of a process."""
    blocks = (
        common.IDENTITY_BLOCK, Block("session", 30, OptimizerSession, "Settings of the next session", Role.OPERATOR),
        Block("control link", 40, ControlLinkStatus, "Link to the control PLC"), common.STATISTICS_BLOCK,
        Block("pace", 100, common.SessionPace, "Time base of the present session", Role.OPERATOR),
        Block("updating rule", 120, UpdatingRuleStatus, "What decides the updating period"),
        Block("operating limits", 140, OperatingLimits, "Bands of the outputs, bounds and rates of the inputs"),
        Block("prediction", 200, Prediction, "Predicted result of the last sequence", sealed=True),
        Block("model deviation", 320, ModelDeviation, "How the plant differs from the prediction model"),
        Block("history", 16384, Optimization, "The last updates", rows=HISTORY_ROWS), *common.LAST_BLOCKS,
    )  # fmt: skip
    return RegisterMap(service="optimizer_plc", version=4, blocks=reg.placed(process, blocks))
