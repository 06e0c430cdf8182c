"""The map from a drive's clock to the host's."""

import random

import pytest

from servobench.drivers.timebase import Instant
from servobench.hil.loop.clock_map import STAMP_RESOLUTION, ClockMap

OFFSET_NS = 123_456_789_012
PERIOD_NS = 1_000_000


def stamp_of(at: int, drift_ppm: float) -> int:
    """What a drive's clock shows, in whole microseconds."""
    return int(at * (1.0 + drift_ppm * 1e-6) + OFFSET_NS) // STAMP_RESOLUTION * STAMP_RESOLUTION


@pytest.mark.parametrize("drift_ppm", [0.0, 40.0, -120.0, 1000.0, -1000.0, 1900.0])
def test_an_instant_is_found_within_its_bound_whatever_the_drift(drift_ppm: float) -> None:
    choices = random.Random(3)
    clock = ClockMap()
    errors = []
    for number in range(4000):
        at = 5_000_000_000 + number * PERIOD_NS + choices.randrange(-50_000, 50_000)
        stamp = stamp_of(at, drift_ppm)
        if number > 16:
            errors.append(abs(clock.place(stamp) - at))
            assert errors[-1] <= clock.error_ns
        clock.observe(stamp, Instant(at), 0.0)
    assert sorted(errors)[len(errors) * 99 // 100] < 700
    assert clock.drift_ppm == pytest.approx(drift_ppm, abs=clock.drift_error_ppm)
    assert clock.drift_error_ppm < 2.0


def test_a_change_of_the_rate_is_followed() -> None:
    clock = ClockMap()
    shown = float(OFFSET_NS)
    worst = 0
    for number in range(6000):
        shown += PERIOD_NS * (1.0 + (80e-6 if number > 2000 else 0.0))
        at = Instant(number * PERIOD_NS)
        stamp = int(shown) // STAMP_RESOLUTION * STAMP_RESOLUTION
        if number > 16:
            worst = max(worst, abs(clock.place(stamp) - at))
        clock.observe(stamp, at, 0.0)
    assert clock.drift_ppm == pytest.approx(80.0, abs=1.0)
    assert worst < 3_000


def test_an_older_stamp_teaches_nothing() -> None:
    clock = ClockMap()
    for number in range(10):
        clock.observe(number * PERIOD_NS, Instant(number * PERIOD_NS + 500), 0.0)
    placed = clock.place(20 * PERIOD_NS)
    clock.observe(5 * PERIOD_NS, Instant(9_999_999), 0.0)
    assert clock.place(20 * PERIOD_NS) == placed


def test_it_is_ready_after_the_first_stamp_and_can_start_anew() -> None:
    clock = ClockMap()
    assert not clock.ready
    clock.observe(77_000, Instant(1_050_000), 0.0)
    assert clock.ready
    assert clock.place(77_000) == 1_050_000
    clock.start_anew([(1_000, Instant(9_000_000)), (2_001_000, Instant(11_000_000))], 0.0)
    assert clock.place(2_001_000) == pytest.approx(11_000_000, abs=500)
    clock.shift(250)
    assert clock.place(2_001_000) == pytest.approx(11_000_250, abs=500)
