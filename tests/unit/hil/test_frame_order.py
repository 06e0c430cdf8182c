"""Frames leave in the order of their instants, however the host came to them."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.drivers.wire.frame_port import ERROR_FLAG, EXTENDED_FLAG
from servobench.hil.recording.frame_files import JITTER_NS, SILENCE_NS, FrameOrder
from servobench.hil.rows.side_rows import FRAME, FRAME_DTYPE
from tests.draws import examples_of

SENT, RECEIVED, SENT_ON_SECOND, RECEIVED_ON_SECOND = 1, 0, 3, 2


def packed(*rows: tuple[int, int]) -> NDArray[np.void]:
    """Frames of (instant, direction and segment)."""
    return np.frombuffer(b"".join(FRAME.pack(at, 0x181, 0, way, b"") for at, way in rows), FRAME_DTYPE)


def written(order: FrameOrder, *drains: NDArray[np.void]) -> list[tuple[int, int]]:
    """(instant, way) of all that came out."""
    found = np.concatenate([*[order.take(drain) for drain in drains], order.rest()])
    return [(int(frame["at"]), int(frame["sent"])) for frame in found]


def test_a_host_that_was_stopped_for_18_s() -> None:
    """It sends first, then fetches what the bus has kept for it, for as long as several drains."""
    stopped = range(NS_PER_S, 19 * NS_PER_S, NS_PER_MS)
    backlog = [(at, RECEIVED) for at in stopped]
    late = 19 * NS_PER_S
    drains = [
        packed((0, SENT), (NS_PER_MS, RECEIVED)),
        packed((late, SENT), *backlog[:5000]),
        packed(*backlog[5000:10000], (late + SILENCE_NS + 1, SENT)),
        packed(*backlog[10000:], (late + SILENCE_NS + 2, SENT), (late + 2 * JITTER_NS, RECEIVED)),
    ]
    order = FrameOrder(1)
    found = written(order, *drains)
    assert len(found) == 2 + 18_000 + 4
    assert all(earlier <= later for (earlier, _), (later, _) in pairwise(found))
    assert order.late == 0


def test_what_is_sent_on_a_silent_segment_waits_no_longer_than_the_silence() -> None:
    order = FrameOrder(1)
    assert not order.take(packed((0, SENT))).size
    out = order.take(packed((SILENCE_NS, SENT), (SILENCE_NS + 5, SENT)))
    assert out["at"].tolist() == [0]


def test_a_segment_that_is_behind_holds_the_others() -> None:
    order = FrameOrder(2)
    ahead = [(at * NS_PER_MS, RECEIVED) for at in range(100)]
    assert not order.take(packed((0, RECEIVED_ON_SECOND), *ahead)).size
    out = order.take(packed((50 * NS_PER_MS, RECEIVED_ON_SECOND), (51 * NS_PER_MS, SENT_ON_SECOND)))
    assert out["at"].max() == 50 * NS_PER_MS - JITTER_NS


def test_an_error_frame_says_nothing_of_what_waits_to_be_received() -> None:
    error = FRAME.pack(90 * NS_PER_MS, 0x4 | ERROR_FLAG | EXTENDED_FLAG, 8, RECEIVED, b"")
    order = FrameOrder(1)
    out = written(
        order,
        np.frombuffer(error, FRAME_DTYPE),
        packed((100 * NS_PER_MS, SENT), (10 * NS_PER_MS, RECEIVED), (99 * NS_PER_MS, RECEIVED)),
    )
    assert [at // NS_PER_MS for at, _ in out] == [10, 90, 99, 100]
    assert order.late == 0


def test_frames_of_one_instant_stay_as_they_came() -> None:
    order = FrameOrder(1)
    ways = [SENT, RECEIVED, RECEIVED, SENT, RECEIVED]
    assert [way for _, way in written(order, *[packed((5, way)) for way in ways])] == ways


def test_what_comes_too_late_is_written_and_counted() -> None:
    order = FrameOrder(1)
    found = written(order, packed((NS_PER_S, RECEIVED), (2 * NS_PER_S, RECEIVED)), packed((0, RECEIVED)))
    assert [at for at, _ in found] == [NS_PER_S, 0, 2 * NS_PER_S]
    assert order.late == 1


@examples_of(100)
@given(
    gaps=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 3), st.integers(0, 900)), max_size=60),
    cuts=st.lists(st.integers(0, 59), max_size=20),
)
def test_any_run_leaves_in_order_wherever_it_is_drained(
    gaps: list[tuple[int, int, int]], cuts: list[int]
) -> None:
    """What is sent is pushed at its instant, what is received later than it came, in its order."""
    pushes, now = [], 0
    came = {RECEIVED: 0, RECEIVED_ON_SECOND: 0}
    for gap, way, age in gaps:
        now += gap * NS_PER_MS
        if way in came:
            came[way] = max(came[way], now - age * NS_PER_MS)
            pushes.append((came[way], way))
        else:
            pushes.append((now, way))
    edges = [0, *sorted(cut for cut in cuts if cut < len(pushes)), len(pushes)]
    order = FrameOrder(2)
    found = written(order, *[packed(*pushes[first:end]) for first, end in pairwise(edges)])
    assert sorted(found) == sorted(pushes)
    if order.late == 0:
        assert found == sorted(pushes, key=lambda frame: frame[0])
