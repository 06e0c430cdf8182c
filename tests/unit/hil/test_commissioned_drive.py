"""A bench that runs a drive by what commissioning found of it."""

from pathlib import Path
from typing import cast

import pytest

from drivers.canopen.objects import SettingRefused
from drivers.cia402.drive_setup import Identity
from drivers.cia402.servo import ServoDrive
from drivers.errors import BadInput, BenchError, PeerFault
from drivers.exchange import Command, Readback, Reading, SentCommand
from drivers.timebase import Instant
from hil.configuration.bench_file import load_bench
from hil.configuration.drive_file import DriveFile, load_drive_file
from hil.execution.commissioned_drive import TurnedDrive, as_the_loop_counts, write_commissioned

FILE = """
[drive]
node = 3
vendor = 7
product = 8
serial = 9

[scale]
velocity_rad_s = 0.1

[signs]
torque = -1
velocity = -1

[[object]]
index = 0x607E
bytes = "c0"
"""


class Drive:
    """Stands in for a connected drive whose dictionary is a table."""

    def __init__(self, stubborn: bool = False) -> None:
        self.name, self.node_id = "axis1", 3
        self.identity = Identity("it", 7, 8, 1, 9, 0)
        self.network = self
        self.held: dict[tuple[int, int], bytes] = {}
        self.sent: list[Command] = []
        self.checked = 0
        self._stubborn = stubborn

    def download(self, _node: int, index: int, sub: int, data: bytes) -> None:
        self.held[index, sub] = b"\0" if self._stubborn else data

    def upload(self, _node: int, index: int, sub: int) -> bytes:
        return self.held[index, sub]

    def take_readings(self) -> list[Reading]:
        now = Instant(0)
        return [Reading(2.0, None, now, 5.0, now, -0.5, now, 0x237, now)]

    def take_readbacks(self) -> list[Readback]:
        return [Readback(-125, Instant(3), 1)]

    def write(self, command: Command) -> SentCommand:
        self.sent.append(command)
        return SentCommand(command.sequence, -125, Instant(11))

    def check(self) -> None:
        self.checked += 1


def drive_file(folder: Path, text: str = FILE) -> DriveFile:
    path = folder / "drive.toml"
    path.write_text(text)
    return load_drive_file(path)


def as_servo(drive: Drive) -> ServoDrive:
    return cast(ServoDrive, drive)


def test_settings_are_written_and_read_back(tmp_path: Path) -> None:
    drive = Drive()
    write_commissioned(as_servo(drive), drive_file(tmp_path))
    assert drive.held == {(0x607E, 0): b"\xc0"}
    with pytest.raises(SettingRefused, match="607Eh"):
        write_commissioned(as_servo(Drive(stubborn=True)), drive_file(tmp_path))


@pytest.mark.parametrize("key", ["vendor", "product", "serial"])
def test_another_drive_is_refused_before_anything_is_written(tmp_path: Path, key: str) -> None:
    text = "\n".join(f"{key} = 1" if line.startswith(f"{key} =") else line for line in FILE.splitlines())
    drive = Drive()
    with pytest.raises(PeerFault, match="not the drive that was commissioned"):
        write_commissioned(as_servo(drive), drive_file(tmp_path, text))
    assert drive.held == {}


def test_signs_are_turned_for_the_loop_and_back_for_the_drive(tmp_path: Path) -> None:
    drive = Drive()
    turned = as_the_loop_counts(as_servo(drive), drive_file(tmp_path))
    assert isinstance(turned, TurnedDrive)
    (reading,) = turned.take_readings()
    assert (reading.position_rad, reading.velocity_rad_s, reading.torque_nm) == (5.0, -2.0, 0.5)
    sent = turned.write(Command(1, 0.25, Instant(0), Instant(1)))
    assert drive.sent[0].torque_nm == -0.25
    (readback,) = turned.take_readbacks()
    assert sent is not None
    assert readback.demand_raw == sent.raw == -125, "both as the drive counts"
    turned.check()
    assert drive.checked == 1


def test_a_drive_that_counts_as_the_loop_is_left_as_it_is(tmp_path: Path) -> None:
    drive = as_servo(Drive())
    assert as_the_loop_counts(drive, None) is drive
    plain = drive_file(tmp_path, FILE.replace("= -1", "= 1"))
    assert as_the_loop_counts(drive, plain) is drive
    assert plain.override.velocity_rad_s == 0.1
    assert plain.override.position_rad is None


def test_a_bench_file_names_it(tmp_path: Path) -> None:
    drive_file(tmp_path)
    example = Path(__file__).resolve().parents[3] / "examples"
    text = (example / "any_bus.toml").read_text().replace('"motors/', f'"{example}/motors/')
    bench = tmp_path / "bench.toml"
    bench.write_text(text.replace("node = 1\n", 'node = 1\ncommissioned = "drive.toml"\n', 1))
    commissioned = load_bench(bench).drive["axis1"].commissioned
    assert commissioned is not None
    assert commissioned.signs.torque == -1
    bench.write_text(text.replace("node = 1\n", 'node = 1\ncommissioned = "absent.toml"\n', 1))
    with pytest.raises(BenchError, match="drive file"):
        load_bench(bench)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("torque = -1", "torque = 0", "signs.torque"),
        ('bytes = "c0"', 'bytes = "c"', "object"),
        ("velocity_rad_s = 0.1", "velocity_rad_s = -0.1", "scale.velocity_rad_s"),
        ("serial = 9", "seriel = 9", "seriel"),
    ],
)
def test_what_is_wrong_in_it_is_named(tmp_path: Path, old: str, new: str, named: str) -> None:
    with pytest.raises(BadInput, match=named):
        drive_file(tmp_path, FILE.replace(old, new))
