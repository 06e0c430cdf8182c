"""Data sheet and memory of a simulated device, as the command line names them."""

import math
from pathlib import Path

import pytest

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.execution.device_files import DeviceFiles
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.motors import AZAIZ, LING
from tests.rehearsals.made_sheet import MadeSheet
from tests.unit.drivers.eds_maker import U8, U32, four_pdos, sheet_text, sub


def test_without_files_there_is_nothing_to_lay_over_or_to_keep() -> None:
    assert DeviceFiles().vendor(print) is None
    assert DeviceFiles().memory([1, 2]) is None


def test_missing_data_sheet_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"missing\.eds"):
        DeviceFiles(eds=tmp_path / "missing.eds").vendor(print)


def test_one_memory_is_not_shared(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="one --node"):
        DeviceFiles(store=tmp_path / "memory.json").memory([1, 2])


def test_foreign_file_is_no_memory(tmp_path: Path) -> None:
    (tmp_path / "memory.json").write_text("[]")
    with pytest.raises(BadInput, match="stored parameters"):
        DeviceFiles(store=tmp_path / "memory.json").memory([1])


def test_repairs_of_the_data_sheet_are_told(tmp_path: Path) -> None:
    eds = tmp_path / "torn.eds"
    eds.write_text("[2000]\nParameterName=A\nObjectType=0x7\nDataType=0x0005\nDefaultValue=1\n")
    said: list[str] = []
    assert DeviceFiles(eds=eds).vendor(said.append) is not None
    assert any("AccessType is missing" in line for line in said)


DCF = """[DeviceComissioning]
NodeID=9
NodeName=spindle
Baudrate=500
LSS_SerialNumber=0x1234
[1018]
ParameterName=Identity object
ObjectType=0x9
SubNumber=2
[1018sub0]
ParameterName=Highest sub-index supported
ObjectType=0x7
DataType=0x0005
AccessType=const
DefaultValue=4
[1018sub4]
ParameterName=Serial number
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=1
"""


@pytest.fixture
def dcf(tmp_path: Path) -> Path:
    path = tmp_path / "spindle.dcf"
    path.write_text(DCF)
    return path


def test_node_id_of_a_dcf_is_known(dcf: Path) -> None:
    assert DeviceFiles(eds=dcf).commissioned_node() == 9
    assert DeviceFiles().commissioned_node() is None


def test_serial_number_of_a_dcf_is_the_device_s_also_for_lss(dcf: Path) -> None:
    vendor = DeviceFiles(eds=dcf).vendor(print)
    device = SimulatedServo(9, LING, vendor=vendor)
    device.start(Instant(0))
    assert device.dictionary.upload(0x1018, 4) == (0x1234).to_bytes(4, "little")
    device.receive(Frame(0x7E5, b"\x04\x01".ljust(8, b"\x00")), Instant(1))
    (answer,) = device.receive(Frame(0x7E5, b"\x5d".ljust(8, b"\x00")), Instant(2))
    assert answer.data[1:5] == (0x1234).to_bytes(4, "little")


@pytest.mark.parametrize(
    ("nodes", "bitrate", "told"),
    [
        ([9], 500_000, []),
        ([1, 2], 500_000, ["made for node 9, simulated as 1, 2"]),
        ([9], 1_000_000, ["made for 500 kbit/s, the bus runs at 1000 kbit/s"]),
    ],
)
def test_what_a_dcf_was_not_made_for_is_told(
    dcf: Path, nodes: list[int], bitrate: int, told: list[str]
) -> None:
    said: list[str] = []
    DeviceFiles(eds=dcf).vendor(said.append, nodes, bitrate)
    assert [line.removeprefix(f"{dcf}: ") for line in said if "made for" in line] == told


def test_a_serial_number_asked_for_goes_before_that_of_the_dcf(dcf: Path) -> None:
    maker, other = DeviceFiles.makers(DeviceFiles(eds=dcf).vendor(print), [7, None])
    assert SimulatedServo(9, LING, vendor=maker).dictionary.variable(0x1018, 4).value == 7
    assert SimulatedServo(9, LING, vendor=other).dictionary.variable(0x1018, 4).value == 0x1234


def test_a_serial_number_needs_a_place() -> None:
    (maker,) = DeviceFiles.makers(lambda dictionary: dictionary.conceal(0x1018), [7])
    with pytest.raises(BadInput, match="1018h:04"):
        SimulatedServo(9, LING, vendor=maker)


@pytest.mark.parametrize(
    ("vendor", "counts"), [("0xFB", 3200), ("0x123", 65536)], ids=["maxon's", "another's"]
)
def test_an_encoder_in_a_makers_object_is_the_simulated_ones(
    tmp_path: Path, vendor: str, counts: int
) -> None:
    made = sheet_text(four_pdos(), also="[3000]\nParameterName=Axis\nObjectType=9\nSubNumber=2\n")
    made += sub(0x3000, 0, U8, "ro", "5") + sub(0x3000, 5, U32, "rw", "3200")
    path = tmp_path / "drive.eds"
    path.write_text(made.replace("VendorNumber=0x123", f"VendorNumber={vendor}\nProductName=EPOS4"))
    drive = DeviceFiles(eds=path).drive(DriveParameters())
    assert drive.encoder_counts_per_revolution == counts


@pytest.mark.parametrize("motor", [LING, AZAIZ], ids=["power-invariant", "amplitude-invariant"])
def test_a_makers_motor_objects_tell_of_the_simulated_motor(tmp_path: Path, motor: PmsmParameters) -> None:
    """An EPOS4's sheet: its own motor has 12 pole pairs."""
    made = MadeSheet()
    made.by(0xFB)
    made.set(0x1008, default="EPOS4")
    made.add(0x3001, {1: DataType.UNSIGNED32, 3: DataType.UNSIGNED8, 5: DataType.UNSIGNED32})
    made.set(0x3001, 3, default=12)
    path = tmp_path / "drive.eds"
    path.write_text(made.text())
    servo = SimulatedServo(9, motor, vendor=DeviceFiles(eds=path).vendor(print, motor=motor))
    current, pairs, constant = (servo.dictionary.variable(0x3001, number).value for number in (1, 3, 5))
    assert pairs == motor.pole_pairs
    # the power that makes the rated torque at a speed: three phases, each with its back-EMF's rms
    emf_rms = motor.pole_pairs * motor.flux_linkage_wb / math.sqrt(2.0 if motor is AZAIZ else 3.0)
    assert 3.0 * emf_rms * current / 1000 == pytest.approx(motor.rated_torque_nm, rel=1e-3)
    assert current * constant * 1e-9 == pytest.approx(motor.rated_torque_nm, rel=1e-3)
