"""When faults begin and end."""

from coldloop_chaos.faults import LinkCut, ProcessStop
from coldloop_chaos.sequencer import Timeline

KILL = ProcessStop(kind="kill", process="optimizer", at_s=10, duration_s=20)
FREEZE = LinkCut(kind="freeze", link="plant", at_s=15, duration_s=5)


def test_faults_may_lie_within_each_other() -> None:
    timeline = Timeline([KILL, FREEZE], factor=None)
    assert timeline.next_tick == 40
    assert timeline.due(39, 1e6) is None
    for tick, fault in ((40, KILL), (60, FREEZE)):
        moment = timeline.due(tick, 0.0)
        assert moment is not None
        assert moment.fault is fault
        timeline.begun(moment, 0.0)
    assert timeline.next_tick == 80
    assert [timeline.due(tick, 0.0) is not None for tick in (79, 80, 119, 120, 121)] == [
        False,
        True,
        False,
        True,
        False,
    ]
    assert timeline.next_tick is None


def test_in_real_time_a_fault_ends_by_the_clock_though_plant_time_stands() -> None:
    timeline = Timeline([KILL], factor=10.0)
    moment = timeline.due(40, 4.0)
    assert moment is not None
    assert timeline.left_s(4.0) is None
    timeline.begun(moment, 4.0)
    assert timeline.left_s(5.0) == 1.0
    assert timeline.due(41, 5.9) is None
    end = timeline.due(41, 6.0)
    assert end is not None
    assert not end.is_begin


def test_a_fault_that_is_cut_short_does_not_end_twice() -> None:
    timeline = Timeline([KILL], factor=None)
    moment = timeline.due(40, 0.0)
    assert moment is not None
    timeline.begun(moment, 0.0)
    timeline.take(timeline.on[0])
    assert timeline.due(1000, 0.0) is None
