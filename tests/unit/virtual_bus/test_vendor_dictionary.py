"""A device that takes an EDS as its dictionary."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from servobench.drivers.sheets.dictionary import load_dictionary
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.parameter_storage import FileStore
from servobench.virtual_bus.device.vendor_dictionary import BASE_NODE_ID, overlay
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from tests.motors import LING

EDS = Path(__file__).parents[2] / "contract" / "conformance" / "rehearsed.eds"
NODE = 5
NOW = Instant(0)


def vendor() -> Callable[[ObjectDictionary], None]:
    return partial(overlay, vendor=load_dictionary(EDS, BASE_NODE_ID).dictionary)


@pytest.fixture
def device() -> SimulatedServo:
    made = SimulatedServo(NODE, LING, vendor=vendor())
    made.start(NOW)
    return made


def ask(device: SimulatedServo, command: int, index: int, subindex: int = 0, data: bytes = b"") -> bytes:
    request = bytes([command]) + index.to_bytes(2, "little") + bytes([subindex]) + data.ljust(4, b"\x00")
    frames = device.receive(Frame(0x600 + NODE, request), NOW)
    (answer,) = (frame.data for frame in frames if frame.can_id == 0x580 + NODE)
    return answer


def number(answer: bytes) -> int:
    return int.from_bytes(answer[4:8], "little")


@pytest.mark.parametrize(
    ("index", "subindex", "value"),
    [
        (0x1018, 4, 42),
        (0x1014, 0, 0x80 + NODE),
        (0x1800, 1, 0x4000_0180 + NODE),
        (0x1A00, 1, 0x6041_0010),
        (0x2100, 0, 17),
    ],
)
def test_defaults_are_the_files(device: SimulatedServo, index: int, subindex: int, value: int) -> None:
    answer = ask(device, 0x40, index, subindex)
    assert (answer[0] & 0xE3, number(answer)) == (0x43, value)


@pytest.mark.parametrize(
    ("command", "index", "subindex", "data", "code"),
    [
        (0x40, 0x1029, 1, b"", 0x0602_0000),
        (0x40, 0x6064, 0, b"", 0x0602_0000),
        (0x40, 0x2100, 1, b"", 0x0609_0011),
        (0x40, 0x2002, 0, b"", 0x0601_0001),
        (0x2F, 0x2100, 0, b"\x01", 0x0601_0002),
        (0x2B, 0x2001, 0, b"\x0b\x00", 0x0609_0031),
        (0x2B, 0x2001, 0, b"\xf5\xff", 0x0609_0032),
        (0x2F, 0x2001, 0, b"\x01", 0x0607_0013),
    ],
)
def test_access_range_and_length_are_the_files(
    device: SimulatedServo, command: int, index: int, subindex: int, data: bytes, code: int
) -> None:
    answer = ask(device, command, index, subindex, data)
    assert (answer[0], number(answer)) == (0x80, code)


def test_known_objects_act_although_others_are_gone(device: SimulatedServo) -> None:
    device.receive(Frame(0x000, bytes([1, NODE])), NOW)
    for controlword in (0x06, 0x07, 0x0F):
        assert ask(device, 0x2B, 0x6040, 0, bytes([controlword, 0]))[0] == 0x60
    (frame,) = device.receive(Frame(0x080), NOW)
    assert (frame.can_id, frame.data[0] & 0x6F) == (0x180 + NODE, 0x27)


def test_where_the_file_gives_no_value_the_devices_own_stays(tmp_path: Path) -> None:
    path = tmp_path / "silent.eds"
    path.write_text(EDS.read_text().replace("DefaultValue=0x00020192", "DefaultValue="))
    silent = partial(overlay, vendor=load_dictionary(path, BASE_NODE_ID).dictionary)
    device = SimulatedServo(NODE, LING, vendor=silent)
    device.start(NOW)
    assert number(ask(device, 0x40, 0x1000)) & 0xFFFF == 402


def test_what_was_stored_is_there_in_the_next_life(tmp_path: Path) -> None:
    for expected in (0, 77):
        device = SimulatedServo(NODE, LING, store=FileStore(tmp_path / "memory.json"), vendor=vendor())
        device.start(NOW)
        assert number(ask(device, 0x40, 0x1017)) == expected
        ask(device, 0x2B, 0x1017, 0, b"\x4d\x00")
        assert ask(device, 0x23, 0x1010, 1, b"save")[0] == 0x60
