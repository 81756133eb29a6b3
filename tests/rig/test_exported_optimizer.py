"""The exported optimiser, in C, takes the place of ours on the bus: what was simulated is what is loaded."""

import asyncio
import hashlib
import json
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow.parquet as pq
import pytest

from coldloop.config import load_configuration, to_environment
from coldloop.errors import LinkError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import Identity, LeaseState, LeaseStatus
from coldloop_export import exported_optimizer
from coldloop_export.folder import export_plc
from coldloop_export.golden import SINGLE
from coldloop_rig import cli
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session import SessionClient
from coldloop_rig.cosim.wiring import REQUIRED
from coldloop_rig.settings import Settings
from tests.conftest import Coldloop
from tests.harness.processes import Processes, environment
from tests.harness.records import CONTROL_MAP, OPTIMIZER_MAP
from tests.rig.conftest import until_accepted

if TYPE_CHECKING:
    from tests.rig.conftest import OnTheBus

PATIENCE_S = 120.0
RUN = ("--preset", "paper", "--set", "optimizer_plc.program.arithmetic=float32")
"""Settings of the export, for a command."""


def settings(*assignments: str) -> Settings:
    return load_configuration(Settings, environment={}, assignments=[*SINGLE, *assignments]).settings


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export, not compiled yet."""
    made = tmp_path_factory.mktemp("exported") / "export"
    export_plc("c", None, made, settings())
    return made


@pytest.fixture(scope="module")
def export(folder: Path) -> Path:
    """The same, compiled."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler: cc is not installed")
    exported_optimizer.exported_optimizer(f"export:{folder}", settings())
    return folder


@pytest.fixture
def program(export: Path) -> tuple[str, ...]:
    """The command of its service, without the interpreter."""
    return exported_optimizer.exported_optimizer(f"export:{export}", settings())[1:]


def assert_same(coldloop: Coldloop, export: Path, tmp_path: Path, *scenario: str) -> None:
    """Check that runs with ours, and with the exported one on the bus, have the same trace and the same updates."""
    for way in (("--in-process",), ("--optimizer", f"export:{export}")):
        outcome = coldloop("run", *way, *RUN, *scenario, "--out", tmp_path / way[0])
        assert outcome.code == 0, outcome.complaints
    ours, theirs = (tmp_path / way for way in ("--in-process", "--optimizer"))
    traces = [json.loads((one / "summary.json").read_text())["trace_sha256"] for one in (ours, theirs)]
    assert traces[0] == traces[1]
    assert pq.read_table(ours / "updates.parquet").equals(pq.read_table(theirs / "updates.parquet"))


@pytest.mark.usefixtures("undrawn", "processes")
def test_a_run_with_it_has_the_trace_and_the_updates_of_ours(coldloop: Coldloop, export: Path, tmp_path: Path) -> None:
    assert_same(coldloop, export, tmp_path, "--load", "e", "--duration", "150s")


@pytest.mark.night
@pytest.mark.usefixtures("undrawn", "processes")
@pytest.mark.parametrize("period", ["adaptive", "2.5"])
def test_so_have_two_hours(coldloop: Coldloop, export: Path, tmp_path: Path, period: str) -> None:
    assert_same(coldloop, export, tmp_path, "--load", "2h", "--updating-period", period)


# -- on a link that is not as it should be -----------------------------------------------------------------------------


@pytest.mark.usefixtures("realtime")
@pytest.mark.parametrize("order", list(WordOrder))
async def test_it_drives_in_either_word_order_and_drives_again_after_a_restart(
    order: WordOrder, load_a: LoadProfile, on_the_bus: "OnTheBus", processes: Processes, program: tuple[str, ...]
) -> None:
    own = processes.free_port()
    async with on_the_bus(settings(), order=order, services=REQUIRED) as bus:
        told = {**to_environment(bus.settings), "COLDLOOP__OPTIMIZER_PLC__SERVER__PORT": str(own)}
        rig = SessionClient(bus.endpoints, bus.settings, services=REQUIRED)
        shown = RegisterClient(OPTIMIZER_MAP, host="127.0.0.1", port=own, order=order, timeout_s=PATIENCE_S)
        try:
            await rig.connect(PATIENCE_S)
            await rig.start(Scenario(14400, load_a, 0.0, 1, realtime=True, factor=5.0))
            first = processes.python(*program, more=told)
            await until_accepted(rig.control, 3)
            assert (await rig.control.read(LeaseStatus)).state == LeaseState.HELD
            assert (await shown.read(Identity)).session == rig.session
            first.kill()
            shown.close()
            second = processes.python(*program, more=told)
            await until_accepted(rig.control, 3)
            assert second.alive
        finally:
            shown.close()
            rig.close()


@pytest.mark.usefixtures("realtime")
def test_it_is_kept_up_and_finds_a_control_plc_that_was_killed(
    coldloop: Coldloop, processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, export: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    base = processes.three_ports()
    words = ("--load", "a", "--factor", "5", "--optimizer", f"export:{export}", *RUN, "--detach")
    started = processes.coldloop("up", "--port-base", base, *words)
    assert started.popen.wait(PATIENCE_S) == 0, started.said

    async def driven() -> None:
        async with asyncio.timeout(PATIENCE_S):
            while True:
                control = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=base + 1, timeout_s=PATIENCE_S)
                try:
                    await control.connect(PATIENCE_S)
                    await until_accepted(control, 2)
                except LinkError:  # it is being killed
                    await asyncio.sleep(0.05)
                else:
                    return
                finally:
                    control.close()

    try:
        asyncio.run(driven())
        for service in ("control_plc", "optimizer_plc"):
            assert coldloop("fault", "kill", service).code == 0
            asyncio.run(driven())
        assert re.search(r"^mode +mpc", coldloop("status").out, re.MULTILINE)
    finally:
        assert cli.main(["down", "--port-base", str(base)]) == 0


