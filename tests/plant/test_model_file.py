"""A model file comes back as it was saved, or says what is wrong with it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coldloop.errors import ModelFileError
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.model_file import digest_of, read_header
from tests.harness.processes import Processes


def test_a_model_survives_saving_and_loading_to_the_bit(model: LtiModel, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    model.save(path)
    again = load(path)
    for name in ("A", "B", "F", "C", "D", "G", "x0", "u0", "y0"):
        assert getattr(again, name).tobytes() == getattr(model, name).tobytes()
    assert (again.w0, again.digest, again.state_names) == (model.w0, model.digest, model.state_names)
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]


def test_the_header_is_read_without_numpy(model: LtiModel, model_path: Path, processes: Processes) -> None:
    header = read_header(model_path)
    assert (header.digest, header.short_digest) == (model.digest, int(model.digest[:8], 16))
    assert header.x0 == tuple(model.x0)
    program = f"""
import sys; from pathlib import Path
from coldloop.process.model_file import read_header
read_header(Path({str(model_path)!r})); print("numpy" in sys.modules)"""
    assert processes.run_python(program)[0].strip() == "False"


def test_a_failed_save_leaves_the_old_file(model: LtiModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "model.json"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="disk full"):
        model.save(path)
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("model.json", "old")]


def signed(change: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], str]:
    """Make a file whose content is wrong although its digest is right."""

    def write(document: dict[str, Any]) -> str:
        change(document)
        return json.dumps({**document, "digest": digest_of(document)})

    return write


DAMAGES: dict[str, tuple[Callable[[dict[str, Any]], str], str]] = {
    "empty": (lambda _: "", "not a readable"),
    "truncated": (lambda d: json.dumps(d)[:500], "not a readable"),
    "a list": (lambda _: "[]", "format"),
    "another format": (lambda d: json.dumps({**d, "format": 99}), "format 1"),
    "a changed number": (lambda d: json.dumps({**d, "w0": d["w0"] + 1e-9}), "digest mismatch"),
    "no digest": (lambda d: json.dumps({k: v for k, v in d.items() if k != "digest"}), "digest mismatch"),
    "not a number": (lambda d: json.dumps({**d, "w0": float("nan")}), "not finite"),
    "too large a number": (lambda d: json.dumps(d).replace(json.dumps(d["w0"]), "1e999"), "not finite"),
    "a missing matrix": (signed(lambda d: d.pop("A")), "'A'"),
    "a missing name list": (signed(lambda d: d.pop("output_names")), "output_names"),
    "a missing row": (signed(lambda d: d["C"].pop()), "shape"),
    "a ragged matrix": (signed(lambda d: d["C"][0].pop()), "model file"),
    "text in a vector": (signed(lambda d: d["x0"].__setitem__(0, "cold")), "cold"),
    "one unit short": (signed(lambda d: d["state_units"].pop()), "differ in number"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_refused_with_its_name_and_a_remedy(model_path: Path, tmp_path: Path, damage: str) -> None:
    write, message = DAMAGES[damage]
    path = tmp_path / "bad.json"
    path.write_text(write(json.loads(model_path.read_text())))
    with pytest.raises(ModelFileError, match=message) as refused:
        load(path)
    text = str(refused.value)
    assert str(path) in text
    assert "plant.cold_box.model" in text
    assert "\n" not in text


@pytest.mark.parametrize("read", [load, read_header])
def test_a_missing_file_is_named(read: Callable[[Path], object], tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"nowhere\.json: no such model file"):
        read(tmp_path / "nowhere.json")


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModelFileError, match="not a readable"):
        load(path)


def test_a_model_of_another_tick_is_refused(model: LtiModel, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    replace(model, A_tick=model.A_tick @ model.A_tick).save(path)
    with pytest.raises(ModelFileError, match=r"A_tick is not that of A over a tick of 0.25 s; make a new one"):
        load(path)


def test_a_model_checks_its_shapes_when_it_is_made(model: LtiModel) -> None:
    with pytest.raises(ValueError, match="B has shape"):
        replace(model, B=np.zeros((28, 2)))
    with pytest.raises(ValueError, match="F is not finite"):
        replace(model, F=np.full(28, np.inf))


def test_two_half_periods_make_one(model: LtiModel) -> None:
    whole, half = model.discretised(5.0), model.discretised(2.5)
    assert pytest.approx(half.A @ half.A, rel=1e-9, abs=1e-12) == whole.A
    assert pytest.approx(half.A @ half.B + half.B, rel=1e-9, abs=1e-12) == whole.B
    assert pytest.approx(half.A @ half.F + half.F, rel=1e-9, abs=1e-12) == whole.F


@pytest.mark.parametrize("period", [0.0, -5.0, float("nan")])
def test_a_sampling_period_is_positive(model: LtiModel, period: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        model.discretised(period)
