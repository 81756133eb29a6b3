"""Plans: what they may hold, and what is said about those that are wrong."""

import pytest

from coldloop.errors import LoadFileError, UsageError
from coldloop.process.settings import settings_of
from coldloop_chaos.faults import (
    SHIPPED,
    SPREAD_S,
    ChaosPlan,
    FrameLoss,
    LinkCut,
    ProcessStop,
    find_plan,
    parsed_plan,
    shipped_plans,
)
from coldloop_rig.process_file.making import made_from
from tests.harness.process_files import COLUMN

KINDS = {
    "delay", "drop", "duplicate", "reorder", "reset", "freeze", "truncate", "abort", "flip",
    "kill", "pause", "restart", "clock", "sensor", "given", "wrong_model",
}  # fmt: skip

HEAD = 'name = "mine"\ndescription = "one of mine"\nduration_s = 600\n'


def with_fault(*lines: str) -> str:
    return "\n".join([HEAD, "[[faults]]", *lines])


def test_the_shipped_plans_are_sound_and_have_all_kinds() -> None:
    plans = shipped_plans()
    assert len(plans) == sum(entry.name.endswith(".toml") for entry in SHIPPED.iterdir())
    assert {fault.kind for plan in plans for fault in plan.faults} == KINDS
    assert all(find_plan(plan.name, {}) == plan for plan in plans)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("name = ", "mine.toml: not TOML"),
        ('name = "mine"', "mine.toml: description: Field required"),
        (HEAD.replace("600", "0.3"), "mine.toml: duration_s: input should be a multiple of 0.25"),
        (HEAD + "sped = 3", "mine.toml: sped: no such key"),
        (with_fault('kind = "explode"', "at_s = 3"), "mine.toml: faults.0: Input tag 'explode'"),
        (with_fault('kind = "drop"', 'link = "plant"', "at_s = 3", "duration_s = 1"), "faults.0.drop.share"),
        (with_fault('kind = "drop"', 'link = "plant"', "at_s = 3", "duration_s = 1", "share = 1.5"), "less than or"),
        (with_fault('kind = "clock"', "duration_s = 3"), "each of `faults` needs at_s"),
        (with_fault('kind = "clock"', "at_s = 600", "duration_s = 3"), "begins after the end of the run"),
        (with_fault('kind = "sensor"', "at_s = 1", "duration_s = 3", 'output = "T5"', 'shows = "value"'), "`value`"),
        (with_fault('kind = "sensor"', "at_s = 1", "duration_s = 3", 'output = "T99"', 'shows = "nan"'), "unknown"),
        (with_fault('kind = "given"', "at_s = 1", "duration_s = 3", 'target = "nc1"', "value = 0"), "refrigerator"),
        ('plant = "refrigerator"\n' + with_fault('kind = "given"', "at_s = 1", "duration_s = 3", 'target = "leak"',
                                                 "value = 99"), "outside 0 to 50"),
        (with_fault('kind = "kill"', "at_s = 1", "duration_s = 9", 'process = "plant"')
         + '\n[[faults]]\nkind = "clock"\nat_s = 5\nduration_s = 1', "begins before 'kill plant' has ended"),
        (HEAD + "every_s = 60", "give every_s and `draw` together"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(text: str, complaint: str) -> None:
    with pytest.raises(UsageError) as error:
        parsed_plan(ChaosPlan, text, "mine.toml", {})
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_a_plan_is_of_the_process_that_it_is_read_for() -> None:
    """A column has a tick of 3 s, samples of 60 s, and none of the cold box's sensors."""
    column = made_from(COLUMN).process
    text = with_fault('kind = "restart"', 'process = "plant"', "at_s = 60")
    with settings_of(column):
        plan = parsed_plan(ChaosPlan, text, "mine.toml", {"updating_period_s": 60.0})
        assert not {"sensor", "refrigerator"} & {one.name for one in shipped_plans()}
        for changes, complaint in (({"duration_s": 599.0}, "multiple of"), ({"updating_period_s": 600.0}, "less than")):
            with pytest.raises(UsageError, match=complaint):
                parsed_plan(ChaosPlan, text, "mine.toml", changes)
    (fault,) = plan.schedule()
    assert (plan.ticks, fault.tick, fault.end_tick) == (600 / column.tick_s, 60 / column.tick_s, 60 / column.tick_s + 1)
    (fault,) = parsed_plan(ChaosPlan, text, "mine.toml", {}).schedule()
    assert (fault.tick, fault.end_tick) == (240, 241)


def test_a_shorter_run_leaves_out_the_faults_behind_its_end() -> None:
    plan = find_plan("kill", {"duration_s": 500.0})
    assert [fault.label for fault in plan.faults] == ["kill optimizer"]


def drawing(seed: int) -> ChaosPlan:
    return ChaosPlan(
        name="x", description="x", duration_s=3600, every_s=600, seed=seed,
        draw=(
            ProcessStop(kind="kill", process="optimizer", duration_s=60),
            LinkCut(kind="reset", link="plant", duration_s=1),
            FrameLoss(kind="drop", link="plant", share=0.1, duration_s=1),
        ),
    )  # fmt: skip


def test_drawn_faults_come_every_so_often_and_follow_the_seed() -> None:
    schedule = drawing(1).schedule()
    assert schedule == drawing(1).schedule()
    assert schedule != drawing(2).schedule()
    assert len(schedule) == 5
    assert all(0 <= (fault.at_s or 0) - 600 * n < SPREAD_S for n, fault in enumerate(schedule, 1))


def test_named_loads_follow_each_other_and_files_do_not() -> None:
    plan = ChaosPlan(name="x", description="x", duration_s=7200, load=("a", "b"))
    assert plan.scenario(385.0).load == plan.model_copy(update={"load": "2h"}).scenario(385.0).load
    with pytest.raises(LoadFileError, match="only named loads"):
        plan.model_copy(update={"load": ("a", "mine.csv")}).scenario(385.0)
