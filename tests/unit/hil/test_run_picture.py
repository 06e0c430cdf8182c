"""The page that a recording opens with, drawn by the viewer itself without a window."""

import struct
from pathlib import Path

import pytest

from servobench.drivers.timebase import Instant
from servobench.hil.recorded.viewer import draw_page
from servobench.hil.recording.recorder import start_recording
from tests.unit.hil.recording_tools import plan_for, whole_outcome
from tests.unit.hil.synthetic_run import synthetic_records

DRIVERS = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))

pytestmark = pytest.mark.skipif(
    not any(folder.is_dir() and any(folder.iterdir()) for folder in DRIVERS),
    reason="no Vulkan driver: apt-get install mesa-vulkan-drivers",
)


@pytest.mark.long
def test_the_viewer_draws_a_run_and_no_view_complains(tmp_path: Path) -> None:
    recorder = start_recording(plan_for(tmp_path / "run"))
    recorder.begin(Instant(0))
    recorder.state(Instant(0), "phase", "running")
    for record in synthetic_records(2_000):
        recorder.record(record)
    recorder.close(whole_outcome(2_000))
    picture: bytes = draw_page(tmp_path / "run")
    assert picture.startswith(b"\x89PNG")
    assert struct.unpack(">II", picture[16:24]) == (1920, 1080)
    # an empty page compresses to a few kB
    assert len(picture) > 100_000
