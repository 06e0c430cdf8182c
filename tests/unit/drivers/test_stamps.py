"""How makers' drives stamp: the tables of drivers/vendors, what is mapped of them, and how it is scaled."""

import re
from typing import Any

import pytest

from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.readings import ReadingAssembler
from servobench.drivers.core.native import LastStatusword
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, Duration
from servobench.drivers.vendors.families import read_family, stamp_for
from servobench.drivers.vendors.stamps import STANDARD_STAMP, StampProfile
from tests.unit.drivers.fake_bus import make_network
from tests.unit.drivers.test_readings import SCALING, SPEED

ELMO, MAXON = 0x9A, 0xFB


def test_a_drive_of_no_known_make_stamps_as_cia_301_says() -> None:
    stamp = stamp_for(0x1234, 1, "somebody's")
    assert stamp is STANDARD_STAMP
    assert (stamp.key, stamp.unit_ns, stamp.resolution_at(125_000), stamp.of_events) == (
        (0x1013, 0), 1000, 1000, True,
    )  # fmt: skip


def test_elmo_keeps_the_last_sync_in_an_object_of_its_own() -> None:
    stamp = stamp_for(ELMO, 1, "Gold Whistle")
    assert (stamp.key, stamp.latched, stamp.of_events) == ((0x2F31, 0), "arrival", False)


@pytest.mark.parametrize(("bitrate", "resolution_ns"), [(1_000_000, 1000), (500_000, 2000), (125_000, 8000)])
def test_epos2_counts_bit_times(bitrate: int, resolution_ns: int) -> None:
    stamp = stamp_for(MAXON, 0x6552, "EPOS2")
    assert (stamp.key, stamp.unit_ns, stamp.resolution_at(bitrate)) == ((0x1013, 0), 1000, resolution_ns)
    assert stamp_for(MAXON, 0x6552, "EPOS4") is STANDARD_STAMP


@pytest.mark.parametrize(
    ("line", "key", "expected"),
    [
        ("unit_us = 0", "stamp.unit_us", "a value > 0"),
        ("unit_us = 2\nresolution_us = 1", "stamp.resolution_us", "at least unit_us = 2"),
        ('resolution = "tick"', "stamp.resolution", '"bit time", or resolution_us'),
        ("bits = 8", "stamp.bits", "16..32"),
        ('latched = "later"', "stamp.latched", "one of sampling, arrival"),
        ('index = "2F31"', "stamp.index", "the index of an object"),
        ('unit_us = "1"', "stamp.unit_us", "a value > 0"),
        ("unit_us = nan", "stamp.unit_us", "a value > 0"),
        ('resolution_us = "1"', "stamp.resolution_us", "at least unit_us = 1.0"),
        ("sub = 256", "stamp.sub", "a sub-index"),
        ("width = 3", "stamp.width", "one of bits, index"),
    ],
)
def test_a_table_that_cannot_be_is_refused(line: str, key: str, expected: str) -> None:
    with pytest.raises(BadInput, match=re.escape(f"{key}: ")) as caught:
        read_family(f'vendor = 1\n[stamp]\nsource = "a manual"\n{line}', "made.toml")
    assert caught.value.expected.startswith(expected)


def test_a_stamp_without_a_source_is_refused() -> None:
    with pytest.raises(BadInput, match=r"stamp\.source"):
        read_family("vendor = 1\n[stamp]\nbits = 16", "made.toml")


def readings(stamp: StampProfile, *raw: int) -> list[int | None]:
    """The drive's time in readings with these stamps, ns."""
    bus, network = make_network()
    plan = mode_plan(1, PlanWish(stamp=stamp.key))
    follow = FollowWatch()
    period = Duration(NS_PER_MS)
    assembler = ReadingAssembler(network, plan, SCALING, period, LastStatusword(), follow, stamp)
    taken = []
    for value in raw:
        bus.deliver(SPEED, plan.tpdos[0].codec().pack(0, value), 0)
        network.pump(network.deadline_after(period))
        taken += [reading.device_time_ns for reading in assembler.take()]
    bus.shutdown()
    return taken


@pytest.mark.parametrize(
    ("keys", "raw", "times_ns"),
    [
        ({"unit_ns": 10_000, "resolution_ns": 10_000}, (5, 105), (50_000, 1_050_000)),
        ({"unit_ns": 500, "resolution_ns": 500}, (4, 2004), (2000, 1_002_000)),
        ({"bits": 16}, (65_000, 464, 1464), (65_000_000, 66_000_000, 67_000_000)),
        ({"bits": 16}, (464, 65_000), (464_000, -536_000)),
        ({"index": 0x2F31}, (7, 8), (7000, 8000)),
    ],
)
def test_stamps_are_scaled_and_counted_on_over_their_wraps(
    keys: dict[str, Any], raw: tuple[int, ...], times_ns: tuple[int, ...]
) -> None:
    assert readings(StampProfile(**keys), *raw) == list(times_ns)


def test_a_makers_object_takes_the_place_of_1013h() -> None:
    plan = mode_plan(1, PlanWish(stamp=(0x2F31, 0)), demand_changes=True)
    mapped = [[entry.index for entry in pdo.entries] for pdo in plan.tpdos]
    assert mapped == [[0x606C, 0x2F31], [0x6077, 0x6064, 0x6074], [0x6041, 0x6061], [0x6074, 0x2F31]]
