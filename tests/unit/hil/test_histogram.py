"""Quantiles of times against numpy on the same times, and the histogram's limits."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.hil.reviewing.histogram import TimeHistogram, _bucket_of, _bucket_range
from tests.draws import examples_of

times = st.lists(st.integers(0, 2**50 - 1) | st.integers(0, 5_000), min_size=1, max_size=60)


@examples_of(100)
@given(times, st.floats(0.001, 1.0))
def test_quantiles_are_within_a_thousandth(values: list[int], share: float) -> None:
    histogram = TimeHistogram()
    histogram.add(np.array(values, np.int64))
    exact = sorted(values)[max(1, math.ceil(share * len(values))) - 1]
    found = histogram.quantile_ns(share)
    assert found == pytest.approx(exact, rel=1e-3)
    assert exact >= 2048 or found == exact
    assert histogram.largest_ns == max(values)


@examples_of(100)
@given(st.integers(0, 2**50 - 1))
def test_every_time_lies_in_its_bucket(value: int) -> None:
    place = int(_bucket_of(np.array([value]))[0])
    low, width = _bucket_range(place)
    assert low <= value < low + width
    assert width <= max(1, value / 1000)


@examples_of(100)
@given(times, st.integers(1, 10))
def test_division_into_chunks_does_not_matter(values: list[int], size: int) -> None:
    whole, parts = TimeHistogram(), TimeHistogram()
    whole.add(np.array(values, np.int64))
    for start in range(0, len(values), size):
        parts.add(np.array(values[start : start + size], np.int64))
    assert [whole.quantile_ns(s) for s in (0.1, 0.5, 1.0)] == [parts.quantile_ns(s) for s in (0.1, 0.5, 1.0)]


def test_empty() -> None:
    histogram = TimeHistogram()
    histogram.add(np.zeros(0, np.int64))
    assert histogram.quantile_ns(0.5) is None
    assert histogram.largest_ns is None


def test_times_beyond_the_range_are_clipped() -> None:
    histogram = TimeHistogram()
    histogram.add(np.array([-7, 2**60], np.int64))
    assert histogram.quantile_ns(0.5) == 0.0
    assert histogram.largest_ns == 2**50 - 1


def test_bars_hold_every_time_and_the_last_bar_all_beyond() -> None:
    histogram = TimeHistogram()
    histogram.add(np.array([0, 9, 10, 25, 1_000_000], np.int64))
    assert histogram.bars(10, 4).tolist() == [2, 1, 1, 1]
