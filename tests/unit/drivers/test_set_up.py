"""Setting a drive up that lacks something, or whose dictionary is known."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.pdo_planner import PlanImpossible
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import TransferAborted
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
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


@pytest.mark.parametrize("held", [0, 126 << 16 | 150, 127 << 16 | 60_000])
def test_a_drive_that_ceased_to_watch_the_host_is_told_of_when_it_is_let_go(bench: Bench, held: int) -> None:
    _, servo, network, drive = bench
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    servo.values[0x1016, 1] = held
    release = drive.release()
    assert release.at_rest
    assert f"1016h:01 held {held:08X}h at the end, 007F0096h was written" in release.unwatched
    assert servo.values[0x1016, 1] == 0


def test_a_drive_that_watched_the_host_to_the_end_is_let_go_without_a_word(bench: Bench) -> None:
    _, _, network, drive = bench
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    assert drive.release().unwatched == ""


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


STAMP, DEMAND, MODE = 0x10130020, 0x60740010, 0x60610008
NOT_MAPPABLE, LENGTH = 0x06040041, 0x06090030


class Choosy(FakeServo):
    """Refuses some objects in a mapping, and event-driven TPDOs if it is told to."""

    def __init__(self, bus: FakeBus, unmapped: set[int], *, events: bool = True) -> None:
        self.unmapped, self.events = unmapped, events
        super().__init__(bus)

    def _download(self, index: int, sub: int, data: bytes) -> bytes:
        value = int.from_bytes(data, "little")
        self.refuse.pop((index, sub), None)
        if index & 0xFE00 == 0x1A00 and value in self.unmapped:
            self.refuse[index, sub] = NOT_MAPPABLE
        elif index & 0xFE00 == 0x1800 and sub == 2 and value > 240 and not self.events:
            self.refuse[index, sub] = LENGTH
        return super()._download(index, sub, data)


@pytest.mark.parametrize(
    ("unmapped", "events", "mapped", "lost"),
    [
        (set(), True, [[0x606C, 0x1013], [0x6077, 0x6064, 0x6074], [0x6041, 0x6061]], []),
        ({DEMAND}, True, [[0x606C, 0x1013], [0x6077, 0x6064], [0x6041, 0x6061]], ["no 6074h"]),
        ({STAMP}, True, [[0x606C], [0x6077, 0x6064, 0x6074], [0x6041, 0x6061]], ["no 1013h"]),
        ({MODE}, True, [[0x606C, 0x1013], [0x6077, 0x6064, 0x6074], [0x6041]], ["no 6061h"]),
        (
            set(),
            False,
            [[0x606C, 0x1013], [0x6077, 0x6064, 0x6041]],
            ["no 6074h", "6041h is not told on change", "no 6061h"],
        ),
        (
            {STAMP, DEMAND},
            False,
            [[0x606C, 0x6041, 0x6061], [0x6077, 0x6064]],
            ["no 1013h", "no 6074h", "6041h is not told on change"],
        ),
    ],
)
def test_a_drive_that_refuses_part_of_the_plan_is_served_by_the_next_best(
    unmapped: set[int], events: bool, mapped: list[list[int]], lost: list[str]
) -> None:
    bus, network = make_network()
    servo = Choosy(bus, unmapped, events=events)
    for number in range(4):
        servo.values[0x1800 + number, 2] = 1
    drive = ServoDrive(network, 1, "axis1")
    drive.connect(soon(network))
    notes = drive.configure(SETTINGS)
    assert drive.plan is not None
    assert [[entry.index for entry in pdo.entries] for pdo in drive.plan.tpdos] == mapped
    told = [note for note in notes if note.startswith(("no 6074h", "no 1013h", "6041h is not", "no 6061h"))]
    assert [note[: len(text)] for note, text in zip(told, lost, strict=True)] == lost
    assert any("a PDO plan that tells more was not taken: abort code" in note for note in notes) == bool(lost)
    drive.enable(soon(network))
    bench = (bus, servo, network, drive)
    cycle(bench)
    drive.check()
    (reading,) = drive.take_readings()
    assert (reading.device_time_ns is None) == (STAMP in unmapped)
    assert len(drive.take_readbacks()) == (DEMAND not in unmapped and events)
    bus.shutdown()


class HalfFixed(FakeServo):
    """Takes only those words into the mappings of ``kept`` that they hold from the factory; the refusal comes
    with sub 1, when sub 0 is 0 already."""

    HELD: Final = {
        0x1A00: (0x60410010, 0x60770010),
        0x1A01: (0x60640020, 0x606C0020),
        0x1600: (0x60710010, 0x60400010),
    }

    def __init__(
        self, bus: FakeBus, kept: tuple[int, ...], mappings: Mapping[int, tuple[int, ...]] = HELD
    ) -> None:
        self.kept, self.mappings = kept, mappings
        super().__init__(bus)
        for mapping, words in mappings.items():
            self.values[mapping - 0x200, 1] &= 0x7FFFFFFF
            for sub, word in enumerate((len(words), *words)):
                self.values[mapping, sub] = word

    def _download(self, index: int, sub: int, data: bytes) -> bytes:
        self.refuse.pop((index, sub), None)
        held = (*self.mappings.get(index, ()), *8 * (0,))
        if index & 0xFF00 in self.kept and sub and int.from_bytes(data, "little") != held[sub - 1]:
            self.refuse[index, sub] = NOT_MAPPABLE
        return super()._download(index, sub, data)

    def pdos(self) -> dict[tuple[int, int], int]:
        """Parameters of all PDOs: what is mapped, and to where."""
        return {
            (index, sub): value
            for (index, sub), value in self.values.items()
            if 0x1400 <= index < 0x1B00 and sub <= self.values.get((index, 0), 0)
        }


@pytest.mark.parametrize(
    ("kept", "told"),
    [
        ((0x1600, 0x1A00), "mappings are used as the drive has them: abort code 06040041h"),
        ((0x1600,), "RPDO mappings are used as the drive has them: abort code 06040041h"),
        ((0x1A00,), "TPDO mappings are used as the drive has them: abort code 06040041h"),
    ],
)
def test_a_drive_that_refuses_the_first_word_of_a_mapping_is_served_by_those_that_it_holds(
    kept: tuple[int, ...], told: str
) -> None:
    bus, network = make_network()
    servo = HalfFixed(bus, kept)
    drive = ServoDrive(network, 1, "axis1")
    drive.connect(soon(network))
    assert any(note.startswith(told) for note in drive.configure(SETTINGS))
    drive.enable(soon(network))
    servo.values[0x606C, 0] = 1000
    cycle((bus, servo, network, drive))
    (reading,) = drive.take_readings()
    assert reading.velocity_rad_s == pytest.approx(2 * math.pi / 60)
    bus.shutdown()


@pytest.mark.parametrize("refused", [(), ((0x1A00, 2),)])
def test_the_count_travels_with_the_speed_or_its_lack_is_told(
    bench: Bench, refused: tuple[tuple[int, int], ...]
) -> None:
    _, servo, network, drive = bench
    servo.refuse.update(dict.fromkeys(refused, 0x06040041))
    drive.connect(soon(network))
    notes = drive.configure(replace(SETTINGS, counted=True))
    told = [note for note in notes if note.startswith("no 6064h beside 606Ch: no reading has a count")]
    assert bool(told) == bool(refused)
    drive.enable(soon(network))
    servo.values[0x606C, 0], servo.values[0x6064, 0] = 1000, 5000
    cycle(bench)
    (reading,) = drive.take_readings()
    assert math.isnan(reading.counted_rad) == bool(refused)
    assert reading.velocity_rad_s == pytest.approx(2 * math.pi / 60)


@pytest.mark.parametrize("first", [0x1600, 0x1A00])
def test_a_drive_that_cannot_be_served_holds_the_pdos_that_it_held(first: int) -> None:
    bus, network = make_network()
    others = {first: (0x60410010,) if first == 0x1A00 else (0x60400010,), 0x1A01: (0x60640020,)}
    servo = HalfFixed(bus, (first,), others)
    drive = ServoDrive(network, 1, "axis1")
    drive.connect(soon(network))
    before = servo.pdos()
    with pytest.raises(TransferAborted, match="06040041h"):
        drive.configure(SETTINGS)
    assert servo.pdos() == before
    bus.shutdown()


def test_a_drive_without_torque_demand_is_told(bench: Bench) -> None:
    _, servo, network, drive = bench
    del servo.types[0x6074, 0]
    drive.connect(soon(network))
    notes = drive.configure(SETTINGS)
    assert "no 6074h beside the position: which command acts is not measured" in notes
    assert not any("was not taken" in note for note in notes)


def test_the_nmt_state_is_kept_when_the_host_is_lost_where_the_drive_has_a_say_in_it(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.types[0x1029, 1], servo.values[0x1029, 1] = "B", 0
    drive.connect(soon(network))
    drive.configure(SETTINGS)
    assert servo.values[0x1029, 1] == 1


def test_a_plan_is_made_for_what_the_dictionary_says(bench: Bench) -> None:
    _, servo, network, drive = bench
    capability = capability_of(sheet(four_pdos(entries=2)))
    drive.connect(soon(network))
    drive.configure(replace(SETTINGS, capability=capability))
    assert drive.plan is not None
    assert [len(pdo.entries) for pdo in drive.plan.tpdos] == [1, 2, 2]
    assert servo.values[0x1A01, 0] == 2
    drive.configure(replace(SETTINGS, capability=capability_of(sheet(four_pdos(), without=(0x6077,)))))
    drive.enable(soon(network))
    servo.values[0x6077, 0] = 500
    cycle(bench)
    (reading,) = drive.take_readings()
    assert math.isnan(reading.torque_nm)
    assert "readings carry no torque" in " ".join(drive.notes)


def test_a_dictionary_that_leaves_no_way_is_told_before_anything_is_mapped(bench: Bench) -> None:
    _, servo, network, drive = bench
    drive.connect(soon(network))
    with pytest.raises(PlanImpossible, match="6064h:00 is not in the dictionary"):
        drive.configure(replace(SETTINGS, capability=capability_of(sheet(four_pdos(), without=(0x6064,)))))
    assert servo.values[0x1A00, 0] == 0
