"""A bench with drives on two segments: one loop, one SYNC, two buses."""

import itertools
import tomllib
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config_files import BadInputs, bad_inputs_of
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.verdict.verdict import ExitStatus
from tests.recorded_frames import candump_text, injected
from tests.scenario.processes import EXAMPLES, hub_name, run_command
from tests.warm.start import hil

BENCH = EXAMPLES / "two_segments.toml"


def frames_of(folder: Path) -> dict[str, list[tuple[str, str]]]:
    """(time, identifier) of the frames, by segment."""
    found: dict[str, list[tuple[str, str]]] = {}
    for line in candump_text(folder).splitlines():
        stamp, segment, frame = line.split()
        found.setdefault(segment, []).append((stamp, frame.partition("#")[0]))
    return found


def test_both_axes_keep_their_limits_and_each_frame_is_on_its_segment(servo_bench: BenchRunner) -> None:
    run = servo_bench(BENCH)
    run.assert_passed()
    assert run.summary.cycles == 2000
    frames = frames_of(run.folder)
    assert set(frames) == {"simulated", "feed"}
    identifiers = {segment: {can_id for _, can_id in entries} for segment, entries in frames.items()}
    assert {"201", "181", "281"} <= identifiers["simulated"]
    assert {"202", "182", "282", "1AB"} <= identifiers["feed"]
    assert not identifiers["simulated"] & {"202", "182", "282", "1AB"}
    assert not identifiers["feed"] & {"201", "181", "281"}
    syncs = {name: [at for at, can_id in entries if can_id == "080"] for name, entries in frames.items()}
    assert syncs["simulated"] == syncs["feed"]
    assert len(syncs["feed"]) > 2000


def test_bus_load_is_that_of_the_busier_segment(servo_bench: BenchRunner) -> None:
    run = servo_bench(BENCH)
    assert 60.0 < (run.summary.bus_load_percent or 0.0) < 90.0, "four frames a cycle at 500 kbit/s"


def test_both_masters_keep_their_heartbeat_while_one_of_them_waits(servo_bench: BenchRunner) -> None:
    """To connect, configure and enable the drives one after the other takes longer than their patience."""
    run = servo_bench(BENCH)
    for entries in frames_of(run.folder).values():
        beats = [float(at.strip("()")) for at, can_id in entries if can_id == "77F"]
        assert max(after - before for before, after in itertools.pairwise(beats)) < 0.060


def test_each_segment_has_its_own_losses_and_a_recorded_run_replays(servo_bench: BenchRunner) -> None:
    run = servo_bench(BENCH)
    again = servo_bench(BENCH, faults=run.folder / "faults.arrow")
    assert again.digest == run.digest
    assert {entry["can_id"] for entry in injected(run.folder)} >= {0x181, 0x182, 0x281, 0x282}


def changed(change: Any) -> list[BadInput]:
    """What is found in the example after ``change``."""
    raw = tomllib.loads(BENCH.read_text())
    change(raw)
    with pytest.raises((BadInput, BadInputs)) as caught:
        bench_from(raw, "bench.toml", EXAMPLES)
    return bad_inputs_of(caught.value)


@pytest.mark.parametrize(
    ("change", "key", "expected"),
    [
        (lambda raw: raw["drive"]["feed"].update(segment="fed"), "drive.feed.segment", "feed"),
        (lambda raw: raw["bus"]["segment"].append({"name": "feed"}), "bus.segment[1].name", "of its own"),
        (lambda raw: raw["bus"].update(spec="hub:bench"), "bus.segment", "'simulated' only"),
        (lambda raw: raw["bus"]["segment"][0].update(bitrate_bit_s=250_000), "loop.period_us", "250000"),
        (
            lambda raw: raw["bus"]["segment"][0]["background"][0].update(can_id=0x182),
            "bus.segment[0].background[0].can_id",
            "CiA 301",
        ),
    ],
    ids=["unknown", "twice", "a real bus", "too slow", "taken"],
)
def test_what_cannot_be_is_named_with_its_key(change: Any, key: str, expected: str) -> None:
    (found,) = changed(change)
    assert found.key == key
    assert expected in found.expected


def test_further_segments_are_refused_on_a_real_bus_from_the_command_line() -> None:
    done = run_command([*hil(), "run", str(BENCH), "--bus", hub_name("segments")])
    assert done.returncode == ExitStatus.BAD_INPUT, done.stderr
    assert "bus.segment" in done.stderr
    assert "'simulated'" in done.stderr
