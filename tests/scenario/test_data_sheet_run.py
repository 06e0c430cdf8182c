"""A run whose drive has a data sheet: its PDO plan is made for that, and the drive is held against it."""

from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING
from tests.scenario.processes import EXAMPLES

BENCH = EXAMPLES / "ling2012.toml"


def sheet(folder: Path, old: str = "", new: str = "") -> Path:
    """The simulated drive's own data sheet, with one passage changed."""
    text = export_eds(SimulatedServo(1, LING).dictionary)
    assert old in text
    path = folder / "drive.eds"
    path.write_text(text.replace(old, new) if old else text)
    return path


def events(folder: Path) -> str:
    return (folder / "events.jsonl").read_text()


def changes(path: Path) -> dict[str, object]:
    return {
        "drive.axis1.eds": str(path),
        "bench.duration_s": 0.3,
        "reference.axis1": [],
        "load": {},
        "verdict": {},
    }


def test_a_run_by_the_drives_own_sheet(servo_bench: BenchRunner, tmp_path: Path) -> None:
    run = servo_bench(BENCH, changes(sheet(tmp_path)))
    assert run.summary.cycles == 300
    assert "data sheet" not in events(run.folder)


def test_a_sheet_that_rules_the_mode_out_is_refused_before_the_drive_is_asked(
    servo_bench: BenchRunner, tmp_path: Path
) -> None:
    with pytest.raises(BadInput, match=r"606Ch:00 is not in the dictionary") as caught:
        servo_bench(BENCH, changes(sheet(tmp_path, "[606C]", "[2FFF]")))
    assert (caught.value.key, caught.value.value) == ("drive.axis1.mode", "cst")


def test_a_sheet_that_is_none_is_bad_input(servo_bench: BenchRunner, tmp_path: Path) -> None:
    path = tmp_path / "none.eds"
    path.write_text("nothing")
    with pytest.raises(BadInput, match=r"none\.eds"):
        servo_bench(BENCH, changes(path))
