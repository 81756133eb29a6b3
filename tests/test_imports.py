"""Who may import whom."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.processes import Processes

ROOT = Path(__file__).parents[1]
SERVICES = ("plant", "control_plc", "optimizer_plc", "hmi")
BESIDE = ("chaos", "export", "refrigerator", "studies")
"""Packages that nobody imports: they come in by entry points, as the parts of others do."""
CORE = {
    "coldloop": ROOT / "shared", **{f"coldloop_{name}": ROOT / "services" / name for name in SERVICES},
    "coldloop_rig": ROOT / "rig",
}  # fmt: skip
PACKAGES = CORE | {f"coldloop_{name}": ROOT / "beside" / name for name in BESIDE}
MAY_IMPORT = {
    **{name: {name, *CORE} for name in PACKAGES},
    **{f"coldloop_{name}": {f"coldloop_{name}", "coldloop"} for name in SERVICES},
    "coldloop": {"coldloop"},
}


def imported_packages(source: Path) -> Iterator[tuple[str, int]]:
    """Yield the project's packages that a file imports, anywhere in it, with the line."""
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"), str(source))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{source}:{node.lineno} imports relatively: the rule could not be read off"
            names = [node.module or ""]
        else:
            continue
        for name in names:
            package = name.partition(".")[0]
            if package in PACKAGES:
                yield package, node.lineno


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_what_lies_below_it(package: str) -> None:
    sources = sorted((PACKAGES[package] / package).rglob("*.py"))
    assert sources
    trespasses = [
        f"{source.relative_to(ROOT)}:{line} imports {other}"
        for source in sources
        for other, line in imported_packages(source)
        if other not in MAY_IMPORT[package]
    ]
    assert not trespasses


@pytest.mark.parametrize("service", ["control_plc", "hmi"])
def test_control_plc_and_page_run_without_numpy_numba_and_scipy(service: str, processes: Processes) -> None:
    modules = [
        ".".join(source.relative_to(ROOT / "services" / service).with_suffix("").parts).removesuffix(".__init__")
        for source in (ROOT / "services" / service).rglob("*.py")
    ]
    program = (
        "import importlib, sys\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    loaded = set(processes.run_python(program)[0].split())
    assert f"coldloop_{service}" in loaded
    assert not loaded & {
        "numpy",
        "numba",
        "scipy",
        "osqp",
        "pyarrow",
        "coldloop_plant",
        "coldloop_optimizer_plc",
        "coldloop_rig",
    }


def test_a_short_run_in_one_process_loads_what_it_needs_and_no_more(tmp_path: Path, processes: Processes) -> None:
    """Each of these would take as long as much of the rest; the figure is drawn by a process of its own."""
    program = (
        "import sys\nfrom coldloop_rig import cli\n"
        f"assert cli.main(['run', '--in-process', '--duration', '2s', '--out', {str(tmp_path / 'run')!r}]) == 0\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}), file=sys.stderr)"
    )
    loaded = set(processes.run_python(program)[1].split())
    assert {"numba", "pyarrow"} <= loaded
    assert not loaded & {"pandas", "matplotlib", "scipy", "rich", "pymodbus", "asyncio", "cffi", "yaml", "distributed"}
    assert (tmp_path / "run" / "run.png").is_file()


@pytest.mark.parametrize("service", ["plant", "control_plc", "optimizer_plc"])
def test_a_service_loads_what_it_needs_and_no_more(service: str, processes: Processes) -> None:
    program = f"import sys\nsys.argv = ['{service}', '--version']\nimport runpy\nfrom contextlib import suppress\n"
    program += f"with suppress(SystemExit): runpy.run_module('coldloop_{service}', run_name='__main__')\n"
    program += "print(*sorted({name.partition('.')[0] for name in sys.modules}), file=sys.stderr)"
    loaded = set(processes.run_python(program)[1].split())
    assert f"coldloop_{service}" in loaded
    assert not loaded & {
        "pandas",
        "matplotlib",
        "pyarrow",
        "scipy",
        "rich",
        "aiomqtt",
        "cryptography",
        "cffi",
        "coldloop_rig",
    }
