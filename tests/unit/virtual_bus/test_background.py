"""Other nodes' traffic: its statistics, its determinism, and the load that it makes."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.configuration.config import load_background
from servobench.hil.configuration.config_files import BadInputs
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.device.background import CATCH_UP_MAX, BackgroundNode, Stream, background_nodes
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import Timeline
from tests.unit.virtual_bus.can_reference import wire_bits

EXAMPLES = Path(__file__).parents[3] / "examples"
MS = 1_000_000


def queued(stream: Stream, until: int, seed: int = 1) -> list[tuple[int, Frame]]:
    """When each frame is sent, and the frame."""
    node = BackgroundNode(stream, seed, "0")
    assert not node.start(Instant(0))
    found = []
    while node.wake_at is not None and node.wake_at <= until:
        at = node.wake_at
        found += [(int(at), frame) for frame in node.wake(at)]
    assert node.skipped == 0, "each wake-up was in time"
    return found


def test_periodic_frames_keep_their_grid_and_jitter_evenly() -> None:
    found = queued(Stream(0x300, Duration(MS), jitter=Duration(MS // 2)), 2_000 * MS)
    offsets = np.array([at for at, _ in found]) - np.arange(len(found)) * MS
    late = (offsets - offsets.min()) / (MS / 2)
    assert len(found) in (1_999, 2_000)
    assert late.max() < 1.0
    assert stats.kstest(late, "uniform").pvalue > 0.01


def test_random_arrivals_are_exponential_with_the_period_as_mean() -> None:
    at = np.array([at for at, _ in queued(Stream(0x300, Duration(MS), arrivals="random"), 3_000 * MS)])
    assert stats.kstest(np.diff(at) / MS, "expon").pvalue > 0.01


def test_lengths_are_even_between_their_bounds() -> None:
    found = queued(Stream(0x300, Duration(MS), bytes_min=2, bytes_max=5), 2_000 * MS)
    counts = np.bincount([len(frame.data) for _, frame in found], minlength=6)
    assert not counts[:2].any()
    assert stats.chisquare(counts[2:6]).pvalue > 0.01


def test_a_stream_stays_as_it_was_when_another_is_added() -> None:
    streams = [Stream(0x300, Duration(MS)), Stream(0x301, Duration(MS), arrivals="random")]
    alone, both = background_nodes(streams[:1], 7), background_nodes(streams, 7)
    for node in (alone[0], both[0]):
        node.start(Instant(0))
    assert alone[0].wake(Instant(50 * MS)) == both[0].wake(Instant(50 * MS))
    assert queued(streams[0], 50 * MS, seed=1) != queued(streams[0], 50 * MS, seed=2)


def test_what_a_late_wake_up_cannot_make_good_is_skipped_and_counted() -> None:
    node = BackgroundNode(Stream(0x300, Duration(MS)), 1, "0")
    node.start(Instant(0))
    frames = node.wake(Instant(100 * MS))
    assert len(frames) == CATCH_UP_MAX
    assert node.skipped + len(frames) in (100, 101)


def test_the_load_is_that_of_the_frames() -> None:
    timeline = Timeline()
    segment = CanSegment(timeline)
    bits = 0

    def count(frame: Frame, _at: Instant) -> None:
        nonlocal bits
        bits += len(wire_bits(frame)) + 3

    segment.add_monitor(count)
    streams = [
        Stream(0x300, Duration(MS), jitter=Duration(MS // 10)),
        Stream(0x18FEF100, Duration(2 * MS), extended=True),
        Stream(0x72B, Duration(5 * MS), remote=True, bytes_min=1, bytes_max=1),
    ]
    for node in background_nodes(streams, 3):
        AttachedDevice(node, segment)
    timeline.run_until(Instant(1_000 * MS + MS // 2))
    assert segment.frames in range(1_698, 1_702)
    assert segment.load_percent(Instant(0), timeline.now) == pytest.approx(
        bits * 1e5 / timeline.now, rel=1e-9
    )


def test_the_example_is_a_file_of_background_traffic() -> None:
    assert [stream.can_id for stream in load_background(EXAMPLES / "background" / "plc.toml")] == [
        0x22A,
        0x1AB,
        0x18FEF100,
        0x72B,
    ]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("can_id = 0x800", "at most 0x7FF, or extended = true"),
        ("can_id = 0x300\nbytes_max = 9", "<= 8"),
        ("can_id = 0x300\nbytes_min = 5\nbytes_max = 4", "at most bytes_max = 4"),
        ("can_id = 0x300\njitter_us = 2000", "at most period_us = 1000"),
        ("can_id = 0x300\njiter_us = 20", "jitter_us"),
        ("", "can_id"),
    ],
)
def test_a_bad_entry_is_named(line: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "traffic.toml"
    path.write_text(f"[[background]]\nperiod_us = 1000\n{line}\n")
    with pytest.raises((BadInput, BadInputs)) as caught:
        load_background(path)
    assert said in str(caught.value)


def test_a_bench_may_not_use_its_own_nodes_identifiers(tmp_path: Path) -> None:
    text = (EXAMPLES / "ling2012.toml").read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    text = text.replace('"faults/', f'"{EXAMPLES}/faults/')
    path = tmp_path / "bench.toml"
    path.write_text(f"{text}\n[[bus.background]]\ncan_id = 0x181\nperiod_us = 1000\n")
    with pytest.raises(BadInput, match="0x181"):
        load_bench(path)
    path.write_text(f"{text}\n[[bus.background]]\ncan_id = 0x1A1\nperiod_us = 1000\n")
    assert load_bench(path).bus.background[0].stream.can_id == 0x1A1
