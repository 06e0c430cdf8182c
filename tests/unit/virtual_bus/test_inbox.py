"""The inbox of a host port: first in, first out."""

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.core.native import HostPlace
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.timeline import Timeline
from tests.draws import examples_of


@examples_of(100)
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 90)), max_size=60))
def test_it_is_a_queue(steps: list[tuple[bool, int]]) -> None:
    """``steps``: so many put in, or so many taken out."""
    inbox, reference, number = HostPlace(Timeline()), deque[tuple[int, int, bool]](), 0
    for puts, count in steps:
        for _ in range(count):
            if puts:
                own = number % 3 == 0
                (inbox.on_sent if own else inbox.on_frame)(Frame(number % 2048), Instant(number))
                reference.append((number % 2048, number, own))
                number += 1
            elif reference:
                received = inbox.receive(Instant(0))
                assert received is not None
                frame, at, own = received
                assert (frame.can_id, at, own) == reference.popleft()
            else:
                assert inbox.receive(Instant(0)) is None
            assert len(inbox) == len(reference)
            assert bool(inbox) == bool(reference)


def test_without_a_port_it_sends_nothing() -> None:
    with pytest.raises(ValueError, match="no port"):
        HostPlace(Timeline()).transmit(Frame(1))
