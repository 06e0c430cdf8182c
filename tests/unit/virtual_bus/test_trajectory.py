"""Motion profiles: closed forms, and what holds for every profile."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.virtual_bus.drive.trajectory import MoveLimits, Trajectory, plan_move, plan_speed, plan_stop
from tests.draws import examples_of

QUICK = examples_of(300)
POSITIONS = st.floats(-1e6, 1e6)
RATES = st.floats(0.1, 1e4)
SPEEDS = st.floats(-1e3, 1e3)


def samples(profile: Trajectory, pieces: int = 400) -> list[tuple[float, float, float]]:
    """Time, position and speed, evenly over the profile."""
    times = [profile.duration_s * k / pieces for k in range(pieces + 1)]
    return [(t, motion.position, motion.speed) for t in times for motion in (profile.at(t),)]


def test_a_trapezoid() -> None:
    profile = plan_move(1.0, 0.0, 6.0, MoveLimits(10.0, 100.0, 50.0))
    assert profile.duration_s == pytest.approx(0.1 + 0.35 + 0.2)
    assert profile.at(0.05).speed == pytest.approx(5.0)
    assert profile.at(0.2).speed == pytest.approx(10.0)
    assert profile.at(0.2).position == pytest.approx(1.0 + 0.5 + 1.0)
    assert profile.at(0.55).speed == pytest.approx(5.0)
    assert (profile.at(9.0).position, profile.at(9.0).speed) == (6.0, 0.0)


def test_a_short_way_peaks_below_the_profile_velocity() -> None:
    profile = plan_move(0.0, 0.0, -0.3, MoveLimits(10.0, 100.0, 50.0))
    peak = math.sqrt(2 * 0.3 * 100.0 * 50.0 / 150.0)
    assert profile.duration_s == pytest.approx(peak / 100.0 + peak / 50.0)
    assert min(speed for _, _, speed in samples(profile, 3000)) == pytest.approx(-peak, rel=1e-3)


def test_a_start_too_fast_for_the_way_comes_back() -> None:
    profile = plan_move(0.0, 10.0, 0.1, MoveLimits(10.0, 100.0, 50.0))
    assert max(place for _, place, _ in samples(profile)) == pytest.approx(1.0, rel=1e-3)
    assert profile.end_position == 0.1
    assert profile.end_speed == 0.0


def test_a_start_above_the_profile_velocity_slows_down_to_it() -> None:
    profile = plan_move(0.0, 10.0, 5.0, MoveLimits(4.0, 100.0, 50.0))
    slowing, coming_to_rest = 6.0 / 50.0, 4.0 / 50.0
    cruise = (5.0 - 7.0 * slowing - 2.0 * coming_to_rest) / 4.0
    assert profile.duration_s == pytest.approx(slowing + cruise + coming_to_rest)


def test_an_end_velocity_is_kept_after_the_target() -> None:
    profile = plan_move(0.0, 0.0, 5.0, MoveLimits(10.0, 100.0, 50.0, 2.0))
    assert profile.end_speed == pytest.approx(2.0)
    assert profile.at(profile.duration_s + 1.0).position == pytest.approx(7.0)


def test_speed_falls_by_the_deceleration_and_rises_by_the_acceleration() -> None:
    assert plan_speed(10.0, 4.0, 100.0, 50.0).duration_s == pytest.approx(6.0 / 50.0)
    assert plan_speed(-4.0, -10.0, 100.0, 50.0).duration_s == pytest.approx(6.0 / 100.0)
    through_zero = plan_speed(10.0, -10.0, 100.0, 50.0)
    assert through_zero.duration_s == pytest.approx(10.0 / 50.0 + 10.0 / 100.0)
    assert through_zero.at(0.2).speed == pytest.approx(0.0, abs=1e-9)
    assert through_zero.end_speed == -10.0


@QUICK
@given(POSITIONS, SPEEDS, RATES)
def test_a_stop_takes_the_shortest_way(position: float, speed: float, deceleration: float) -> None:
    profile = plan_stop(position, speed, deceleration)
    way = speed * abs(speed) / (2 * deceleration)
    assert profile.end_position - position == pytest.approx(way, rel=1e-6, abs=1e-6)
    assert profile.end_speed == 0.0


@QUICK
@given(POSITIONS, SPEEDS, POSITIONS, st.floats(0.1, 1e3), RATES, RATES)
def test_every_move_ends_at_its_target_within_its_limits(
    position: float, speed: float, target: float, fastest: float, acceleration: float, deceleration: float
) -> None:
    limits = MoveLimits(fastest, acceleration, deceleration)
    profile = plan_move(position, speed, target, limits)
    end = profile.at(profile.duration_s)
    scale = 1.0 + abs(position) + abs(target)
    assert end.position == pytest.approx(target, abs=1e-6 * scale)
    assert end.speed == 0.0
    seen = samples(profile)
    assert max(abs(v) for _, _, v in seen) <= max(fastest, abs(speed)) * (1 + 1e-6)
    steepest = max(acceleration, deceleration)
    for (t0, x0, v0), (t1, x1, v1) in pairwise(seen):
        step = t1 - t0
        assert abs(v1 - v0) <= steepest * step * (1 + 1e-6) + 1e-6 * (1 + fastest + abs(speed))
        assert abs(x1 - x0) <= max(abs(v0), abs(v1), fastest) * step * (1 + 1e-6) + 1e-6 * scale


@QUICK
@given(SPEEDS, SPEEDS, RATES, RATES)
def test_every_change_of_speed_ends_at_its_target(
    start: float, target: float, acceleration: float, deceleration: float
) -> None:
    profile = plan_speed(start, target, acceleration, deceleration)
    assert profile.at(profile.duration_s).speed == target
    low, high = min(start, target), max(start, target)
    assert all(low - 1e-6 <= speed <= high + 1e-6 for _, _, speed in samples(profile, 50))