async def test_it_ends_with_the_program_that_has_started_it(processes: Processes, program: tuple[str, ...]) -> None:
    told = environment(settings(f"optimizer_plc.server.port={processes.free_port()}"))
    started = await asyncio.create_subprocess_exec(
        sys.executable, *program, "--with-parent", stdin=asyncio.subprocess.PIPE, env=told
    )
    assert started.stdin
    started.stdin.close()
    async with asyncio.timeout(PATIENCE_S):
        assert await started.wait() == 0


# -- what does not fit -------------------------------------------------------------------------------------------------


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """The same, not compiled."""
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def refusal(folder: Path, *assignments: str) -> str:
    with pytest.raises(UsageError) as refused:
        exported_optimizer.exported_optimizer(f"export:{folder}", settings(*assignments))
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.usefixtures("compiles")
def test_an_export_for_other_settings_is_refused(folder: Path) -> None:
    why = "it has optimizer_plc.program.adaptive.q_first = 9, the run 5: set it, or export the optimiser again"
    assert why in refusal(folder, "optimizer_plc.program.adaptive.q_first=5")
    assert "limits.high" in refusal(folder, "limits.high=[60, 140, 60]")


@pytest.mark.usefixtures("compiles")
def test_an_updating_period_is_the_sessions(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exported_optimizer, "_compiled", lambda *_: Path("program"))
    fixed = settings("optimizer_plc.program.updating_period_s=2.5")
    assert exported_optimizer.exported_optimizer(f"export:{folder}", fixed)[-1] == "program"


def changed_manifest(copy: Path, **fields: object) -> None:
    file = copy / "optimizer" / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **fields}))


@pytest.mark.usefixtures("compiles")
def test_an_export_of_another_model_or_for_other_registers_is_refused(copy: Path) -> None:
    changed_manifest(copy, model_digest="ab" * 32)
    assert "it has the model abababab, the run " in refusal(copy)
    changed_manifest(copy, register_maps=[1, 2])
    assert "whose registers are others than those of" in refusal(copy)


@pytest.mark.usefixtures("compiles")
def test_what_is_no_export_or_of_the_solver_alone_is_refused(copy: Path, tmp_path: Path) -> None:
    assert "is no export (coldloop export plc --target c" in refusal(tmp_path)
    shutil.rmtree(copy / "optimizer")
    assert "has the solver alone, without the optimiser: export it again" in refusal(copy)
    with pytest.raises(UsageError, match="give export: and the folder"):
        exported_optimizer.exported_optimizer(str(copy), settings())


@pytest.mark.usefixtures("compiles")
def test_structured_text_is_refused(copy: Path) -> None:
    changed_manifest(copy, files={"kernels.st": "ab" * 32})
    assert "it is not in C: export it with --target c" in refusal(copy)


@pytest.mark.usefixtures("compiles")
def test_a_source_that_was_changed_is_refused(copy: Path) -> None:
    with (copy / "optimizer" / "kernels.c").open("a") as file:
        file.write("\n")
    assert "optimizer/kernels.c is not as it was exported: export it again" in refusal(copy)


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", ["/dev/zero", "../kernels.c", "."])
def test_files_are_those_of_the_export(name: str, copy: Path) -> None:
    (copy / "optimizer" / "optimizer.c").write_bytes(b"")
    changed_manifest(copy, files={"optimizer.c": hashlib.sha256(b"").hexdigest(), name: "ab" * 32})
    assert re.search("outside the folder|not a regular file", refusal(copy))


@pytest.mark.usefixtures("compiles")
def test_a_library_that_lies_in_an_export_is_not_loaded(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (copy / "optimizer" / exported_optimizer.LIBRARY).write_text("planted")
    monkeypatch.setenv("COLDLOOP_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(exported_optimizer, "_make", lambda _, __, made: (made / "library.so").write_text("ours"))
    monkeypatch.setattr(shutil, "which", lambda _: "cc")
    library = Path(exported_optimizer.exported_optimizer(f"export:{copy}", settings())[-1])
    assert library.read_text() == "ours"
    assert library.parent == tmp_path / "cache" / "exports"
    assert library.parent.stat().st_mode & 0o777 == 0o700


@pytest.mark.usefixtures("compiles")
def test_without_a_compiler_one_line_says_what_to_install(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLDLOOP_CACHE_DIR", str(tmp_path / "nothing compiled"))
    monkeypatch.setenv("PATH", str(copy))
    assert "there is no C compiler (cc) to compile it: on Debian, install gcc" in refusal(copy)


@pytest.mark.usefixtures("compiles")
@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler: cc is not installed")
def test_a_compiler_that_gives_other_bits_is_refused(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exported_optimizer, "FLAGS", ("-std=c99", "-O3", "-ffast-math", "-fPIC"))
    assert "its self-test fails: " in refusal(copy)


def test_it_is_for_a_run_on_the_bus(coldloop: Coldloop, tmp_path: Path) -> None:
    outcome = coldloop("run", "--in-process", "--optimizer", f"export:{tmp_path}")
    assert outcome.code == 2
    assert "not allowed with argument" in outcome.complaints[-1]
