"""A bench that runs a drive by what commissioning found of it."""

from pathlib import Path
from typing import cast

import pytest

from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput, BenchError, PeerFault
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.drive_file import DriveFile, load_drive_file
from servobench.hil.execution.assembly import loop_timing
from servobench.hil.execution.drive_session import drive_settings, write_commissioned

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
        self._stubborn = stubborn

    def download(self, _node: int, index: int, sub: int, data: bytes) -> None:
        self.held[index, sub] = b"\0" if self._stubborn else data

    def upload(self, _node: int, index: int, sub: int) -> bytes:
        return self.held[index, sub]


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


def test_factors_and_signs_go_to_the_drive_client_together(tmp_path: Path) -> None:
    turned = drive_file(tmp_path).override
    assert turned == ScaleOverride(velocity_rad_s=0.1, velocity_sign=-1.0, torque_sign=-1.0)
    plain = drive_file(tmp_path, FILE.replace("= -1", "= 1")).override
    assert plain == ScaleOverride(velocity_rad_s=0.1)


def test_a_bench_file_names_it(tmp_path: Path) -> None:
    drive_file(tmp_path)
    example = Path(__file__).resolve().parents[3] / "examples"
    text = (example / "any_bus.toml").read_text().replace('"motors/', f'"{example}/motors/')
    bench = tmp_path / "bench.toml"
    bench.write_text(text.replace("node = 1\n", 'node = 1\ncommissioned = "drive.toml"\n', 1))
    config = load_bench(bench)
    commissioned = config.drive["axis1"].commissioned
    assert commissioned is not None
    assert commissioned.signs.torque == -1
    assert drive_settings(config, "axis1", loop_timing(config), None).scale == commissioned.override
    bench.write_text(text.replace("node = 1\n", 'node = 1\ncommissioned = "absent.toml"\n', 1))
    with pytest.raises(BenchError, match="Drive file not found"):
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
