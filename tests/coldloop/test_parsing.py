"""Texts from outside are read within the same bounds on each version of Python."""

from collections.abc import Callable

import pytest

from coldloop.config import flattened, load_configuration
from coldloop.errors import ConfigurationError, UsageError
from coldloop.text import MOST_LEVELS, parsed_json, parsed_toml
from coldloop_rig import simulate
from coldloop_rig.settings import Settings

Nested = Callable[[int], str]
FORMS: tuple[Nested, ...] = (
    lambda levels: "[" * levels + "]" * levels,
    lambda levels: '{"a":' * levels + "1" + "}" * levels,
    lambda levels: '[{"a":' * (levels // 2) + "1" + "}]" * (levels // 2),
)
LEVELS = [MOST_LEVELS + 2, 500, 2_000, 20_000, 200_000]
"""Beyond the bound: some are read by the parser of one version of Python and not by another's."""


@pytest.mark.parametrize("nested", FORMS)
@pytest.mark.parametrize("levels", LEVELS)
def test_json_of_too_many_levels_is_a_value_error(nested: Nested, levels: int) -> None:
    with pytest.raises(ValueError, match="nested too deeply: more than 32 levels"):
        parsed_json(nested(levels))


@pytest.mark.parametrize("nested", FORMS)
def test_json_of_few_levels_is_read(nested: Nested) -> None:
    assert flattened({"all": parsed_json(nested(MOST_LEVELS))})


@pytest.mark.parametrize("levels", LEVELS[:3])
@pytest.mark.parametrize(
    "text", [lambda n: f"a = {'[' * n}{']' * n}", lambda n: f"a{'.a' * n} = 1", lambda n: f"[a{'.a' * n}]\nb = 1"]
)
def test_toml_of_too_many_levels_is_a_value_error(text: Nested, levels: int) -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parsed_toml(text(levels))


def test_toml_of_few_levels_is_read() -> None:
    assert parsed_toml(f"a{'.a' * (MOST_LEVELS - 1)} = 1")


@pytest.mark.parametrize("text", ["", "{", "[1", "9" * 5000, b"\xff\xfe", '{"a": NaN'])
def test_what_is_no_json_is_a_value_error(text: str | bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 of the parser's own words
        parsed_json(text)


@pytest.mark.parametrize("levels", LEVELS)
def test_a_key_of_too_many_levels_is_one_short_line(levels: int) -> None:
    for assignments, environment in (
        ([f"plant{'.a' * levels}=1"], {}),
        ([], {f"COLDLOOP__PLANT{'__A' * levels}": "1"}),
    ):
        with pytest.raises(ConfigurationError, match=r"(?i)plant.*nested too deeply.*coldloop config") as raised:
            load_configuration(Settings, environment=environment, assignments=assignments)
        assert len(str(raised.value)) < 500


@pytest.mark.parametrize("levels", [MOST_LEVELS + 2, 20_000])
def test_python_sections_of_too_many_levels_are_one_short_line(levels: int) -> None:
    plant: object = 1
    for _ in range(levels):
        plant = {"a": plant}
    with pytest.raises(UsageError, match=r"plant\.a.*nested too deeply") as raised:
        simulate(load="a", duration_s=5, plant=plant)
    assert len(str(raised.value)) < 500
