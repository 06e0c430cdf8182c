"""Benches without torque mode, in csv, csp, ip and vl: by the frames on the bus, with delay and losses, and
at rest after every way out."""

import math
import re
from pathlib import Path
from struct import unpack

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from servobench.drivers.errors import BadInput, LimitExceeded, PeerFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from tests.draws import few_of
from tests.recorded_frames import candump_text
from tests.rehearsals.rehearsal import made_sheet
from tests.scenario.processes import EXAMPLES

CSV, CSP = EXAMPLES / "position_csv.toml", EXAMPLES / "position_csp.toml"
IP, VL = EXAMPLES / "position_ip.toml", EXAMPLES / "speed_vl.toml"
COUNT_RAD = math.tau / 65536
NETWORK = {
    "delay": [
        {"direction": "drive_to_host", "delay_min_us": 100, "delay_max_us": 400},
        {"direction": "host_to_drive", "delay_min_us": 200, "delay_max_us": 500},
    ],
    "loss": [{"probability": 0.02}],
}


def frames_of(run: Run, cob_id: str) -> tuple[np.ndarray, list[bytes]]:
    """Instants, s from the first cycle, and data of the frames of an identifier, from the frames alone."""
    lines = re.findall(rf"\(([\d.]+)\) \S+ {cob_id}#(\w*)", candump_text(run.folder))
    return np.array([float(at) - 1e9 for at, _ in lines]), [bytes.fromhex(data) for _, data in lines]


def reference_of_the_examples(time_s: np.ndarray) -> np.ndarray:
    """Of the three examples, written down once more."""
    ramp = 0.5 + 6.0 * np.clip((time_s - 0.5) / 0.25, 0.0, 1.0)
    sine = 0.5 * np.sin(math.tau * 3.0 * np.maximum(time_s - 0.8, 0.0))
    return np.where(time_s < 0.1, 0.0, np.where(time_s < 0.5, 0.5, ramp + sine))


def shaft_error(run: Run, from_s: float, until_s: float) -> float:
    """Largest distance of 6064h on the bus from the reference; a TPDO tells of its SYNC, just before."""
    at, data = frames_of(run, "181")
    position = np.array([unpack("<Hhi", each)[2] * COUNT_RAD for each in data if len(each) == 8])
    inside = (at >= from_s) & (at < until_s)
    syncs, _ = frames_of(run, "080")
    sampled = syncs[np.searchsorted(syncs, at) - 1]
    return float(np.abs(position - reference_of_the_examples(sampled))[inside].max())


@pytest.mark.parametrize("bench", [CSV, CSP, IP])
def test_step_ramp_and_sine_are_followed_by_the_frames_on_the_bus(
    servo_bench: BenchRunner, bench: Path
) -> None:
    run = servo_bench(bench)
    assert run.summary.verdict.passed, run.summary.verdict.reason
    seen = shaft_error(run, 0.95, 1.5)
    limit = run.config.verdict.limits.position_error_peak_rad_max
    told = run.summary.position_error
    assert limit is not None
    assert told.peak_rad is not None
    assert 1e-4 < seen <= told.peak_rad + 2 * COUNT_RAD, "the verdict saw no less than the bus did"
    assert seen < limit
    assert shaft_error(run, 0.35, 0.48) < 5e-3, "the step has arrived, and rests"


def test_the_position_set_points_on_the_bus_keep_their_limits_and_the_period_is_told(
    servo_bench: BenchRunner,
) -> None:
    run = servo_bench(CSP)
    at, data = frames_of(run, "201")
    cyclic = [
        unpack("<Hi", each)[1] * COUNT_RAD for each, when in zip(data, at, strict=True) if 0.0 < when < 1.5
    ]
    steps = np.diff(cyclic)
    assert len(cyclic) == run.summary.cycles
    assert np.abs(steps).max() <= 600.0 * RAD_S_PER_RPM * 1e-3 + COUNT_RAD
    assert np.abs(np.diff(steps)).max() <= 20_000.0 * RAD_S_PER_RPM * 1e-6 + 2 * COUNT_RAD
    _, asked = frames_of(run, "601")
    _, answered = frames_of(run, "581")
    assert bytes.fromhex("2fc2600101000000") in asked, "60C2h:01 = 1, and below :02 = -3: 1 ms"
    assert bytes.fromhex("2fc26002fd000000") in asked
    assert bytes.fromhex("4fc2600101000000") in answered, "and read back"
    assert bytes.fromhex("4fc26002fd000000") in answered


def test_a_ramp_of_speeds_is_followed_in_whole_units_by_the_frames_on_the_bus(
    servo_bench: BenchRunner,
) -> None:
    run = servo_bench(VL)
    assert run.summary.verdict.passed, run.summary.verdict.reason
    at, data = frames_of(run, "201")
    words, targets = zip(*(unpack("<Hh", each) for each in data if len(each) == 4), strict=True)
    cycles = [each for each, when in zip(targets, at, strict=True) if 0.0 < when < 1.2]
    assert set(words[-len(cycles) :]) <= {0x7F, 0x02, 0x00}, "enable ramp, unlock ramp, reference ramp"
    assert max(cycles) == 600, "an INTEGER16 in r/min"
    assert min(cycles) == -200
    told, speeds = frames_of(run, "281")
    velocity = np.array([unpack("<iI", each)[0] / 1000.0 for each in speeds if len(each) == 8])
    held = velocity[(told[: len(velocity)] > 0.5) & (told[: len(velocity)] < 0.7)]
    assert held == pytest.approx(600.0, abs=12.0)
    _, asked = frames_of(run, "601")
    assert bytes.fromhex("2348600188130000") in asked, "6048h:01 = 5000 r/min"
    assert bytes.fromhex("2b48600201000000") in asked, "and :02 = 1 s"
    (said,) = (each["text"] for each in run.events if "velocity mode" in each.get("text", ""))
    assert "rounded to 1 r/min" in said


