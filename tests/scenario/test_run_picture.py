"""The page that a recording opens with, drawn by the viewer itself without a window."""

import importlib.util
import struct
from pathlib import Path
from types import ModuleType

import pytest

from drivers.timebase import Instant
from hil.recording.recorder import start_recording
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.synthetic_run import synthetic_records

ROOT = Path(__file__).resolve().parents[2]
DRIVERS = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))

pytestmark = pytest.mark.skipif(
    not any(folder.is_dir() and any(folder.iterdir()) for folder in DRIVERS),
    reason="no Vulkan driver: apt-get install mesa-vulkan-drivers",
)


def load_make_pictures() -> ModuleType:
    """docs/ is no package."""
    spec = importlib.util.spec_from_file_location("make_pictures", ROOT / "docs" / "make_pictures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_viewer_draws_a_run_and_no_view_complains(tmp_path: Path) -> None:
    recorder = start_recording(plan_for(tmp_path / "run"))
    recorder.begin(Instant(0))
    recorder.state(Instant(0), "phase", "running")
    for record in synthetic_records(2_000):
        recorder.record(record)
    recorder.close(whole_outcome(2_000))
    picture: bytes = load_make_pictures().render(tmp_path / "run" / "run.rrd")
    assert picture.startswith(b"\x89PNG")
    assert struct.unpack(">II", picture[16:24]) == (1920, 1080)
    # an empty page compresses to a few kB
    assert len(picture) > 100_000
