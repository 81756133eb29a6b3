"""A rack that is killed and started again: it continues where it was, and no generation of outputs comes twice."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from coldloop.registers.common import EventKind
from coldloop.registers.plant import OutputVerdict, PlantSession
from coldloop.safety.retained import RetainedFile
from coldloop_plant.runtime import OWNER
from tests.plant.conftest import HEADER

if TYPE_CHECKING:
    from tests.plant.conftest import RackOnTheBus

    SwitchOn = type[RackOnTheBus]

U = (43.0, 80.0, 36.0)
REALTIME = {"mode": "realtime"}


def test_a_killed_rack_goes_on_where_it_was_and_its_outputs_are_read_back_first(
    switch_on: "SwitchOn", tmp_path: Path
) -> None:
    retained = {"retain": {"file": str(tmp_path / "plant")}, "sensors": {"level": 0.1}}
    racks = switch_on(sensors={"level": 0.1}), switch_on(**retained)
    undisturbed, plc = (rack.client("control PLC", 77) for rack in racks)
    for _ in range(30):
        undisturbed.send(*U)
        plc.send(*U)
    again = switch_on(**retained)
    shown = again.shown()
    assert (shown.tick, shown.u, shown.holder, shown.generation) == (30, U, 77, 2)
    plc = again.client("control PLC", 77)
    assert plc.send(44.0, 75.0, 36.0, generation=1).verdict == OutputVerdict.CHANGED
    for _ in range(30):
        expected = undisturbed.send(44.0, 75.0, 36.0)
        found = plc.send(44.0, 75.0, 36.0, generation=2)
    assert found._replace(generation=1, crc=expected.crc) == expected, "to the bit, the sensors' noise included"


def test_boots_and_events_are_numbered_over_restarts(switch_on: "SwitchOn", tmp_path: Path) -> None:
    configuration = {"retain": {"file": str(tmp_path / "plant")}, "session": {"autostart": False}}
    for boot in (1, 2, 3):
        rack = switch_on(**configuration)
        (event,) = rack.events(EventKind.BOOT)
        assert (event.number, event.boot, event.subject) == (boot, boot, 0)
    rack.operator.write(PlantSession(1, 0, 1.0, 1, 1))
    rack.client("control PLC", 77).send(*U)
    (event,) = switch_on(**configuration).events(EventKind.BOOT)
    assert (event.number, event.boot, event.subject) == (3 + 3 + 1, 4, 1), "session, load and lease came between"


def test_no_generation_comes_twice_when_the_rack_is_killed_behind_outputs_that_it_limited(
    switch_on: "SwitchOn", tmp_path: Path
) -> None:
    """In the same tick, so that nothing but the outputs has changed."""
    retained = {"retain": {"file": str(tmp_path / "plant")}, "session": REALTIME, "rate_limited": True}
    rack = switch_on(**retained)
    plc = rack.client("control PLC", 77)
    plc.send(*U)
    rack.passes(2)
    limited = plc.send(9.0, 815.0, 65.0)
    assert limited.verdict == OutputVerdict.LIMITED
    again = switch_on(**retained).shown()
    assert (again.u, again.generation) == (limited.u, limited.generation + 1)


def test_no_generation_comes_twice_when_the_rack_is_killed_behind_an_answer(
    switch_on: "SwitchOn", tmp_path: Path
) -> None:
    retained = {"retain": {"file": str(tmp_path / "plant")}, "session": REALTIME}
    rack = switch_on(**retained)
    rack.client("control PLC", 77).send(*U)
    rack.passes(2)
    given_out = rack.client("simple client").exchange(rack.client("").outputs(*U))
    assert given_out == (6,)
    rack.now += 60.0
    generation = rack.client("another control PLC", 78).send(44.0, 80.0, 36.0, generation=1).generation
    assert generation == 2
    assert switch_on(**retained).shown().generation > generation


@pytest.mark.parametrize(
    "odd",
    [
        {"pace": (1, 1e300)},
        {"times": (0, 2**33), "watts": (385.0, 300.0)},
        {"watts": (1e300,)},
        {"program": {}},
        {"program": {"tick": -5}},
        {"program": {"x": [1e300] * 28}},
        {"program": {"x": [0.0] * 28}},
        {"program": {"x": [10**400] * 28}},
        {"program": {"u": [43.0]}},
        {"program": {"noise_state": {}}},
        {"program": {"noise_state": {"bit_generator": "PCG64", "state": {"state": -1, "inc": 2**200}}}},
        {"program": {"noise_state": 7}},
    ],
    ids=str,
)
def test_a_sealed_state_that_cannot_be_is_set_aside_and_the_rack_starts_without(
    switch_on: "SwitchOn", tmp_path: Path, odd: dict[str, Any]
) -> None:
    file = tmp_path / "plant"
    switch_on(retain={"file": str(file)}).client("control PLC", 77).send(*U)
    kept = RetainedFile(file, OWNER, HEADER.short_digest)
    state = kept.load()
    assert state is not None
    if odd.get("program"):
        odd = {"program": state["program"] | odd["program"]}
    kept.save(state | odd)
    rack = switch_on(retain={"file": str(file)})
    assert (rack.tick, file.with_name("plant.refused").exists()) == (0, True)
    (boot,) = rack.events(EventKind.BOOT)
    assert (boot.subject, boot.cause) == (0, 1)
    assert rack.client("control PLC", 77).send(*U).verdict == OutputVerdict.ACCEPTED


@pytest.mark.parametrize("content", [b"", b"coldloop-retained plant/2", b"\x00" * 100])
def test_a_state_that_cannot_be_trusted_is_refused_and_said_so(
    switch_on: "SwitchOn", tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    (tmp_path / "plant").write_bytes(content)
    rack = switch_on(retain={"file": str(tmp_path / "plant")})
    assert rack.tick == 0
    assert "retained state refused" in caplog.text
