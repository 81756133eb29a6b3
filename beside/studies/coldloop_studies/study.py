"""A study: its extent, its loads, its runs, and the evaluation of their outcomes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from matplotlib.figure import Figure

from coldloop import config, errors, text
from coldloop.process import declaration, load_profile, lti_model
from coldloop_plant.load import find_load, named_families
from coldloop_rig.cosim.scenario import natural_ticks
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import Cell
from coldloop_studies.request import Outcome, Procedure, RunRequest
from coldloop_studies.settings import PAPER, outside_digests, settings_of

Outcomes = Mapping[RunRequest, Outcome]
USUAL_DRAWS = 3
"""Draws of each load, unless the study or the command sets another number."""
RUNS = "runs"
"""Folder, beside those of the studies, in which runs are kept: studies share them."""


def noise(factor: float) -> tuple[str, ...]:
    """Return settings of measurement noise, `factor` times the noise that the Kalman filter assumes."""
    sizes = {"level": 0.01, "speed": 1.0, "temperature": 0.02, "pressure": 0.001}
    return tuple(f"plant.sensors.{name}={factor * size:g}" for name, size in sizes.items())


NOISE = noise(1.0)
PROGRAM = "optimizer_plc.program."
TUNED: Final = f"{PROGRAM}preset=tuned"
"""Assignment of the default preset of `coldloop run`."""


class Variant(NamedTuple):
    """Configuration that the study `compare` compares with others."""

    name: str
    assignments: tuple[str, ...]
    """`section.key=value`, from the preset `paper` on."""


@dataclass(frozen=True)
class StudyOptions:
    """Extent of a study."""

    seeds: int | None = None
    """Draws of each named load, if not the study's own number; of a load file, draws of the sensors' noise."""
    ticks: int | None = None
    """Length of each run, if not that of its load."""
    loads: tuple[str, ...] = ()
    """Names or files, instead of the study's own."""
    quick: bool = False
    """One seed, ten minutes, fewer points: to see that it works."""
    variants: tuple[Variant, ...] = ()
    """Variants of the study `compare`; the first is the reference."""
    settings: tuple[str, ...] = ()
    """Settings of all runs, as `section.key=value`: `model.file` of another process than the cold box."""

    @property
    def process(self) -> declaration.Process:
        """The process of all runs."""
        return settings_of(self.settings).process

    @property
    def draws(self) -> range:
        """Default numbers of the draws."""
        return self.drawn(USUAL_DRAWS)

    def drawn(self, usual: int) -> range:
        """Return the numbers of the draws of a study, or of a part of it, that has so many of its own."""
        return range(1, (1 if self.quick else self.seeds or usual) + 1)

    @property
    def hours(self) -> str:
        """The families of hours of a study that compares periods."""
        return "ace" if self.quick else "abcdef"


@dataclass(frozen=True)
class Load:
    """One draw of a load, and how long it is run."""

    name: str
    draw: int
    profile: load_profile.LoadProfile
    ticks: int
    settings: tuple[str, ...] = ()
    """Settings of its runs: those of the study, and noise."""

    def request(
        self, updating_period_s: float, *assignments: str, networked: bool = False, trace_ticks: int = 0,
        procedure: Procedure = Procedure.CONFIGURED,
    ) -> RunRequest:  # fmt: skip
        """Return the request for a run under this load."""
        return RunRequest(
            self.name, self.profile.times, self.profile.watts, self.ticks, updating_period_s,
            (*self.settings, *assignments), self.draw, networked, trace_ticks, procedure,
        )  # fmt: skip


def draw_of(name: str, draw: int, options: StudyOptions) -> Load:
    """Return a draw of a load; the draws of a file differ by their noise, which there is when there are several."""
    named = named_families(name) is not None
    drawn = f"{name}@{draw}" if named and draw > 1 else name
    settings = settings_of(options.settings)
    profile = find_load(drawn, lti_model.load(settings.model.file).w0, settings.process)
    ticks = options.ticks or natural_ticks(drawn, profile)
    ticks = min(ticks, 2400) if options.quick else ticks  # ten minutes
    noise = NOISE if not named and len(options.draws) > 1 else ()
    return Load(drawn if named or draw == 1 else f"{name}#{draw}", draw, profile, ticks, options.settings + noise)


def loads(options: StudyOptions, *names: str, usual: int = USUAL_DRAWS, longest_ticks: int | None = None) -> list[Load]:
    """Return the draws of the loads asked for, or else of these; a name such as a@2 is one draw.

    Without a length asked for, no load is longer than `longest_ticks`.
    """
    drawn = [
        draw_of(name, draw, options)
        for name in dict.fromkeys(options.loads or names)
        for draw in (range(1, 2) if "@" in name else options.drawn(usual))
    ]
    longest = options.ticks or longest_ticks
    return [replace(load, ticks=min(load.ticks, longest)) for load in drawn] if longest else drawn


TUNING_DRAWS = (11, 12)
"""Draws that constants of solvers and rules were chosen on; those of the contraction rule on 101 to 103."""


def first_and_fresh(hours: Iterable[Load], first: str = "hours") -> dict[str, list[Load]]:
    """Return the first draw of each load, and those of other draws that nothing was tuned on; by title."""
    hours = list(hours)
    groups = {
        first: [load for load in hours if load.draw == 1],
        "fresh hours": [load for load in hours if load.draw not in (1, *TUNING_DRAWS)],
    }
    return {title: some for title, some in groups.items() if some}


