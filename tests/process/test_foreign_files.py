"""Files as other programs write them, read as the same files in plain UTF-8, with points and commas."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pytest

from coldloop.errors import ColdloopError
from coldloop.kernels.cache import find_cache_folder
from coldloop.process.model_file import read_document
from coldloop.service.settings import TelemetrySettings
from coldloop.text import file_digest
from coldloop_chaos.faults import find_plan
from coldloop_hmi.users import PageRole, Users, write_user
from coldloop_plant.own_plants import fmu_of
from coldloop_rig.cli.commands.options import _tls_site
from coldloop_rig.plc_sizing.plc import find_profile
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.making import made_from
from coldloop_rig.process_file.reading import read_process_file
from coldloop_rig.process_file.step_test import from_step_test
from tests.process.test_process_file import HEATER, ONE_BY_ONE, made

EXAMPLES: Final = Path(__file__).parents[2] / "examples" / "processes"
RECORD: Final = (EXAMPLES / "quadruple_tank_record.csv").read_text(encoding="utf-8")
SHORT: Final = "".join(RECORD.splitlines(keepends=True)[:160])
MATRICES: Final = ONE_BY_ONE.replace('python = "heater.py:Heater"', 'matrices = "m.json"').replace(
    'name = "temperature"', 'name = "temperature"\nat = 325.0'
)
SQUARE: Final = {"A": [[-0.02]], "B": [[0.01]], "C": [[1.0]]}


# -- a byte order mark ------------------------------------------------------------------------------------------------


def plan(folder: Path) -> Any:  # noqa: ANN401
    return find_plan(str(folder / "plan.toml"), {}).name


def profile(folder: Path) -> Any:  # noqa: ANN401
    return find_profile(str(folder / "plc.toml")).flops_per_s(49)


MARKED: Final[dict[str, tuple[str, Callable[[Path], Any]]]] = {
    "heater.py": (HEATER, lambda folder: made_from(folder / "process.toml").model.A.tolist()),
    "process.toml": (ONE_BY_ONE, lambda folder: made_from(folder / "process.toml").model.A.tolist()),
    "m.json": (json.dumps(SQUARE), lambda folder: made_from(folder / "matrices.toml").model.A.tolist()),
    "plan.toml": ('name = "p"\ndescription = "d"\nload = "a"\nduration_s = 60\n', plan),
    "times.csv": ("size,plc_ms\n5,1\n10,3\n20,9\n", profile),
    "password": (
        "secret\n",
        lambda folder: TelemetrySettings(username="a", password_file=folder / "password").password(),
    ),
    "users": ("", lambda folder: Users(folder / "users").check("ann", "long enough") is not None),
    "tls.toml": ('[link.tls]\nca = "ca.pem"\n', _tls_site),
    "model.json": ("", lambda folder: read_document(folder / "model.json")["digest"]),
}


def written(folder: Path) -> None:
    """Write one file of each kind."""
    for name, (content, _) in MARKED.items():
        (folder / name).write_text(content, encoding="utf-8")
    (folder / "matrices.toml").write_text(MATRICES, encoding="utf-8")
    (folder / "plc.toml").write_text(
        'name = "A PLC"\nsource = "here"\nmemory_bytes = 1000\nfactorisations = "times.csv"\n', encoding="utf-8"
    )
    (folder / "users").unlink()
    write_user(folder / "users", "ann", PageRole.VIEW, "long enough")
    made(folder).model.save(folder / "model.json")


@pytest.mark.parametrize("name", MARKED)
def test_a_byte_order_mark_changes_nothing(name: str, tmp_path: Path) -> None:
    written(tmp_path)
    _, read = MARKED[name]
    plain = read(tmp_path)
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + (tmp_path / name).read_bytes())
    assert plain
    assert read(tmp_path) == plain


def test_a_plant_is_read_in_the_encoding_that_it_declares(tmp_path: Path) -> None:
    made(tmp_path)
    source = tmp_path / "heater.py"
    source.write_bytes(("# -*- coding: latin-1 -*-\n# 20 \u00b0C\n" + HEATER).encode("latin-1"))
    assert made_from(tmp_path / "process.toml").model.A.tolist() == [[pytest.approx(-0.02)]]
    source.write_bytes(("# 20 \u00b0C\n" + HEATER).encode("latin-1"))
    with pytest.raises(ColdloopError, match=r"heater\.py: .*save it as UTF-8"):
        made_from(tmp_path / "process.toml")


# -- matrices ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("matrices", [
    {"A": -0.02, "B": 0.01, "C": 1.0},
    {"A": [[-0.02]], "B": [0.01], "C": 1.0},
])  # fmt: skip
def test_a_number_is_a_matrix_of_one(matrices: dict[str, Any], tmp_path: Path) -> None:
    found = []
    for given in (SQUARE, matrices):
        (tmp_path / "m.json").write_text(json.dumps(given), encoding="utf-8")
        found.append(replace(made(tmp_path, MATRICES).model, declaration_digest=""))
    assert found[0].digest == found[1].digest


def test_a_list_is_the_row_or_column_that_fits(tmp_path: Path) -> None:
    given = {"A": [[-0.02, 0], [1, -1]], "B": [0.01, 0], "C": [0, 1]}
    (tmp_path / "m.json").write_text(json.dumps(given), encoding="utf-8")
    model = made(tmp_path, MATRICES).model
    assert (model.B.tolist(), model.C.tolist()) == ([[0.01], [0.0]], [[0.0, 1.0]])
    (tmp_path / "m.json").write_text(json.dumps({**given, "C": [1, 2, 3]}), encoding="utf-8")
    with pytest.raises(ColdloopError, match=r"C has shape \(3,\)"):
        made(tmp_path, MATRICES)


# -- records ----------------------------------------------------------------------------------------------------------


def in_iso(text: str) -> str:
    """Return a record with dates for seconds."""
    header, *lines = text.splitlines()
    cells = [line.split(",", 1) for line in lines]
    dates = [np.datetime64("2024-03-31T01:00:00") + np.timedelta64(int(seconds), "s") for seconds, _ in cells]
    return "\n".join([header, *(f"{date}Z,{rest}" for date, (_, rest) in zip(dates, cells, strict=True))])


RECORDS: Final[dict[str, tuple[str | bytes, str]]] = {
    "semicolons and decimal commas": (SHORT.replace(",", ";").replace(".", ","), "semicolons between columns"),
    "rows of commas": (SHORT.replace("\n", ",\n") + "\n\n,,,,,,\n", ""),
    "ISO times": (in_iso(SHORT), ""),
    "units and a header over two lines": (
        '"time_s",v1,v2,leak,"h1\n(cm)",h2\ns,V,V,cm3/s,,\n' + SHORT.partition("\n")[2], "line 3 taken for units",
    ),
    "a quality that is good, and remarks": (
        "".join(f"{line},{'192,ok' if k else 'quality,remark'}\n" for k, line in enumerate(SHORT.splitlines())),
        "not used: quality, remark",
    ),
    "a flow that is called q": (
        "".join(f"{line},{200.5 + k if k else 'q'}\n" for k, line in enumerate(SHORT.splitlines())), "not used: q",
    ),
    "Latin-1": (SHORT.replace("h2\n", "h2 (\u00b5m)\n").encode("latin-1"), "read as Latin-1"),
}  # fmt: skip


def copied(folder: Path, record: str | bytes) -> Path:
    """Write the example with another form of its record."""
    shutil.copy(EXAMPLES / "quadruple_tank_record.toml", folder / "process.toml")
    path = folder / "quadruple_tank_record.csv"
    path.write_bytes(record if isinstance(record, bytes) else record.encode())
    return folder / "process.toml"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the matrices that the example's record gives."""
    path = copied(tmp_path_factory.mktemp("plain"), SHORT)
    return str(from_step_test(read_process_file(path), path.with_name("quadruple_tank_record.csv")).A)


