"""Variants of the loop that the study `compare` sets side by side, from a TOML file; each table is one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from coldloop.config import MOST_BYTES, as_toml, flattened, load_configuration
from coldloop.errors import ConfigurationError, UsageError
from coldloop.parsing import parsed_toml
from coldloop.text_file import read_text
from coldloop_rig.settings import Settings
from coldloop_rig.studies.outside_parts import outside_digests
from coldloop_rig.studies.settings import PAPER
from coldloop_rig.studies.study import TUNED, Variant

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
"""Of those that the font of the figures has throughout: Latin, Greek, Cyrillic."""
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
        content = parsed_toml(read_text(file, remedy, UsageError, MOST_BYTES))
    except ValueError as error:
        raise UsageError(f"{file}: not TOML: {error}; {remedy}") from None
    variants = tuple(_variant(file, name, table, own) for name, table in content.items())
    if len(variants) < 2:
        raise UsageError(f"{file}: {len(variants)} variant{'s' if not variants else ''}; write the table of the "
                         "reference first, then one for each variant to compare")  # fmt: skip
    same = {variant.assignments: variant.name for variant in reversed(variants)}
    for variant in variants:
        if (first := same[variant.assignments]) != variant.name:
            raise UsageError(f"{file} [{variant.name}]: has the settings of [{first}]; leave one of them out")
    return variants


def _variant(file: Path, name: str, table: Any, own: tuple[str, ...]) -> Variant:  # noqa: ANN401 what a user wrote
    place = f"{file} [{name}]"
    if not isinstance(table, Mapping):
        raise UsageError(f"{file}: {name} is not in the table of a variant; write [NAME] above it")
    if not 0 < len(name) <= LONGEST_NAME or any(map(_is_unsuitable, name)):
        raise UsageError(
            f"{file} [{name[:LONGEST_NAME]!a}]: name it with 1 to {LONGEST_NAME} printable Latin, Greek or Cyrillic "
            "characters other than $, | and \\"
        )
    settings = {key: value for key, value in flattened(table).items() if value != {}}
    for key in settings:
        for ineffective, instead in INEFFECTIVE.items():
            if f"{key}.".startswith(f"{ineffective}."):
                raise UsageError(f"{place}: {key}: has no effect on this study: {instead}")
    options = {key: (value, place) for key, value in settings.items()}
    try:
        effective = load_configuration(Settings, environment={}, assignments=(*PAPER, *own, TUNED), options=options)
        outside_digests(effective.settings.optimizer_plc.program.outside)
    except ConfigurationError as error:
        said = str(error).removeprefix(f"{place}: ")
        raise ConfigurationError(f"{place}: {said}") from None
    return Variant(name, (TUNED, *(f"{key}={as_toml(value)}" for key, value in sorted(settings.items()))))


def _is_unsuitable(character: str) -> bool:
    """Return whether a character cannot be in a name: figures have no letter for it, or read it as a mark."""
    return not character.isprintable() or character in NOT_IN_NAMES or character > LAST_LETTER
