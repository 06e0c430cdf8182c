"""When a shaft counts as at rest."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402 import rest
from servobench.drivers.cia402.readings import ReadingAssembler
from servobench.drivers.cia402.rest import REST_FOR, REST_RAD_S, resting_since, slow
from servobench.drivers.errors import DriveInFault, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from tests.unit.drivers.drive_bench import Bench, configured_drive


@pytest.fixture
def bench() -> Iterator[Bench]:
    with configured_drive() as bench:
        yield bench


def turn(bench: Bench, speed_rad_s: float) -> None:
    _, servo, _, drive = bench
    servo.values[0x606C, 0] = round(speed_rad_s / drive.assembler.scaling.velocity_rad_s)


def rested_since(bench: Bench, limit: Duration) -> Instant:
    _, _, network, drive = bench
    return resting_since(drive.control, drive.assembler, network.deadline_after(limit))


def test_a_shaft_is_slow_below_one_radian_a_second_either_way(bench: Bench) -> None:
    _, _, _, drive = bench
    assert REST_RAD_S == 1.0
    for speed, is_slow in ((0.99, True), (1.01, False), (0.0, True)):
        for sign in (1.0, -1.0):
            turn(bench, sign * speed)
            assert slow(drive.objects, drive.assembler) is is_slow, sign * speed


def test_a_radian_a_second_is_not_slow() -> None:
    """Of a drive that counts in rad/s."""
    objects = cast(RemoteObjects, SimpleNamespace(read=lambda *_: 1))
    scaling = SimpleNamespace(velocity_rad_s=1.0)
    assert not slow(objects, cast(ReadingAssembler, SimpleNamespace(scaling=scaling)))


def test_a_drive_that_was_never_configured_was_never_moved(bench: Bench) -> None:
    bus, _, _, drive = bench
    turn(bench, 100.0)
    asked = len(bus.sent)
    assert slow(drive.objects, None)
    assert len(bus.sent) == asked


def test_rest_is_a_tenth_of_a_second_of_slow_readings(bench: Bench) -> None:
    _, _, network, _ = bench
    assert REST_FOR == 100 * NS_PER_MS
    began = network.clock.now()
    assert rested_since(bench, Duration(NS_PER_S)) == began
    assert 0 <= network.clock.now() - began - REST_FOR < 15 * NS_PER_MS


def test_rest_begins_anew_with_each_reading_that_is_not_slow(bench: Bench) -> None:
    bus, servo, network, _ = bench
    began = network.clock.now()
    turn(bench, 5.0)
    bus.call_after(50 * NS_PER_MS, lambda: turn(bench, 0.0))
    bus.call_after(100 * NS_PER_MS, lambda: turn(bench, -5.0))
    bus.call_after(150 * NS_PER_MS, lambda: turn(bench, 0.0))
    since = rested_since(bench, Duration(NS_PER_S))
    assert 130 * NS_PER_MS <= since - began <= 160 * NS_PER_MS
    assert network.clock.now() - since >= REST_FOR
    assert servo.values[0x606C, 0] == 0


def test_a_drive_is_polled_a_hundred_times_a_second(bench: Bench) -> None:
    """Often enough for a shaft that swings, seldom enough for the bus of other drives."""
    bus, _, _, _ = bench
    asked = len(bus.sent_to(0x601))
    rested_since(bench, Duration(NS_PER_S))
    assert 9 <= len(bus.sent_to(0x601)) - asked <= 12


def test_a_shaft_that_turns_at_the_deadline_is_told_then(bench: Bench) -> None:
    _, _, network, _ = bench
    turn(bench, 2.0)
    began = network.clock.now()
    with pytest.raises(DriveInFault, match="did not stay at rest in time"):
        rested_since(bench, Duration(300 * NS_PER_MS))
    assert 0 <= network.clock.now() - began - 300 * NS_PER_MS < 30 * NS_PER_MS


def test_the_deadline_itself_is_too_late(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive that answers as soon as it is asked is asked at the very instant."""
    _, _, network, drive = bench
    turn(bench, 2.0)
    asked = []

    def turning(_objects: object, _assembler: object) -> bool:
        asked.append(network.clock.now())
        return False

    began = network.clock.now()
    monkeypatch.setattr(rest, "slow", turning)
    with pytest.raises(DriveInFault):
        resting_since(drive.control, drive.assembler, Instant(began + 20 * NS_PER_MS))
    assert asked == [began, began + 10 * NS_PER_MS, began + 20 * NS_PER_MS]


def test_rest_is_reached_at_the_end_of_its_time_itself(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, network, _ = bench
    monkeypatch.setattr(rest, "slow", lambda _objects, _assembler: True)
    began = network.clock.now()
    assert rested_since(bench, Duration(NS_PER_S)) == began
    assert network.clock.now() == began + REST_FOR


def test_rest_that_has_begun_is_waited_for_beyond_the_deadline(bench: Bench) -> None:
    _, _, network, _ = bench
    began = network.clock.now()
    assert rested_since(bench, Duration(20 * NS_PER_MS)) == began
    assert network.clock.now() - began >= REST_FOR


def test_a_drive_that_does_not_tell_is_an_error(bench: Bench) -> None:
    _, servo, _, _ = bench
    servo.silent = True
    with pytest.raises(PeerFault):
        rested_since(bench, Duration(NS_PER_S))