@pytest.mark.parametrize(("bench", "other"), [(IP, VL), (VL, IP)])
def test_a_drive_whose_sheet_has_one_of_these_modes_runs_in_it_alone(
    servo_bench: BenchRunner, tmp_path: Path, bench: Path, other: Path
) -> None:
    only = "interpolated position" if bench == IP else "velocity mode"
    sheet = {
        "drive.axis1.eds": str(made_sheet([f"6502h with {only} only"], tmp_path)),
        "bench.duration_s": 1.0,
    }
    assert servo_bench(bench, sheet).summary.verdict.passed
    with pytest.raises(BadInput, match=r"drive\.axis1\.mode: .* 6502h is 000000[26]"):
        servo_bench(other, sheet)


@pytest.mark.parametrize("bench", few_of([CSV, CSP], 1))
def test_delay_and_losses_cost_little(servo_bench: BenchRunner, bench: Path) -> None:
    changes = {"loop.deadline_us": 3000, "verdict": {"position_error_peak_rad_max": 0.05}}
    if bench == CSV:
        changes["drive.axis1.controller.made_for.delay_us"] = 2000
    run = servo_bench(bench, changes, faults=NETWORK, seed=3)
    assert run.summary.verdict.passed, run.summary.verdict.reason
    assert run.summary.dropouts.lost > 10
    assert shaft_error(run, 0.95, 1.5) < 0.05


@pytest.mark.parametrize("bench", few_of([CSP, CSV], 1))
def test_a_drive_that_hears_no_set_points_any_more_stops_and_the_run_ends(
    servo_bench: BenchRunner, bench: Path
) -> None:
    lost = {
        "side": "drive",
        "direction": "host_to_drive",
        "frames": ["pdo"],
        "from_s": 0.6,
        "duration_s": 9.0,
    }
    with pytest.raises((PeerFault, LimitExceeded)):
        servo_bench(bench, faults={"blackout": [lost]})


@pytest.mark.parametrize("bench", few_of([CSV, CSP], 1))
def test_too_few_readings_end_the_run_at_rest(servo_bench: BenchRunner, bench: Path) -> None:
    lost = {"direction": "drive_to_host", "frames": ["pdo"], "from_s": 0.6, "duration_s": 0.3}
    with pytest.raises(LimitExceeded, match="no usable reading"):
        servo_bench(bench, {"drive.axis1.limits.dropouts_consecutive_max": 50}, faults={"blackout": [lost]})


@pytest.mark.parametrize("mode", ["cst", "csv", "csp"])
def test_each_mode_streams_what_it_is_given(servo_bench: BenchRunner, mode: str) -> None:
    level = {"cst": "torque_nm", "csv": "speed_rpm", "csp": "position_rad"}[mode]
    changes = {
        "bench.duration_s": 0.3,
        "drive.axis1.mode": mode,
        "drive.axis1.limits": {"speed_max_rpm": 1500.0, "torque_max_nm": 5.0},
        "reference": {"axis1": [{"kind": "ramp", "at_s": 0.05, level: 0.1, "over_s": 0.1}]},
        "verdict": {},
    }
    run = servo_bench(CSP, changes)
    assert run.summary.verdict.completed, run.summary.verdict.reason
    raw = unpack("<Hh" if mode == "cst" else "<Hi", frames_of(run, "201")[1][-200])[1]
    axis = run.axis()
    assert raw != 0
    assert len(axis.velocity_rad_s) == 300


def test_a_file_of_a_million_points_is_followed_with_no_frame_and_two_events(
    servo_bench: BenchRunner, tmp_path: Path
) -> None:
    """At 1 MHz, of which the loop sees every thousandth."""
    time_s = np.arange(1_000_001) * 1e-6
    position = 0.25 * (1.0 - np.cos(math.tau * 2.0 * time_s))
    parquet.write_table(pa.table({"time_s": time_s, "position_rad": position}), tmp_path / "path.parquet")
    entry = {"kind": "file", "at_s": 0.1, "path": str(tmp_path / "path.parquet")}
    changes = {"bench.duration_s": 1.2, "reference": {"axis1": [entry]}}
    run = servo_bench(CSP, changes)
    assert run.summary.verdict.passed, run.summary.verdict.reason
    told = [event["text"] for event in run.events if "path.parquet" in event.get("text", "")]
    assert told == [
        "axis1: reference position of path.parquet, 1000001 points",
        "axis1: reference of path.parquet ends",
    ]
    plain = servo_bench(CSP, changes | {"reference": {}, "verdict": {}})
    for cob_id in ("601", "201", "181"):
        sent, sent_plainly = (frames_of(each, cob_id)[0] for each in (run, plain))
        assert np.sum((sent > 0.0) & (sent < 1.2)) == np.sum((sent_plainly > 0.0) & (sent_plainly < 1.2))
