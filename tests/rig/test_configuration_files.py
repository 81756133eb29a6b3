"""`coldloop config > FILE`, and what reads the file again: commands, services, Python."""

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from coldloop.config import DERIVED, as_toml, load_configuration
from coldloop.process.cold_box import COLD_BOX
from coldloop_optimizer_plc.settings import OF_PRESETS, Preset, presets_of
from coldloop_rig import simulate
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from tests.conftest import Coldloop

EVENTS = 'plant.refrigerator.events=[{at_s = 1.5, target = "nc1", value = 0}, {at_s = 2, target = "nc2", value = 0}]'
PROGRAM = "optimizer_plc.program."


def written(coldloop: "Coldloop", folder: Path, *words: str) -> Path:
    """What `coldloop config` prints, in a file."""
    outcome = coldloop("config", *words)
    assert outcome.code == 0, outcome.complaints
    file = folder / "rig.toml"
    file.write_text(outcome.out, encoding="utf-8")
    return file


def trace_of(coldloop: "Coldloop", out: Path, *words: object) -> str:
    run = ("run", "--in-process", "--duration", "10s", "--figures", "svg", "--force", "--out", out)
    outcome = coldloop(*run, *words)
    assert outcome.code == 0, outcome.complaints
    return next(str(line) for line in outcome.out.splitlines() if line.startswith("trace"))


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize(
    "words",
    [
        (),
        pytest.param(
            ("--set", "plant.load=e", "--set", "plant.seed=3", "--set", "plant.sensors.level=0.2"),
            marks=pytest.mark.night,
        ),
        pytest.param(("--set", "plant.kind=refrigerator", "--set", EVENTS), marks=pytest.mark.night),
    ],
)
def test_a_run_with_the_written_configuration_is_the_same_run(
    words: tuple[str, ...], coldloop: "Coldloop", tmp_path: Path
) -> None:
    file = written(coldloop, tmp_path, *words)
    assert trace_of(coldloop, tmp_path / "a", "--config", file) == trace_of(coldloop, tmp_path / "b", *words)
    settings = load_configuration(Settings, file=file, environment={}).settings
    assert settings == load_configuration(Settings, environment={}, assignments=words[1::2]).settings


def test_python_runs_what_the_file_has(coldloop: "Coldloop", tmp_path: Path) -> None:
    words = ("--set", "plant.load=e", "--set", f"{PROGRAM}updating_period_s=2.5", "--set", "plant.seed=4")
    result = simulate(config=written(coldloop, tmp_path, *words), duration_s=5)
    assert (result.configuration["plant.load"], result.configuration["plant.seed"]) == ("e", 4)
    assert result.configuration[f"{PROGRAM}updating_period_s"] == 2.5
    assert simulate(config=tmp_path / "rig.toml", load="a", duration_s=5).configuration["plant.load"] == "a"


@pytest.mark.usefixtures("programs")
def test_a_factor_that_lock_step_does_not_have_is_still_refused(coldloop: "Coldloop", tmp_path: Path) -> None:
    file = written(coldloop, tmp_path, "--set", "session.factor=5")
    outcome = coldloop("run", "--in-process", "--config", file)
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert "session.factor" in outcome.complaints[0] or "factor has no effect" in outcome.complaints[0]
    assert coldloop("run", "--in-process", "--factor", "1").code == 2


@pytest.mark.parametrize("text", ["plain", 'quoted "text" \\ and \t tab', "a\nb", "\x7f", "caf\u00e9", "\U0001f600"])
def test_every_text_is_written_as_toml_reads_it(text: str) -> None:
    value = [{"key": text, "absent": None}, 1e-5, True]
    assert tomllib.loads(f"value = {as_toml(value)}")["value"] == [{"key": text}, 1e-5, True]


# -- settings that decide others ---------------------------------------------------------------------------------------


def effective(file: Path, *assignments: str, environment: dict[str, str] | None = None) -> dict[str, tuple[Any, str]]:
    loaded = load_configuration(Settings, file=file, environment=environment or {}, assignments=assignments)
    return {key: (value, source) for key, value, source in loaded.effective()}


def plain(*assignments: str) -> dict[str, Any]:
    loaded = load_configuration(Settings, environment={}, assignments=assignments)
    return {key: value for key, value, _ in loaded.effective()}


