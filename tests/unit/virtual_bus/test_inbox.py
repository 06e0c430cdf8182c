"""The inbox of a host port: first in, first out, with a bound."""

from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.timebase import Instant
from virtual_bus.bus.host_port import Inbox, ReceivedFrame
from virtual_bus.frame import Frame


def arrival(number: int) -> ReceivedFrame:
    return ReceivedFrame(Frame(number), Instant(number), False)


@settings(derandomize=True, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 90)), max_size=60))
def test_it_is_a_bounded_queue(steps: list[tuple[bool, int]]) -> None:
    """``steps``: so many put in, or so many taken out."""
    inbox, reference, number = Inbox(200), deque[int](), 0
    for puts, count in steps:
        for _ in range(count):
            if puts:
                kept = inbox.put(arrival(number))
                assert kept == (len(reference) < 200)
                if kept:
                    reference.append(number)
                number += 1
            elif reference:
                assert inbox.take().frame.can_id == reference.popleft()
            assert len(inbox) == len(reference)
            assert bool(inbox) == bool(reference)


def test_an_empty_one_gives_nothing() -> None:
    with pytest.raises(IndexError):
        Inbox(1).take()


def test_what_was_taken_is_not_kept() -> None:
    inbox = Inbox(10_000)
    for number in range(10_000):
        inbox.put(arrival(number))
    for _ in range(9_999):
        inbox.take()
    assert len(inbox._arrivals) < 200
