"""Setting a drive up that lacks something, or whose dictionary is known."""

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest

from drivers.drive_setup import DriveSettings
from drivers.network import CanopenNetwork
from drivers.objects import SettingRefused
from drivers.pdo_capability import capability_of
from drivers.pdo_planner import PlanImpossible
from drivers.servo import ServoDrive
from drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from tests.unit.drivers.eds_maker import four_pdos, sheet
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

PERIOD = Duration(NS_PER_MS)
SETTINGS = DriveSettings(PERIOD, torque_max_nm=5.0, speed_max_rad_s=250.0)
Bench = tuple[FakeBus, FakeServo, CanopenNetwork, ServoDrive]


@pytest.fixture
def bench() -> Iterator[Bench]:
    bus, network = make_network()
    yield bus, FakeServo(bus), network, ServoDrive(network, 1, "axis1")
    bus.shutdown()


def soon(network: CanopenNetwork) -> Instant:
    return network.deadline_after(Duration(NS_PER_S))


def cycle(bench: Bench) -> None:
    _, _, network, _ = bench
    network.send_sync()
    network.pump(network.deadline_after(PERIOD))


@pytest.mark.parametrize("missing", [(0x1016, 0), (0x1017, 0)])
def test_a_drive_without_heartbeats_is_served_only_on_the_users_word(
    bench: Bench, missing: tuple[int, int]
) -> None:
    _, servo, network, drive = bench
    del servo.types[missing]
    drive.connect(soon(network))
    with pytest.raises(SettingRefused, match=f"has no {missing[0]:04X}h.*unwatched = true"):
        drive.configure(SETTINGS)
    notes = drive.configure(replace(SETTINGS, unwatched=True))
    assert f"{missing[0]:04X}h is missing" in notes[0]
    drive.enable(soon(network))
    cycle(bench)
    drive.check()
    assert len(drive.take_readings()) == 1
    assert drive.release().at_rest


def test_a_drive_that_keeps_its_mappings_is_served_by_them(bench: Bench) -> None:
    _, servo, network, drive = bench
    words = {
        0x1A00: (0x60410010, 0x60770010),
        0x1A01: (0x60640020, 0x606C0020),
        0x1600: (0x60400010, 0x60710010),
    }
    for mapping, entries in words.items():
        servo.values[mapping, 0] = len(entries)
        for sub, word in enumerate(entries, start=1):
            servo.values[mapping, sub] = word
        servo.refuse.update({(mapping, sub): 0x06010002 for sub in range(9)})
    drive.connect(soon(network))
    notes = drive.configure(SETTINGS)
    assert any("mappings are used as the drive has them" in note for note in notes)
    drive.enable(soon(network))
    servo.values[0x606C, 0], servo.values[0x6077, 0] = 1000, 500
    cycle(bench)
    (reading,) = drive.take_readings()
    assert reading.torque_nm == pytest.approx(1.0)
    assert reading.velocity_rad_s == pytest.approx(2 * math.pi / 60)


def test_a_plan_is_made_for_what_the_dictionary_says(bench: Bench) -> None:
    _, servo, network, drive = bench
    capability = capability_of(sheet(four_pdos(entries=2)))
    drive.connect(soon(network))
    drive.configure(replace(SETTINGS, capability=capability))
    assert drive.plan is not None
    assert [len(pdo.entries) for pdo in drive.plan.tpdos] == [2, 2]
    assert servo.values[0x1A00, 0] == 2
    drive.configure(replace(SETTINGS, capability=capability_of(sheet(four_pdos(), without=(0x6077,)))))
    drive.enable(soon(network))
    servo.values[0x6077, 0] = 500
    cycle(bench)
    (reading,) = drive.take_readings()
    assert reading.torque_nm == 0.0
    assert "readings carry no torque" in " ".join(drive.notes)


def test_a_dictionary_that_leaves_no_way_is_told_before_anything_is_mapped(bench: Bench) -> None:
    _, servo, network, drive = bench
    drive.connect(soon(network))
    with pytest.raises(PlanImpossible, match="6064h:00 is not in the dictionary"):
        drive.configure(replace(SETTINGS, capability=capability_of(sheet(four_pdos(), without=(0x6064,)))))
    assert servo.values[0x1A00, 0] == 0
