"""Names and SI units of objects in a trace."""

import math

import pytest

from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.hil.reviewing.trace.node_objects import NodeObjects

U32 = 4
RATED_NM, RATED_A = 1.27, 4.0
COUNTS = 4000
RPM = 2.0 * math.pi / 60.0


@pytest.fixture
def drive() -> NodeObjects:
    """One that has told its units: 4000 increments a turn, 0.001 r/min, rated torque and current."""
    objects = NodeObjects()
    for index, sub, value in (
        (0x6076, 0, 1270),
        (0x6075, 0, 4000),
        (0x608F, 1, COUNTS),
        (0x608F, 2, 1),
        (0x60A9, 0, 0xFDB44700),
    ):
        objects.take(index, sub, value.to_bytes(U32, "little"))
    return objects


POSITION = 2.0 * math.pi / COUNTS
VELOCITY = 1e-3 * RPM
TORQUE = RATED_NM / 1000.0

UNITS = {
    # position: demand, actual, following error window, window, offset, following error, target, home offset
    **{
        index: (POSITION, "rad") for index in (0x6062, 0x6064, 0x6065, 0x6067, 0x60B0, 0x60F4, 0x607A, 0x607C)
    },
    # velocity: demand, actual, window, threshold, max profile, profile, end, offset, target
    **{
        index: (VELOCITY, "rad/s")
        for index in (0x606B, 0x606C, 0x606D, 0x606F, 0x607F, 0x6081, 0x6082, 0x60B1, 0x60FF)
    },
    # target torque, max torque, torque demand, torque actual, torque offset
    **{index: (TORQUE, "N m") for index in (0x6071, 0x6072, 0x6074, 0x6077, 0x60B2)},
    # max current, current actual value
    **{index: (RATED_A / 1000.0, "A") for index in (0x6073, 0x6078)},
    # motor rated current and torque, DC link circuit voltage, max motor speed: fixed by CiA 402-2
    0x6075: (1e-3, "A"),
    0x6076: (1e-3, "N m"),
    0x6079: (1e-3, "V"),
    0x6080: (RPM, "rad/s"),
    # profile acceleration, deceleration, quick stop, homing, max acceleration, max deceleration
    **{index: (VELOCITY, "rad/s^2") for index in (0x6083, 0x6084, 0x6085, 0x609A, 0x60C5, 0x60C6)},
}
"""Of one unit of each object, by CiA 402-2."""


@pytest.mark.parametrize("index", UNITS, ids="{:04X}h".format)
def test_each_object_is_told_in_the_unit_of_its_kind(drive: NodeObjects, index: int) -> None:
    factor, unit = UNITS[index]
    told = drive.number(index, 0, 500)
    assert told.unit == unit
    assert told.si == pytest.approx(500 * factor, rel=1e-12)


@pytest.mark.parametrize("index", [0x6040, 0x6041, 0x6060, 0x6070, 0x6074 + 0x100, 0x2000])
def test_what_has_no_unit_is_told_none(drive: NodeObjects, index: int) -> None:
    assert (drive.number(index, 0, 5).si, drive.number(index, 0, 5).unit) == (None, "")


def test_only_what_has_a_direction_is_turned() -> None:
    signs = {"velocity_sign": -1.0, "torque_sign": -1.0}
    turned = NodeObjects(ScaleOverride(1.0, 2.0, 3.0, rated_torque_nm=1000.0, **signs))
    speeds = {index: turned.number(index, 0, 1).si for index, (_, unit) in UNITS.items() if unit == "rad/s"}
    windows = dict.fromkeys((0x606D, 0x606F, 0x607F, 0x6081, 0x6082), 2.0)
    assert speeds == {0x606B: -2.0, 0x606C: -2.0, 0x60B1: -2.0, 0x60FF: -2.0, 0x6080: RPM} | windows
    torques = {index: turned.number(index, 0, 1).si for index in (0x6071, 0x6072, 0x6074, 0x6077, 0x60B2)}
    assert torques == {0x6071: -1.0, 0x6072: 1.0, 0x6074: -1.0, 0x6077: -1.0, 0x60B2: -1.0}


@pytest.mark.parametrize("index", [0x607B, 0x607D])
def test_the_number_of_limits_is_no_position(drive: NodeObjects, index: int) -> None:
    assert drive.number(index, 0, 2).unit == ""
    assert [drive.number(index, sub, 1000).si for sub in (1, 2)] == [pytest.approx(math.pi / 2)] * 2


NAMES = {
    (0x1018, 1): "Vendor-ID",
    (0x1018, 2): "Product code",
    (0x1018, 3): "Revision number",
    (0x1018, 4): "Serial number",
    (0x1400, 1): "RPDO1 COB-ID",
    (0x1401, 2): "RPDO2 transmission type",
    (0x15FF, 3): "RPDO512 inhibit time",
    (0x1800, 5): "TPDO1 event timer",
    (0x1803, 6): "TPDO4 SYNC start value",
    (0x1803, 4): "TPDO4 communication parameter",
    (0x1600, 0): "RPDO1 mapping, number of objects",
    (0x1A01, 3): "TPDO2 mapping, object 3",
    (0x2000, 1): "",
}
WORDS = {
    # CiA 301 table 26, low half of an entry of 1003h
    (0x1003, 1, 0x0000_8130): "life guard or heartbeat error",
    (0x1003, 0, 1): "",
    (0x1001, 0, 0x07): "generic, current, voltage",
    (0x603F, 0, 0x8130): "life guard or heartbeat error",
    (0x6060, 0, 10): "cyclic synchronous torque",
    (0x6061, 0, 1): "profile position",
    (0x6061, 0, -1): "mode of the maker",
    (0x6041, 0, 0x0237): "operation enabled",
    (0x6041, 0, 0x0250): "switch on disabled",
    (0x6041, 0, 0x0218): "fault",
    (0x6041, 0, 0x0001): "no state of CiA 402",
    (0x6040, 0, 0x80): "fault reset",
    (0x6040, 0, 0x06): "shutdown",
    (0x6077, 0, 1): "",
}


def test_an_object_is_named_and_its_number_put_into_words_as_the_standards_have_them() -> None:
    node = NodeObjects()
    assert {key: node.number(*key, 1).name for key in NAMES} == NAMES
    assert {key: node.number(*key).words for key in WORDS} == WORDS


def test_words_of_bits_are_shown_in_hexadecimal() -> None:
    node = NodeObjects()
    bits = ((0x1400, 1), (0x1600, 1), (0x1018, 1), (0x6041, 0), (0x6502, 0))
    numbers = ((0x1400, 2), (0x1600, 0), (0x1018, 0), (0x1003, 0), (0x606C, 0))
    assert [node.number(*key, 0x31).hexadecimal for key in bits] == [True] * len(bits)
    assert [node.number(*key, 0x31).hexadecimal for key in numbers] == [False] * len(numbers)
