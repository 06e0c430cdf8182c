"""The greatest value that a drive takes, on a scripted node."""

from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from servobench.drivers.canopen.objects import Granted, RemoteObjects, write_greatest
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

SLOPE, RANGE, HIGH, LOW, STATE = 0x6087, 0x06090030, 0x06090031, 0x06090032, 0x08000022


class Bounded(FakeServo):
    """Refuses a torque slope outside its bounds, or cuts it."""

    def __init__(self, bus: FakeBus, held: int, most: int, least: int = 0, code: int = HIGH) -> None:
        self.most, self.least, self.code = most, least, code
        self.cuts = False
        super().__init__(bus)
        self.types[SLOPE, 0] = "I"
        self.values[SLOPE, 0] = held

    def _download(self, index: int, sub: int, data: bytes) -> bytes:
        self.refuse.pop((index, sub), None)
        value = int.from_bytes(data, "little")
        if index == SLOPE and value < self.least:
            self.refuse[index, sub] = LOW
        elif index == SLOPE and value > self.most and self.cuts:
            data = self.most.to_bytes(4, "little")
        elif index == SLOPE and value > self.most:
            self.refuse[index, sub] = self.code
        return super()._download(index, sub, data)


@dataclass
class Node:
    """A bounded drive, and how it is asked."""

    bus: FakeBus
    objects: RemoteObjects

    def written(self) -> int:
        """Downloads of the slope so far."""
        return sum(data[1:3] == bytes([0x87, 0x60]) and data[0] >> 5 == 1 for data in self.bus.sent_to(0x601))


@pytest.fixture
def node() -> Iterator[Node]:
    bus, network = make_network()
    yield Node(bus, RemoteObjects(network, 1))
    bus.shutdown()


@pytest.mark.parametrize("code", [RANGE, HIGH])
@pytest.mark.parametrize(
    ("held", "least", "most"), [(100, 0, 10_000), (0, 0, 1000), (0, 5000, 10_000), (1, 1, 1), (7, 0, 49_999)]
)
def test_the_limit_of_a_drive_is_found(node: Node, held: int, least: int, most: int, code: int) -> None:
    servo = Bounded(node.bus, held, most, least, code)
    granted = write_greatest(node.objects, SLOPE, "I", 50_000, "torque slope")
    assert (granted.held, servo.values[SLOPE, 0]) == (most, most)
    (note,) = granted.notes
    assert note.startswith(
        f"6087h:00 holds {most}, 50000 was asked for (torque slope): abort code {code:08X}h"
    )
    assert node.written() <= 25


def test_the_limit_of_32_bits_is_found_to_a_hundred_thousandth(node: Node) -> None:
    servo = Bounded(node.bus, 1, 3_000_000_001)
    granted = write_greatest(node.objects, SLOPE, "I", 0xFFFF_FFFF, "torque slope")
    assert granted.held == servo.values[SLOPE, 0] == pytest.approx(3_000_000_001, rel=1e-5)
    assert granted.held <= 3_000_000_001
    assert node.written() <= 25


def test_a_drive_that_cuts_a_value_is_told_of(node: Node) -> None:
    servo = Bounded(node.bus, 100, 10_000)
    servo.cuts = True
    granted = write_greatest(node.objects, SLOPE, "I", 50_000, "torque slope")
    assert granted.held == 10_000
    assert granted.notes == ["6087h:00 holds 10000, 50000 was asked for (torque slope): not taken"]


@pytest.mark.parametrize(("code", "least"), [(STATE, 0), (LOW, 70_000)])
def test_another_refusal_is_no_limit(node: Node, code: int, least: int) -> None:
    Bounded(node.bus, 100, 10_000, least, code)
    granted = write_greatest(node.objects, SLOPE, "I", 50_000, "torque slope")
    assert granted.held == 100
    assert granted.notes[0].startswith(f"6087h:00 refused 50000 (torque slope): abort code {code:08X}h")
    assert node.written() == 1


def test_a_drive_without_the_object_is_told_of(node: Node) -> None:
    FakeServo(node.bus)
    granted = write_greatest(node.objects, SLOPE, "I", 50_000, "torque slope")
    assert granted == Granted(None, ["6087h:00 is missing: torque slope left to the drive"])