@pytest.mark.parametrize("of_file", list(Preset))
@pytest.mark.parametrize("asked", list(Preset))
def test_a_preset_acts_beside_a_file_with_every_key(
    of_file: Preset, asked: Preset, coldloop: "Coldloop", tmp_path: Path
) -> None:
    file = written(coldloop, tmp_path, "--set", f"{PROGRAM}preset={of_file}")
    there = effective(file, f"{PROGRAM}preset={asked}")
    assert {key: value for key, (value, _) in there.items()} == plain(f"{PROGRAM}preset={asked}")
    if asked is Preset.AS_PRINTED:
        assert there[f"{PROGRAM}penalties.box"] == (1.0, DERIVED)
    in_environment = effective(file, environment={"COLDLOOP__OPTIMIZER_PLC__PROGRAM__PRESET": asked})
    assert {key: value for key, (value, _) in in_environment.items()} == plain(f"{PROGRAM}preset={asked}")


def test_state_feedback_acts_beside_a_file_with_every_key(coldloop: "Coldloop", tmp_path: Path) -> None:
    there = effective(written(coldloop, tmp_path), f"{PROGRAM}estimator.kind=state-feedback")
    assert there[f"{PROGRAM}estimator.disturbances"][0] == []


def test_what_is_set_beside_the_preset_comes_before_it(coldloop: "Coldloop", tmp_path: Path) -> None:
    file = written(coldloop, tmp_path)
    there = effective(file, f"{PROGRAM}preset=as-printed", f"{PROGRAM}penalties.box=3", f"{PROGRAM}ode.alpha=7")
    assert there[f"{PROGRAM}penalties.box"][0] == 3.0
    assert there[f"{PROGRAM}ode.alpha"][0] == 7.0
    file.write_text(f'{PROGRAM}preset = "as-printed"\n{PROGRAM}penalties.box = 3.0\n')
    assert effective(file)[f"{PROGRAM}penalties.box"][0] == 3.0


def test_the_weight_of_broken_constraints_follows_a_penalty_beside_a_file_with_every_key(
    coldloop: "Coldloop", tmp_path: Path
) -> None:
    file = written(coldloop, tmp_path)
    change = f"{PROGRAM}penalties.output_rows=3"
    assert {key: value for key, (value, _) in effective(file, change).items()} == plain(change)


@pytest.mark.night
def test_the_option_reaches_the_run(coldloop: "Coldloop", tmp_path: Path) -> None:
    file = written(coldloop, tmp_path)
    run = ("--load", "a", "--preset", "as-printed", "--duration", "2min")
    beside = trace_of(coldloop, tmp_path / "a", "--config", file, *run)
    assert beside == trace_of(coldloop, tmp_path / "b", *run)
    assert beside != trace_of(coldloop, tmp_path / "c", "--load", "a", "--duration", "2min")


def test_all_that_a_preset_decides_is_declared() -> None:
    decided = {
        f"{name}.{key}" for preset in presets_of(COLD_BOX).values() for name, values in preset.items() for key in values
    }
    assert decided == set(OF_PRESETS)


# -- beyond what can be read -------------------------------------------------------------------------------------------


def deep(levels: int) -> str:
    return "[" * levels + "]" * levels


@pytest.mark.parametrize(
    "text",
    [
        "plant.seed = " + "9" * 5000,
        "plant.seed = " + deep(5000),
        "plant.seed = " + deep(100),
        "plant" + ".a" * 5_000 + " = 1",
        "[plant" + ".a" * 5_000 + "]",
        "plant.load = '" + "x" * 5000,
        "plant.seed = '" + "x" * 5000 + "'",
    ],
)
def test_settings_beyond_what_can_be_read_are_one_short_line(text: str, coldloop: "Coldloop", tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(text)
    cases: list[tuple[tuple[object, ...], dict[str, str]]] = [(("--config", file), {})]
    if text.startswith("plant.seed = "):
        cases.append((("--set", text.replace(" ", "")), {}))
        cases.append(((), {"COLDLOOP__PLANT__SEED": text.partition(" = ")[2]}))
    for words, environment in cases:
        outcome = coldloop("config", *words, environment=environment)
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert len(outcome.complaints[0]) < 1000
