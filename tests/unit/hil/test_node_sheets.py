"""A node's objects by its data sheet, and what was told of them on the bus meanwhile, which comes first."""

import math

import pytest
from canopen.objectdictionary import ODArray, ODVariable

from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.hil.reviewing.trace.node_objects import NodeObjects
from tests.unit.hil.test_known_objects import sheet, variable

RPM = 2.0 * math.pi / 60.0
VENDOR, PRODUCT = (0x1018, 1), (0x1018, 2)
SPEED, TORQUE, POSITION, ACCELERATION = 0x606C, 0x6077, 0x6064, 0x6083


def u32(value: int) -> bytes:
    return value.to_bytes(4, "little")


def node(told: dict[tuple[int, int], int], override: ScaleOverride | None = None) -> NodeObjects:
    """One that has told these values."""
    objects = NodeObjects(override)
    for key, value in told.items():
        objects.take(*key, u32(value))
    return objects


def si(objects: NodeObjects, *indices: int) -> list[float | None]:
    """Of a raw value of 1000."""
    return [objects.number(index, 0, 1000).si for index in indices]


def test_an_object_is_named_and_typed_by_the_sheet_before_the_standard() -> None:
    objects = NodeObjects()
    assert (objects.number(SPEED, 0, 1).name, objects.data_type(SPEED, 0)) == ("Velocity actual value", 0x04)
    objects.use_sheet(
        sheet(variable(SPEED, 0, kind=0x03), variable(0x2000, 1, kind=0x02), variable(0x2001, 0, kind=0x08))
    )
    assert objects.number(SPEED, 0, 1).name == "object 606C"
    assert objects.number(0x2000, 1, 1).name == "record, object 2000"
    assert [objects.data_type(*key) for key in ((SPEED, 0), (0x2000, 1), (0x2001, 0))] == [0x03, 0x02, 0x08]
    # what the sheet has not, and a sub-index of a variable, is the standard's
    assert objects.number(0x6041, 0, 1).name == "Statusword"
    assert (objects.data_type(0x6041, 0), objects.data_type(0x2002, 0)) == (0x06, None)
    assert (objects.data_type(0x2001, 1), objects.data_type(0x2000, 2)) == (None, None)
    value = objects.value(0x2000, 1, b"\xfe")
    assert (value.raw, str(value)) == (-2, "2000h:01 record, object 2000 = -2")


def test_a_member_with_the_name_of_its_array_is_named_once() -> None:
    made = sheet()
    array = ODArray("gains", 0x2003)
    for sub, name in ((0, "number"), (1, "gains")):
        member = ODVariable(name, 0x2003, sub)
        member.data_type = 0x05
        array.add_member(member)
    made.add_object(array)
    objects = NodeObjects()
    objects.use_sheet(made)
    assert [objects.number(0x2003, sub, 1).name for sub in (0, 1)] == ["gains, number", "gains"]


def test_what_was_told_comes_before_the_sheet_and_what_is_lacking_is_not_there() -> None:
    objects = NodeObjects()
    key = 0x6075, 0
    assert objects.held(*key) is None
    objects.use_sheet(sheet(variable(*key, kind=0x07, default=4000)))
    assert objects.held(*key) == 4000
    objects.take(*key, u32(5000))
    assert objects.held(*key) == 5000
    objects.lacks(*key)
    assert objects.held(*key) == 5000
    other = NodeObjects()
    other.use_sheet(sheet(variable(*key, kind=0x07, default=4000)))
    other.lacks(*key)
    assert other.held(*key) is None
    other.take(*key, u32(6000))
    assert other.held(*key) == 6000


def test_only_integers_of_at_most_eight_octets_on_which_something_rests_are_kept() -> None:
    objects = NodeObjects()
    objects.take(0x6077, 0, u32(7))
    objects.take(0x6075, 0, bytes(8) + b"\1")
    objects.take(0x6075, 0, b"")
    assert (objects.held(0x6077, 0), objects.held(0x6075, 0)) == (None, None)
    objects.take(0x1800, 1, u32(0x181))
    objects.take(0x6075, 0, u32(9) + b"\1\1\1\1")  # its type has four octets
    assert (objects.held(0x1800, 1), objects.held(0x6075, 0)) == (0x181, 9)
    text = NodeObjects()
    text.use_sheet(sheet(variable(0x6075, 0, kind=DataType.VISIBLE_STRING, default="4000")))
    assert text.held(0x6075, 0) is None


def test_the_numbers_of_pdos_are_those_of_parameters_and_mappings() -> None:
    objects = node(
        {(0x1400, 1): 1, (0x1401, 0): 1, (0x15FF, 1): 1, (0x1602, 0): 1, (0x1600, 0): 1, (0x1A04, 1): 1}
    )
    assert (list(objects.pdo_numbers(0x1400)), list(objects.pdo_numbers(0x1800))) == ([1, 2, 3, 512], [5])
    objects.use_sheet(
        sheet(
            variable(0x17FF, 1),
            variable(0x1403, 1),
            variable(0x1800, 1),
            variable(0x19FF, 1),
            variable(0x1BFF, 1),
        )
    )
    assert list(objects.pdo_numbers(0x1400)) == [1, 2, 3, 4, 512]
    assert list(objects.pdo_numbers(0x1800)) == [1, 5, 512]
    assert list(NodeObjects().pdo_numbers(0x1400)) == []


