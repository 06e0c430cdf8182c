"""Acceptance filters as python-can has them."""

import random
from typing import Any

import can
import pytest

from servobench.drivers.wire.frame_port import WireFrame, accepts


class Nowhere(can.BusABC):
    """A bus for its filters alone."""

    def __init__(self) -> None:
        self.channel_info, self._is_shutdown = "", True
        super().__init__("")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.mark.parametrize("seed", range(3))
def test_python_can_accepts_the_same_frames(seed: int) -> None:
    draw, bus = random.Random(seed), Nowhere()
    outcomes = set()
    for _ in range(800):
        filters: list[Any] = []
        for _ in range(draw.randint(1, 3)):
            one = {
                "can_id": draw.choice((0x81, 0x181, 0x182, 0x600)),
                "can_mask": draw.choice((0x7FF, 0x780, 1)),
            }
            if draw.random() < 0.5:
                one["extended"] = draw.random() < 0.5
            filters.append(one)
        can_id, extended = draw.choice((0x81, 0x181, 0x1FF, 0x601)), draw.random() < 0.5
        bus.set_filters(filters)
        wanted = bus._matches_filters(can.Message(arbitration_id=can_id, is_extended_id=extended))
        assert accepts(filters, WireFrame(can_id, b"", extended)) == wanted
        outcomes.add(wanted)
    assert outcomes == {True, False}


def test_without_a_filter_nothing_is_accepted() -> None:
    assert not accepts([], WireFrame(0x181, b""))