@dataclass
class StudyResult:
    """Result of a study: table, figures and values of its claims."""

    columns: tuple[str, ...]
    rows: list[tuple[Cell, ...]]
    figures: dict[str, Figure]
    """Figures by name, drawn in the manner of the paper's."""
    values: dict[str, list[float]] = field(default_factory=dict)
    """Values by which the claims are judged: one for each draw, by claim."""
    remarks: list[str] = field(default_factory=list)
    """Paragraphs for the report."""
    always_shown: bool = False
    """Whether the report has all rows, however many there are."""
    failed_runs: int = 0
    """Runs in which updates had no answer."""

    def note(self, claim: str, value: float) -> None:
        """Add the value of one more draw."""
        self.values.setdefault(claim, []).append(float(value))

    def note_all(self, values: Mapping[str, float]) -> None:
        """Add the values of one more draw."""
        for claim, value in values.items():
            self.note(claim, value)


@dataclass(frozen=True)
class Study:
    """A question, its runs, and its answer."""

    name: str
    """Name of the study in the command."""
    title: str
    """Heading of its section in the report."""
    requests: Callable[[StudyOptions], Sequence[RunRequest]]
    """Returns the runs that are needed."""
    evaluate: Callable[[StudyOptions, Outcomes], StudyResult]
    """Returns what the outcomes say."""


Key = TypeVar("Key")
Found = Iterable[tuple[Load, dict[Key, Outcome]]]
"""Outcomes of the same runs under each load; read when they are wanted, once."""


def study_of_loads(
    name: str, title: str, drawn: Callable[[StudyOptions], Sequence[Load]],
    runs: Callable[[Load], dict[Key, RunRequest]], evaluate: Callable[[Found[Key]], StudyResult],
) -> Study:  # fmt: skip
    """Return a study of the same runs under each of its loads."""
    return Study(
        name,
        title,
        lambda options: [run for load in drawn(options) for run in runs(load).values()],
        lambda options, outcomes: evaluate(
            (load, {key: outcomes[run] for key, run in runs(load).items()}) for load in drawn(options)
        ),
    )


OWN: Final = "studies run in one process, in lock-step; leave it out"
INEFFECTIVE: Final = {
    "plant.load": "give it with --load",
    "plant.seed": "each draw has its own seed; say how many with --draws",
    **dict.fromkeys(
        (
            "session", "telemetry", "rig", "hmi", "plant.server", "control_plc.server", "control_plc.plant",
            "optimizer_plc.server", "optimizer_plc.control_plc",
        ),
        OWN,
    ),
}  # fmt: skip
"""Keys and sections that do not act on a run of a study, and what to do instead."""
LONGEST_NAME: Final = 40
LAST_LETTER: Final = "\u04ff"
"""Last letter of the scripts that the font of the figures covers completely: Latin, Greek, Cyrillic."""
NOT_IN_NAMES: Final = frozenset("$|\\")
"""Characters that figures and Markdown tables read as marks."""


def read_variants(file: Path, own: tuple[str, ...] = ()) -> tuple[Variant, ...]:
    """Return the variants of a file, two or more; the first is the reference.

    A variant changes the preset `tuned`, which is the default of `coldloop run`, and the settings `own` of the study.
    The environment has no influence.

    Raises:
        UsageError: The file cannot be read, or a variant is none: one line with the file, the variant and the remedy.
        ConfigurationError: A key or its value is wrong, or an entry point is not installed.
    """
    remedy = "name a TOML file with a table for each variant (`coldloop docs compare`)"
    try:
        content = text.parsed_toml(text.read_text(file, remedy, errors.UsageError, config.MOST_BYTES))
    except ValueError as error:
        raise errors.UsageError(f"{file}: not TOML: {error}; {remedy}") from None
    variants = tuple(_variant(file, name, table, own) for name, table in content.items())
    if len(variants) < 2:
        raise errors.UsageError(f"{file}: {len(variants)} variant{'s' if not variants else ''}; write the table of the "
                         "reference first, then one for each variant to compare")  # fmt: skip
    same = {variant.assignments: variant.name for variant in reversed(variants)}
    for variant in variants:
        if (first := same[variant.assignments]) != variant.name:
            raise errors.UsageError(f"{file} [{variant.name}]: has the settings of [{first}]; leave one of them out")
    return variants


def _variant(file: Path, name: str, table: Any, own: tuple[str, ...]) -> Variant:  # noqa: ANN401 written by a user
    place = f"{file} [{name}]"
    if not isinstance(table, Mapping):
        raise errors.UsageError(f"{file}: {name} is not in the table of a variant; write [NAME] above it")
    if not 0 < len(name) <= LONGEST_NAME or not name.isprintable() or NOT_IN_NAMES & {*name} or max(name) > LAST_LETTER:
        raise errors.UsageError(
            f"{file} [{name[:LONGEST_NAME]!a}]: name it with 1 to {LONGEST_NAME} printable Latin, Greek or Cyrillic "
            "characters other than $, | and \\"
        )
    settings = {key: value for key, value in config.flattened(table).items() if value != {}}
    for key in settings:
        for ineffective, instead in INEFFECTIVE.items():
            if f"{key}.".startswith(f"{ineffective}."):
                raise errors.UsageError(f"{place}: {key}: has no effect on this study: {instead}")
    options = {key: (value, place) for key, value in settings.items()}
    try:
        effective = config.load_configuration(
            Settings, environment={}, assignments=(*PAPER, *own, TUNED), options=options
        )
        outside_digests(effective.settings.optimizer_plc.program.outside)
    except errors.ConfigurationError as error:
        said = str(error).removeprefix(f"{place}: ")
        raise errors.ConfigurationError(f"{place}: {said}") from None
    return Variant(name, (TUNED, *(f"{key}={config.as_toml(value)}" for key, value in sorted(settings.items()))))
