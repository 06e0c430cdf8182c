"""EMCYs of a drive that goes on, and that answers no SDO meanwhile: its cycles go on, too."""

import numpy as np

from servobench.hil.testing.bench_runs import BenchRunner
from tests.scenario.test_drive_follows import AT_S, LING2012

ASKED = "601#4041600000000000"
PERIOD_NS = 1_000_000


def test_no_cycle_waits_for_the_answer_to_an_emergency(servo_bench: BenchRunner) -> None:
    """Every SYNC and every command is on time, by the frames; the drive is asked nevertheless."""
    faults = {
        "repeated_emergency": [{"nodes": [1], "code": 0x2310, "at_s": AT_S}],
        "blackout": [
            {
                "side": "drive",
                "frames": ["sdo"],
                "direction": "host_to_drive",
                "from_s": 0.6,
                "duration_s": 0.5,
            }
        ],
    }
    ended = servo_bench(LING2012, {"bench.duration_s": 1.2}, faults=faults)
    begun_ns = ended.wire.find("081#1023............", sent=False)[0].at
    asked = [frame for frame in ended.wire.find(ASKED, sent=True) if frame.at >= begun_ns]
    assert len(asked) > 50
    for frame in ("080#", "201#0F00...."):
        at = np.array([seen.at for seen in ended.wire.find(frame, sent=True) if seen.at >= begun_ns])
        assert at.size > 700
        assert np.diff(at).max() < 1.5 * PERIOD_NS, frame
