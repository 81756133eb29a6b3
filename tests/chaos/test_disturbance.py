"""What is decided about frames."""

import struct

from hypothesis import given
from hypothesis import strategies as st

from coldloop_chaos.faults import Delay, Direction, Flip, FrameDamage, FrameFault, FrameLoss, Reorder
from coldloop_chaos.proxy import FrameAction, Mangler, take_frames

PDUS = st.binary(min_size=1, max_size=253)
FRAMES = st.lists(
    st.builds(lambda number, pdu: struct.pack(">HHHB", number, 0, len(pdu) + 1, 255) + pdu, st.integers(0, 65535), PDUS)
)
SEEDS = st.text(max_size=4)
SHARES = st.floats(0.01, 1.0)
COMMON = {"link": "plant", "duration_s": 1.0}


def passed(frames: list[bytes], fault: FrameFault | None, seed: str) -> tuple[list[FrameAction], bytes]:
    """Return what is decided about each frame, and what is held back at the end."""
    mangler = Mangler(Direction.REQUESTS, seed)
    return [mangler.decide(frame, [fault] if fault else []) for frame in frames], mangler.release()


def data(outcomes: list[FrameAction]) -> bytes:
    return b"".join(outcome.data for outcome in outcomes)


@given(FRAMES, SEEDS)
def test_an_undisturbed_link_passes_everything_at_once(frames: list[bytes], seed: str) -> None:
    assert passed(frames, None, seed) == ([FrameAction(frame) for frame in frames], b"")


@given(FRAMES, SEEDS, SHARES)
def test_a_fault_of_the_answers_leaves_the_requests_alone(frames: list[bytes], seed: str, share: float) -> None:
    fault = FrameLoss(kind="drop", share=share, direction=Direction.ANSWERS, **COMMON)
    assert data(passed(frames, fault, seed)[0]) == b"".join(frames)


@given(FRAMES, SEEDS, SHARES)
def test_the_same_seed_decides_the_same(frames: list[bytes], seed: str, share: float) -> None:
    fault = Flip(kind="flip", share=share, bits=3, **COMMON)
    assert passed(frames, fault, seed) == passed(frames, fault, seed)


@given(FRAMES, SEEDS, SHARES)
def test_frames_are_lost_whole(frames: list[bytes], seed: str, share: float) -> None:
    outcomes, _ = passed(frames, FrameLoss(kind="drop", share=share, **COMMON), seed)
    assert all(outcome.data in {b"", frame} for frame, outcome in zip(frames, outcomes, strict=True))
    if share == 1.0:
        assert not data(outcomes)


@given(FRAMES, SEEDS, SHARES)
def test_frames_arrive_once_or_twice(frames: list[bytes], seed: str, share: float) -> None:
    outcomes, _ = passed(frames, FrameLoss(kind="duplicate", share=share, **COMMON), seed)
    assert all(outcome.data in {frame, 2 * frame} for frame, outcome in zip(frames, outcomes, strict=True))


@given(FRAMES, SEEDS, SHARES)
def test_overtaken_frames_come_right_after_the_next_one(frames: list[bytes], seed: str, share: float) -> None:
    outcomes, held = passed(frames, Reorder(kind="reorder", share=share, **COMMON), seed)
    arrived = take_frames(bytearray(data(outcomes) + held))
    assert sorted(arrived) == sorted(frames)
    position = 0
    while position < len(frames):
        step = 1 if arrived[position] == frames[position] else 2
        assert sorted(arrived[position : position + step]) == sorted(frames[position : position + step])
        position += step


@given(FRAMES, SEEDS, SHARES, st.integers(1, 64))
def test_so_many_bits_are_flipped(frames: list[bytes], seed: str, share: float, bits: int) -> None:
    outcomes, _ = passed(frames, Flip(kind="flip", share=share, bits=bits, **COMMON), seed)
    for frame, outcome in zip(frames, outcomes, strict=True):
        assert len(outcome.data) == len(frame)
        flipped = sum((a ^ b).bit_count() for a, b in zip(frame, outcome.data, strict=True))
        assert flipped in {0, min(bits, 8 * len(frame))}


@given(FRAMES, SEEDS, SHARES)
def test_half_a_frame_is_the_last_thing_of_a_connection(frames: list[bytes], seed: str, share: float) -> None:
    outcomes, _ = passed(frames, FrameDamage(kind="truncate", share=share, **COMMON), seed)
    for frame, outcome in zip(frames, outcomes, strict=True):
        assert outcome.data == (frame[: len(frame) // 2] if outcome.close else frame)


@given(FRAMES, SEEDS, st.floats(0, 100), st.floats(0, 200))
def test_delays_stay_within_their_jitter(frames: list[bytes], seed: str, delay: float, jitter: float) -> None:
    outcomes, _ = passed(frames, Delay(kind="delay", delay_ms=delay, jitter_ms=jitter, **COMMON), seed)
    assert all(max(0, delay - jitter) <= 1000.001 * o.delay_s <= 1.001 * (delay + jitter) + 1e-6 or o.delay_s == 0
               for o in outcomes)  # fmt: skip


@given(FRAMES, st.data())
def test_frames_are_found_wherever_the_stream_is_cut(frames: list[bytes], draw: st.DataObject) -> None:
    stream, buffer, found = b"".join(frames), bytearray(), []
    cuts = sorted(draw.draw(st.lists(st.integers(0, len(stream)), max_size=5)))
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        buffer += stream[begin:end]
        found += take_frames(buffer)
    assert found == frames
    assert not buffer


def test_what_is_no_modbus_goes_on_as_it_stands() -> None:
    buffer = bytearray(b"GET / HTTP/1.1\r\n")
    assert take_frames(buffer) == [b"GET / HTTP/1.1\r\n"]
    assert not buffer
