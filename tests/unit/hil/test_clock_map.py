"""The map from a drive's clock to the host's."""

import random

import pytest

from drivers.timebase import Duration, Instant
from hil.clock_map import ClockMap

LATENCY = Duration(50_000)
OFFSET_NS = 123_456_789_012
PERIOD_NS = 1_000_000


def exchange(number: int, drift_ppm: float, choices: random.Random) -> tuple[int, int, int, int]:
    """sent, device stamp (1 us resolution), received, true sampling instant."""
    sent = 5_000_000_000 + number * PERIOD_NS
    waiting = 0 if choices.random() < 0.5 else round(choices.expovariate(1.0 / 80_000.0))
    sampled = sent + LATENCY + waiting
    device = round((sampled - 5_000_000_000) * (1.0 + drift_ppm * 1e-6)) + OFFSET_NS
    return sent, device // 1000 * 1000, sampled + 250_000 + round(choices.expovariate(1 / 50_000.0)), sampled


@pytest.mark.parametrize("drift_ppm", [0.0, 40.0, -120.0, 300.0])
def test_the_sampling_instant_is_found_within_a_few_microseconds(drift_ppm: float) -> None:
    choices = random.Random(3)
    clock_map = ClockMap(LATENCY)
    errors = []
    for number in range(6000):
        sent, device, received, sampled = exchange(number, drift_ppm, choices)
        clock_map.observe(Instant(sent), device, Instant(received))
        sampled_at, error_ns = clock_map.place(device)
        assert abs(sampled_at - sampled) <= error_ns + 2000
        if number > 2000:
            errors.append(abs(sampled_at - sampled))
    assert sorted(errors)[len(errors) * 99 // 100] < 3000
    assert clock_map.drift_ppm == pytest.approx(-drift_ppm, abs=2.0)


def test_an_unbelievable_rate_is_limited() -> None:
    clock_map = ClockMap(LATENCY)
    choices = random.Random(5)
    for number in range(1000):
        sent, device, received, _ = exchange(number, 20_000.0, choices)
        clock_map.observe(Instant(sent), device, Instant(received))
    assert clock_map.drift_ppm == pytest.approx(-500.0)


def test_it_is_ready_after_the_first_exchange() -> None:
    clock_map = ClockMap(LATENCY)
    assert not clock_map.ready
    clock_map.observe(Instant(1_000_000), 77_000, Instant(1_400_000))
    assert clock_map.ready
    assert clock_map.place(77_000) == (1_050_000, 350_000)
