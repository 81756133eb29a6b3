from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field, model_validator

from coldloop.config import DEFAULT, Configuration, load_configuration, to_environment
from coldloop.errors import ConfigurationError, UsageError
from coldloop_control_plc.settings import ControlSettings
from coldloop_optimizer_plc.settings import OptimizerSettings
from coldloop_rig.settings import Settings

Write = Callable[[str], Path]


class Solver(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = "ode"
    alpha: Annotated[float, Field(gt=0)] = 3000.0
    instants: tuple[int, ...] = (1, 2, 4)
    kind: Literal["first", "second"] = "first"


class Bounds(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    low: float = 0.0
    high: float = 1.0

    @model_validator(mode="after")
    def _ordered(self) -> "Bounds":
        if self.low >= self.high:
            raise ValueError("Each low is below its high")
        return self


class Everything(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    solver: Solver = Solver()
    bounds: Bounds = Bounds()
    title: str = "none"


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(text: str) -> Path:
        file = tmp_path / "rig.toml"
        file.write_text(text, encoding="utf-8")
        return file

    return written


def loaded(
    file: Path | None = None, environment: dict[str, str] | None = None, assignments: tuple[str, ...] = ()
) -> Configuration[Everything]:
    return load_configuration(Everything, file=file, environment=environment or {}, assignments=assignments)


def refused(
    file: Path | None = None, environment: dict[str, str] | None = None, assignments: tuple[str, ...] = ()
) -> str:
    """Return the message of the refusal, which is one line."""
    with pytest.raises(ConfigurationError) as caught:
        loaded(file, environment, assignments)
    message = str(caught.value)
    assert "\n" not in message
    assert isinstance(caught.value, UsageError)
    assert caught.value.exit_code == 2
    assert caught.value.__cause__ is None
    return message


# -- numbers that are none ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["inf", "-inf", "Infinity", "1e999"])
def test_an_infinite_number_is_refused_wherever_it_comes_from(value: str, write: Write) -> None:
    key = "bounds.high" if value != "-inf" else "bounds.low"
    assert refused(assignments=(f"{key}={value}",)).startswith(f"--set {key}: input should be finite (got ")
    section, name = key.split(".")
    variable = f"COLDLOOP__{section.upper()}__{name.upper()}"
    assert refused(environment={variable: value}).startswith(f"{variable}: {key}: input should be finite (got ")
    file = write(f"[{section}]\n{name} = {value if value != 'Infinity' else 'inf'}\n")
    assert refused(file).startswith(f"{file}: {key}: input should be finite (got ")


# -- precedence and provenance ----------------------------------------------------------------------------------------


def test_the_command_line_overrides_the_environment_and_that_the_file(write: Write) -> None:
    file = write('title = "file"\n[solver]\nname = "file"\nalpha = 1\ninstants = [1, 3]\n')
    environment = {"COLDLOOP__SOLVER__NAME": "environment", "COLDLOOP__SOLVER__ALPHA": "2"}
    configuration = loaded(file, environment, ("solver.name=command",))
    assert configuration.settings == Everything(
        title="file", solver=Solver(name="command", alpha=2.0, instants=(1, 3), kind="first")
    )
    sources = {key: source for key, _, source in configuration.effective()}
    assert sources == {
        "title": str(file),
        "solver.name": "--set solver.name",
        "solver.alpha": "COLDLOOP__SOLVER__ALPHA",
        "solver.instants": str(file),
        "solver.kind": DEFAULT,
        "bounds.low": DEFAULT,
        "bounds.high": DEFAULT,
    }


def test_a_dedicated_option_overrides_all_others_under_its_own_name() -> None:
    configuration = load_configuration(
        Everything,
        environment={"COLDLOOP__TITLE": "environment"},
        assignments=["title=assigned"],
        options={"title": ("optional", "--title")},
    )
    assert configuration.settings.title == "optional"
    assert configuration.sources["title"] == "--title"


@given(chosen=st.sets(st.sampled_from(["file", "environment", "command"])))
def test_the_last_source_that_names_a_key_wins(tmp_path_factory: pytest.TempPathFactory, chosen: set[str]) -> None:
    file = tmp_path_factory.mktemp("config") / "rig.toml"
    file.write_text('title = "file"\n' if "file" in chosen else "", encoding="utf-8")
    environment = {"COLDLOOP__TITLE": "environment"} if "environment" in chosen else {}
    assignments = ("title=command",) if "command" in chosen else ()
    order = [source for source in ("file", "environment", "command") if source in chosen]
    assert loaded(file, environment, assignments).settings.title == (order[-1] if order else "none")


def test_without_any_source_everything_is_a_default() -> None:
    configuration = loaded()
    assert configuration.settings == Everything()
    assert {source for _, _, source in configuration.effective()} == {DEFAULT}


@pytest.mark.parametrize(
    ("text", "value"),
    [("fast", "fast"), ('"7"', "7"), ("host-1.example", "host-1.example"), ("", ""), ("a = b", "a = b")],
)
def test_a_value_that_is_no_toml_is_text(text: str, value: str) -> None:
    assert loaded(assignments=(f"title={text}",)).settings.title == value


def test_values_are_read_as_toml() -> None:
    solver = loaded(
        environment={"COLDLOOP__SOLVER__INSTANTS": "[1, 5]"}, assignments=("solver.alpha=1e2",)
    ).settings.solver
    assert (solver.instants, solver.alpha) == ((1, 5), 100.0)


def test_other_variables_of_the_environment_are_not_ours() -> None:
    assert loaded(environment={"COLDLOOP_CACHE_DIR": "/tmp", "PATH": "/bin"}).settings == Everything()  # noqa: S108


def test_sections_of_other_services_are_skipped_and_unknown_ones_are_not(write: Write) -> None:
    file = write("[plant]\nseed = 3\n")
    configuration = load_configuration(Everything, file=file, environment={}, others=("plant", "solver"))
    assert configuration.settings == Everything()
    assert "plant: no such key" in refused(file)


@pytest.mark.parametrize("model", [ControlSettings, OptimizerSettings])
def test_a_service_started_with_the_environment_of_its_settings_has_the_same_settings(model: type[BaseModel]) -> None:
    wanted = load_configuration(
        model,
        environment={"COLDLOOP__LIMITS__RATE_REFERENCE": "elapsed", "COLDLOOP__SESSION__FACTOR": "60"},
        assignments=["telemetry.broker=broker.example"],
    ).settings
    assert load_configuration(model, environment=to_environment(wanted)).settings == wanted


# -- refusals ---------------------------------------------------------------------------------------------------------


def test_an_unknown_key_is_named_with_its_file(write: Write) -> None:
    file = write("[solver]\nalhpa = 3\n")
    message = refused(file)
    assert message.startswith(f"{file}: solver.alhpa: no such key")


def test_an_unknown_variable_is_named() -> None:
    message = refused(environment={"COLDLOOP__SOLVER__ALHPA": "3"})
    assert "COLDLOOP__SOLVER__ALHPA" in message
    assert "solver.alhpa: no such key" in message


def test_an_unknown_key_of_the_command_line_is_named() -> None:
    assert refused(assignments=("solver.alhpa=3",)).startswith("--set solver.alhpa: no such key")


@pytest.mark.parametrize(
    ("key", "text"),
    [("solver.alpha", "-1"), ("solver.alpha", "much"), ("solver.kind", "third"), ("solver.instants", "[1, true, 'x']")],
)
def test_a_wrong_value_is_named_with_its_key_its_source_and_itself(key: str, text: str) -> None:
    variable = "COLDLOOP__" + key.upper().replace(".", "__")
    from_environment, from_command_line = refused(environment={variable: text}), refused(assignments=(f"{key}={text}",))
    for message, source in ((from_environment, variable), (from_command_line, f"--set {key}")):
        assert source in message
        assert key in message
        assert "(got " in message


def test_a_wrong_value_is_blamed_on_the_source_that_set_it_last(write: Write) -> None:
    file = write("[solver]\nalpha = 1\n")
    message = refused(file, {"COLDLOOP__SOLVER__ALPHA": "-1"})
    assert message.startswith("COLDLOOP__SOLVER__ALPHA")
    assert str(file) not in message


def test_a_contradiction_between_keys_names_the_section_and_a_source() -> None:
    message = refused(assignments=("bounds.low=2",))
    assert "--set bounds.low" in message
    assert "bounds" in message
    assert "each low is below its high" in message


def test_an_assignment_without_a_value_says_how_to_write_it() -> None:
    assert refused(assignments=("solver.alpha",)) == "--set solver.alpha: write --set section.key=value"


def test_a_key_inside_a_value_is_no_section() -> None:
    message = refused(assignments=("title=x", "title.colour=red"))
    assert message.startswith("--set title.colour: title.colour is not a section")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    message = refused(tmp_path / "nowhere.toml")
    assert message.startswith(f"{tmp_path / 'nowhere.toml'}: No such file or directory")


def test_a_directory_is_no_file(tmp_path: Path) -> None:
    assert refused(tmp_path).startswith(f"{tmp_path}: not a regular file")


def test_a_file_that_is_no_toml_is_named_with_the_place(write: Write) -> None:
    file = write("[solver\nalpha = 3\n")
    message = refused(file)
    assert message.startswith(f"{file}: not TOML")
    assert "line 1" in message


def test_a_file_that_is_no_text_is_named(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_bytes(b"title = '\xff\xfe'\n")
    assert refused(file) == f"{file}: not UTF-8 text (byte 9); save it as UTF-8, not compressed"


def refusal(assignment: str) -> str:
    """Return why an assignment is refused, or nothing."""
    try:
        loaded(assignments=(assignment,))
    except ConfigurationError as error:
        return str(error)
    return ""


@given(text=st.text(max_size=20))
def test_whatever_stands_behind_the_equals_sign_is_a_value_or_a_refusal_in_one_line(text: str) -> None:
    reason = refusal(f"solver.alpha={text}")
    assert "\n" not in reason
    assert not reason or reason.startswith("--set solver.alpha")


@given(key=st.text(st.characters(categories=["L", "N", "P", "S"]), min_size=1, max_size=20))
def test_whatever_stands_before_the_equals_sign_is_a_key_or_a_refusal_in_one_line(key: str) -> None:
    reason = refusal(f"{key}=3")
    assert "\n" not in reason
    assert reason.startswith("--set ")


@pytest.mark.parametrize("key", ["plant.load", "model.file", "plant.retain.file"])
def test_a_text_with_a_nul_is_no_name_of_a_file(key: str, tmp_path: Path) -> None:
    file = tmp_path / "nul.toml"
    file.write_text(f'{key} = "a\\u0000b"\n')
    with pytest.raises(ConfigurationError, match="contains a NUL character; remove it") as failure:
        load_configuration(Settings, file=file, environment={})
    assert key in str(failure.value)
    assert "\n" not in str(failure.value)


def test_a_device_without_an_end_is_no_configuration() -> None:
    with pytest.raises(ConfigurationError, match="not a regular file"):
        load_configuration(Settings, file=Path("/dev/zero"), environment={})
