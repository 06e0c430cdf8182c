"""The one place where frames wait: order, bound, and what the owner notes beside a frame."""

from servobench.drivers.timebase import NEVER
from servobench.virtual_bus.core.native import HELD_MAX, HeldFrames
from servobench.virtual_bus.frame import Frame


def frame(n: int) -> Frame:
    return Frame(0x180 + n)


def test_frames_go_by_their_release_and_those_of_one_instant_in_the_order_of_coming() -> None:
    held = HeldFrames()
    for n, release in enumerate((30, 10, 20, 10)):
        assert held.hold(frame(n), release, n)
    assert (len(held), held.next_at()) == (4, 10)
    assert held.take(9) is None
    taken = [held.take(25) for _ in range(4)]
    assert [(item[0], item[2], item[3]) for item in taken if item is not None] == [
        (10, frame(1), 1),
        (10, frame(3), 3),
        (20, frame(2), 2),
    ]
    assert taken[3] is None


def test_what_has_no_room_is_lost_and_counted() -> None:
    held = HeldFrames()
    assert all(held.hold(frame(0), n) for n in range(HELD_MAX))
    assert not held.hold(frame(1), 0)
    assert (len(held), held.overflow) == (HELD_MAX, 1)
    held.clear()
    assert (held.next_at(), held.take(NEVER), held.overflow) == (NEVER, None, 1)
    assert held.hold(frame(2), 5)
