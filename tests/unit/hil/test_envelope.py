"""Envelopes against brute force, and against any division into chunks."""

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.hil.reviewing.envelope import BUCKETS, LANE_BUCKETS, CodeLane, Envelope, bucket_width_ns

PERIOD_NS = 1_000_000


def signal(count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    random = np.random.Generator(np.random.PCG64(4))
    return np.arange(count) * PERIOD_NS, random.normal(size=count).round(2)


@pytest.mark.parametrize(
    ("count", "chunk"), [(1, 1), (1_999, 7), (4_001, 7), (4_001, 1_000), (50_000, 1_000), (50_000, 60_000)]
)
def test_each_bucket_keeps_its_least_and_its_largest(count: int, chunk: int) -> None:
    times, values = signal(count)
    envelope = Envelope()
    for start in range(0, count, chunk):
        envelope.add(times[start : start + chunk], values[start : start + chunk])
    kept_at, kept = envelope.points()
    assert kept.size <= 2 * (BUCKETS + 1)
    assert (np.diff(kept_at) > 0).all()
    np.testing.assert_array_equal(kept, values[kept_at // PERIOD_NS])
    width = bucket_width_ns(0, int(times[-1]))
    for bucket in np.unique(times // width):
        inside, shown = values[times // width == bucket], kept[kept_at // width == bucket]
        assert (inside.min(), inside.max()) == (shown.min(), shown.max())


def test_a_peak_of_one_cycle_is_kept_in_an_hour() -> None:
    times = np.arange(3_600_000) * PERIOD_NS
    values = np.zeros(times.size)
    values[1_234_567] = 9.0
    envelope = Envelope()
    for part in range(0, times.size, 100_000):
        envelope.add(times[part : part + 100_000], values[part : part + 100_000])
    kept_at, kept = envelope.points()
    assert kept_at[kept == 9.0].tolist() == [1_234_567 * PERIOD_NS]
    assert envelope.ends() == (0.0, 9.0)


def test_what_is_no_number_is_left_out() -> None:
    envelope = Envelope()
    envelope.add(np.arange(3), np.array([np.nan, 2.0, np.nan]))
    assert envelope.points()[1].tolist() == [2.0]
    assert Envelope().ends() is None
    assert Envelope().largest(0.5) is None


def test_the_gravest_code_of_a_bucket_is_told() -> None:
    lane = CodeLane()
    times = np.arange(1_000_000) * PERIOD_NS
    codes = np.zeros(times.size, np.int64)
    codes[[300_000, 300_001]] = 1, 3
    for part in range(0, times.size, 1_000):
        lane.add(times[part : part + 1_000], codes[part : part + 1_000])
    changes = lane.changes()
    assert [code for _, code in changes] == [0, 3, 0]
    width = bucket_width_ns(0, int(times[-1]), LANE_BUCKETS)
    assert 0 <= 300_000 * PERIOD_NS - changes[1][0] < width


def test_a_short_lane_is_exact() -> None:
    lane = CodeLane()
    lane.add(np.arange(5) * PERIOD_NS, np.array([0, 2, 2, 0, 1]))
    assert lane.changes() == [(0, 0), (PERIOD_NS, 2), (3 * PERIOD_NS, 0), (4 * PERIOD_NS, 1)]
