"""The simulated drive behind a data sheet: identity, modes, ranges and units of that drive."""

import math
from functools import partial

import pytest

from servobench.drivers.cia402.profile import Mode, supported_mode_bit
from servobench.drivers.sheets.dictionary import parse_dictionary
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.sdo_abort import SdoAbort
from servobench.virtual_bus.device.vendor_dictionary import BASE_NODE_ID
from servobench.virtual_bus.drive.data_sheet import lay_over
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING
from tests.rehearsals.made_sheet import PRODUCT, REVISION, VENDOR, MadeSheet


def drive_of(sheet: MadeSheet, node: int = 5) -> SimulatedServo:
    loaded = parse_dictionary(sheet.text().encode("latin-1"), "made.eds", BASE_NODE_ID)
    made = SimulatedServo(node, LING, vendor=partial(lay_over, vendor=loaded.dictionary))
    made.start(Instant(0))
    return made


def number(drive: SimulatedServo, index: int, sub: int = 0) -> int:
    return int.from_bytes(drive.dictionary.upload(index, sub), "little")


def test_without_defaults_the_identity_is_that_of_device_info() -> None:
    sheet = MadeSheet()
    for sub in (1, 2, 3):
        sheet.set(0x1018, sub, default=" ")
    sheet.set(0x1008, default=" ")
    sheet.inform("ProductName", "Made 7")
    drive = drive_of(sheet)
    assert [number(drive, 0x1018, sub) for sub in (1, 2, 3, 4)] == [VENDOR, PRODUCT, REVISION, 5]
    assert drive.dictionary.upload(0x1008, 0) == b"Made 7"


def test_a_sheet_without_1018h_is_of_a_drive_without() -> None:
    sheet = MadeSheet()
    sheet.drop(0x1018)
    with pytest.raises(SdoAbort):
        drive_of(sheet).dictionary.upload(0x1018, 1)


def test_modes_that_the_sheet_denies_are_neither_told_nor_taken() -> None:
    sheet = MadeSheet()
    own = supported_mode_bit(Mode.PROFILE_VELOCITY) | supported_mode_bit(Mode.VELOCITY)
    with_angle = supported_mode_bit(Mode.CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE)
    sheet.set(0x6502, default=own | with_angle | 1 << 16)
    drive = drive_of(sheet)
    assert number(drive, 0x6502) == own, "cyclic torque with commutation angle is not simulated"
    assert number(drive, 0x6060) == number(drive, 0x6061) == Mode.VELOCITY
    for mode in (Mode.CYCLIC_SYNCHRONOUS_TORQUE, Mode.CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE, 99):
        with pytest.raises(SdoAbort):
            drive.dictionary.download(0x6060, 0, bytes([mode]))


def test_the_rating_is_that_of_the_simulated_motor() -> None:
    sheet = MadeSheet()
    sheet.set(0x6075, default=123)
    sheet.set(0x6076, default=300)
    drive, plain = drive_of(sheet), drive_of(MadeSheet())
    for index in (0x6075, 0x6076):
        assert number(drive, index) == number(plain, index)
    assert number(drive, 0x6076) == round(1000 * LING.rated_torque_nm)
    assert drive.drive.objects.torque_unit_nm == pytest.approx(LING.rated_torque_nm / 1000)


def test_without_6502h_a_mode_needs_its_set_point() -> None:
    sheet = MadeSheet()
    sheet.drop(0x6502, 0x6071)
    drive = drive_of(sheet)
    drive.dictionary.download(0x6060, 0, bytes([Mode.CYCLIC_SYNCHRONOUS_VELOCITY]))
    with pytest.raises(SdoAbort):
        drive.dictionary.download(0x6060, 0, bytes([Mode.CYCLIC_SYNCHRONOUS_TORQUE]))


@pytest.mark.parametrize(
    ("limits", "default", "low", "high"),
    [
        ({"LowLimit": 100, "HighLimit": 900}, 900, 100, 900),
        ({"LowLimit": 0, "HighLimit": 99999}, 2998, 0, 2998),
        ({"LowLimit": 60000, "HighLimit": 65000}, 2998, None, 2998),
    ],
    ids=["narrower", "wider", "apart"],
)
def test_ranges_are_those_that_both_allow(
    limits: dict[str, int], default: int, low: int | None, high: int
) -> None:
    sheet = MadeSheet()
    sheet.set(0x6072, default=" ", **limits)
    variable = drive_of(sheet).dictionary.variable(0x6072)
    assert (variable.default, variable.low, variable.high) == (default, low, high)


@pytest.mark.parametrize(("told", "counts"), [(2000, 2000), (1, 65536)])
def test_a_resolution_that_is_no_encoders_is_shown_and_does_not_rule(told: int, counts: int) -> None:
    sheet = MadeSheet()
    sheet.drop(0x60A8, 0x6092)
    sheet.set(0x608F, 1, default=told)
    drive = drive_of(sheet)
    assert number(drive, 0x608F, 1) == told
    assert abs(drive.drive.units.counts_per_position) * counts == pytest.approx(65536)
    assert math.isfinite(drive.drive.units.rad_s_per_velocity)


def test_a_quick_stop_of_zero_hardly_stops_until_it_is_written() -> None:
    sheet = MadeSheet()
    sheet.set(0x6085, default=0, LowLimit=0)
    drive = drive_of(sheet)
    assert number(drive, 0x6085) == 0
    weakest = drive.drive.axis.quick_stop_rad_s2
    drive.dictionary.download(0x6085, 0, (5000).to_bytes(4, "little"))
    assert drive.drive.axis.quick_stop_rad_s2 == pytest.approx(5000 * weakest)
    assert number(drive, 0x6085) == 5000