def test_the_make_is_vendor_and_device_name() -> None:
    objects = NodeObjects()
    assert objects.make == (0, "")
    objects.take(*VENDOR, u32(0x1A3))
    objects.take(0x1008, 0, b"iPOS 4808 and more\0")
    assert objects.make == (0x1A3, "iPOS 4808 and more")
    objects.take(0x1008, 0, b"")
    assert objects.make == (0x1A3, "")


# ---- units --------------------------------------------------------------------------------------------

RESOLUTION = {(0x608F, 1): 4000, (0x608F, 2): 1}
MILLI_RPM = {(0x60A9, 0): 0xFDB4_4700}


def test_a_part_of_the_units_that_is_not_told_does_not_hide_the_others() -> None:
    """Torque alone, motion alone, and currents as soon as the rated one is known."""
    assert si(node({}), POSITION, SPEED, TORQUE, 0x6078) == [None] * 4
    torque = node({(0x6076, 0): 2000, (0x6075, 0): 3000})
    assert si(torque, POSITION, SPEED, ACCELERATION, TORQUE, 0x6078) == [None, None, None, 2.0, 3.0]
    motion = node(RESOLUTION | MILLI_RPM)
    turn = pytest.approx(math.pi / 2.0)
    assert si(motion, POSITION, SPEED, ACCELERATION, TORQUE, 0x6078) == [
        turn, pytest.approx(RPM), pytest.approx(RPM), None, None,
    ]  # fmt: skip


def test_speeds_are_told_only_where_their_unit_is() -> None:
    """Increments a second are a guess, unless the drive was asked for 60A9h, or its sheet has none."""
    guessed = node(RESOLUTION)
    assert si(guessed, POSITION, SPEED) == [pytest.approx(math.pi / 2.0), None]
    speed = pytest.approx(math.pi / 2.0)
    guessed.lacks(0x60A9, 0)
    assert si(guessed, SPEED) == [speed]
    by_sheet = node(RESOLUTION)
    by_sheet.use_sheet(sheet(variable(0x6041, 0)))
    assert si(by_sheet, SPEED) == [speed]
    told = node(RESOLUTION)
    assert si(told, SPEED) == [None]
    told.take(0x60A9, 0, u32(0xFDB4_4700))
    assert si(told, SPEED) == [pytest.approx(RPM)]


def test_factors_of_a_commissioning_come_before_those_of_the_drive() -> None:
    override = ScaleOverride(0.5, 0.25, 0.125, rated_torque_nm=4.0, velocity_sign=-1.0, torque_sign=-1.0)
    objects = node(RESOLUTION | MILLI_RPM | {(0x6076, 0): 2000}, override)
    assert si(objects, POSITION, SPEED, 0x6081, ACCELERATION, TORQUE, 0x6072) == [
        500.0, -250.0, 250.0, 125.0, -4.0, 4.0,
    ]  # fmt: skip
    signs = node({(0x6076, 0): 2000}, ScaleOverride(torque_sign=-1.0))
    assert si(signs, SPEED, TORQUE) == [None, -2.0]
    speed = node(RESOLUTION | MILLI_RPM, ScaleOverride(velocity_sign=-1.0))
    assert si(speed, SPEED, TORQUE) == [pytest.approx(-RPM), None]


def test_units_of_a_maker_are_known_by_the_identity() -> None:
    """Technosoft: 60FFh in increments a sample of 1 ms, 16.16."""
    told = {VENDOR: 0x1A3, PRODUCT: 1, (0x608F, 1): 4000, (0x608F, 2): 1}
    increments_s = 1000.0 / 65536.0
    assert si(node(told), SPEED) == [pytest.approx(1000.0 * increments_s * 2.0 * math.pi / 4000.0)]
    assert si(node(told | {VENDOR: 0x1A4}), SPEED) == [None]


def test_the_number_of_limits_and_texts_have_no_unit() -> None:
    objects = node(RESOLUTION)
    for index in (0x607B, 0x607D):
        count = objects.number(index, 0, 2)
        assert (count.si, count.unit) == (None, "")
    text = objects.number(POSITION, 0, "abc")
    assert (text.raw, text.si, text.unit, text.words) == ("abc", None, "", "")
    real = objects.number(POSITION, 0, 0.5)
    assert real.si == pytest.approx(0.5 * 2.0 * math.pi / 4000.0)


def test_the_rated_torque_is_told_in_the_unit_of_its_maker() -> None:
    """maxon's EPOS4: 6076h in uN m, which CiA 402 has in mN m."""
    maxon = node({VENDOR: 0xFB, PRODUCT: 0x60500000, (0x6076, 0): 512_871})
    maxon.take(0x1008, 0, b"EPOS4")
    assert maxon.number(0x6076, 0, 512_871).si == pytest.approx(0.512_871)
    assert maxon.number(0x6076, 0, 512_871).unit == "N m"
    assert si(maxon, TORQUE) == [pytest.approx(0.512_871)]
    assert si(node({VENDOR: 0xFC}), 0x6076) == [pytest.approx(1.0)]
