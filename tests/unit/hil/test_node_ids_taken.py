"""Who has the node-ID that a simulated drive is about to take: on a simulated segment, in simulated time."""

from types import SimpleNamespace

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.simulated_drives import refuse_taken
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.device.background import Stream, background_nodes
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import SimulatedClock, Timeline


class Segment:
    """Drives, streams of frames by identifier, and who looks."""

    def __init__(self, *nodes: int, streams: tuple[int, ...] = ()) -> None:
        self.timeline = Timeline()
        segment = CanSegment(self.timeline)
        self.sent: list[int] = []
        segment.add_monitor(lambda frame, _at: self.sent.append(frame.can_id))
        for node in nodes:
            AttachedDevice(SimulatedServo(node, LING2012.parameters), segment, f"{node}")
        kinds = tuple(Stream(can_id, Duration(50 * NS_PER_MS), bytes_max=8) for can_id in streams)
        for number, other in enumerate(background_nodes(kinds, 0)):
            AttachedDevice(other, segment, f"stream {number}")
        self.bus = SimulatedBus(segment=segment)
        clock = SimulatedClock(self.timeline)
        self.link, self.clock = BusLink(self.bus, clock, StampSource.MONOTONIC, "can0"), clock

    def look(self, *nodes: int, force: bool = False) -> list[str]:
        said: list[str] = []
        refuse_taken(self.link, self.clock, nodes, said.append, force)
        return said

    @property
    def asked(self) -> list[int]:
        return [can_id - 0x600 for can_id in self.sent if 0x600 < can_id < 0x680]


def test_who_answers_is_named() -> None:
    segment = Segment(1, 5)
    with pytest.raises(BadInput) as caught:
        segment.look(1, 2, 5)
    who = "is there: servobench simulated servo drive answers"
    assert caught.value.value == f"node 1 {who}; node 5 {who}"
    assert (caught.value.source, caught.value.key) == ("--node", "")
    assert caught.value.expected == "node-IDs that nobody has on can0"
    assert segment.look(5, force=True) == [
        "forced: joining can0 although node 5 is there: servobench simulated servo drive answers"
    ]


def test_a_free_id_is_asked_twice_after_a_second_of_listening() -> None:
    segment = Segment(1)
    assert segment.look(2) == []
    assert segment.asked == [2, 2]
    assert segment.timeline.now == NS_PER_S + 2 * 100 * NS_PER_MS


@pytest.mark.parametrize(
    ("can_id", "told"),
    [
        (0x702, "a heartbeat"), (0x082, "an EMCY"), (0x182, "a TPDO1"), (0x282, "a TPDO2"),
        (0x382, "a TPDO3"), (0x482, "a TPDO4"), (0x582, "an SDO answer"),
    ],
)  # fmt: skip
def test_who_is_only_heard_is_there_too(can_id: int, told: str) -> None:
    segment = Segment(streams=(can_id,))
    with pytest.raises(BadInput) as caught:
        segment.look(1, 2)
    assert f"found 'node 2 is there: {told} was heard', expected" in str(caught.value)


@pytest.mark.parametrize("can_id", [0x602, 0x202, 0x302, 0x402, 0x502])
def test_what_a_master_says_is_no_node(can_id: int) -> None:
    assert Segment(streams=(can_id,)).look(2) == []


@pytest.mark.parametrize("node", [0, 128, 255])
def test_ids_that_are_none_are_passed_over(node: int) -> None:
    segment = Segment(1)
    assert segment.look(node) == []
    assert segment.asked == []
    assert segment.timeline.now == 0


@pytest.mark.parametrize("node", [1, 127])
def test_the_first_and_the_last_id_are_asked(node: int) -> None:
    segment = Segment()
    assert segment.look(node) == []
    assert segment.asked == [node, node]


@pytest.mark.parametrize(("alone", "asked"), [(True, []), (False, [1])])
def test_nobody_is_asked_where_nobody_is(
    monkeypatch: pytest.MonkeyPatch, alone: bool, asked: list[int]
) -> None:
    segment = Segment(1)
    monkeypatch.setattr(segment.bus, "status", lambda: SimpleNamespace(alone=alone), raising=False)
    if alone:
        assert segment.look(1) == []
    else:
        with pytest.raises(BadInput):
            segment.look(1)
    assert sorted(set(segment.asked)) == asked