@pytest.mark.parametrize("form", RECORDS)
def test_a_record_in_another_form_gives_the_same_model(form: str, plain: str, tmp_path: Path) -> None:
    record, told = RECORDS[form]
    path = copied(tmp_path, record)
    found = from_step_test(read_process_file(path), tmp_path / "quadruple_tank_record.csv")
    assert str(found.A) == plain
    assert told in "\n".join(found.notes)


@pytest.mark.parametrize(
    ("quality", "told"), [("Bad", "'Bad' is not known as good"), ("0", "'0' is not known as good")]
)
def test_a_reading_that_is_not_good_is_refused(quality: str, told: str, tmp_path: Path) -> None:
    lines = RECORD.splitlines()
    rows = [f"{line},{'192' if k != 7 else quality}" for k, line in enumerate(lines[1:])]
    path = copied(tmp_path, "\n".join([f"{lines[0]},h1.quality", *rows]))
    with pytest.raises(ColdloopError, match=rf"line 9, h1\.quality: {told}; `coldloop import`"):
        made_from(path)


def test_dates_of_another_form_are_named_with_the_command_that_reads_them(tmp_path: Path) -> None:
    path = copied(tmp_path, in_iso(RECORD).replace("2024-03-31T", "31.03.2024 "))
    with pytest.raises(ColdloopError, match=r"line 2, time_s: '31\.03\.2024 .*`coldloop import` reads other dates"):
        made_from(path)


def test_pieces_of_a_record_give_the_gains_of_the_whole(tmp_path: Path) -> None:
    """Two gaps of 200 s: models go on from states of their own behind them."""
    header, *lines = RECORD.splitlines()
    rows = [f"{line},{1 + (k > 220) + (k > 440)}" for k, line in enumerate(lines) if k % 220 > 40 or k < 41]
    cut = made_from(copied(tmp_path, "\n".join([f"{header},piece", *rows])))
    whole = made_from(EXAMPLES / "quadruple_tank_record.toml")
    assert "not used" not in described(cut)
    for of in ("B", "F"):
        one, other = (each.model.C @ getattr(each.model.discretised(300.0), of) for each in (cut, whole))
        assert one == pytest.approx(other, rel=0.1, abs=0.05)


# -- where files are --------------------------------------------------------------------------------------------------


def test_model_files_are_made_where_kernels_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLDLOOP_CACHE_DIR", str(tmp_path / "chosen"))
    monkeypatch.setenv("HOME", "/proc")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert find_cache_folder("processes") == tmp_path / "chosen" / "processes"
    monkeypatch.delenv("COLDLOOP_CACHE_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert find_cache_folder("processes").parent.parent == tmp_path


def test_an_fmu_is_found_where_it_was_or_beside_the_model_file(tmp_path: Path) -> None:
    (tmp_path / "moved").mkdir()
    fmu = tmp_path / "moved" / "tank.fmu"
    fmu.write_bytes(b"here")
    header: Any = SimpleNamespace(
        file=tmp_path / "moved" / "model.json", plant_parameters={"file": str(tmp_path / "tank.fmu")},
        parameters_digest=file_digest(fmu),
    )  # fmt: skip
    (tmp_path / "tank.fmu").write_bytes(b"another one")
    assert fmu_of(header) == fmu
    fmu.write_bytes(b"changed")
    with pytest.raises(ColdloopError, match=r"made from another .*tank\.fmu than is there or beside it"):
        fmu_of(header)
