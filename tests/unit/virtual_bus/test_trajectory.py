"""Motion profiles: closed forms, and what holds for every profile."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.virtual_bus.drive.trajectory import (
    LINEAR,
    SINE,
    MoveLimits,
    RampForm,
    Trajectory,
    TrajectoryPoint,
    plan_move,
    plan_speed,
    plan_stop,
)
from tests.draws import examples_of

QUICK = examples_of(300)
POSITIONS = st.floats(-1e6, 1e6)
RATES = st.floats(0.1, 1e4)
SPEEDS = st.floats(-1e3, 1e3)


def move(position: float, speed: float, target: float, limits: MoveLimits) -> Trajectory:
    return plan_move(TrajectoryPoint(position, speed), target, limits)


def change(speed: float, target: float, up: float, down: float, ramp: RampForm = LINEAR) -> Trajectory:
    return plan_speed(TrajectoryPoint(0.0, speed), target, up, down, ramp)


def samples(profile: Trajectory, pieces: int = 400) -> list[tuple[float, float, float]]:
    """Time, position and speed, evenly over the profile."""
    times = [profile.duration_s * k / pieces for k in range(pieces + 1)]
    return [(t, motion.position, motion.speed) for t in times for motion in (profile.at(t),)]


def test_a_trapezoid() -> None:
    profile = move(1.0, 0.0, 6.0, MoveLimits(10.0, 100.0, 50.0))
    assert profile.duration_s == pytest.approx(0.1 + 0.35 + 0.2)
    assert profile.at(0.05).speed == pytest.approx(5.0)
    assert profile.at(0.2).speed == pytest.approx(10.0)
    assert profile.at(0.2).position == pytest.approx(1.0 + 0.5 + 1.0)
    assert profile.at(0.55).speed == pytest.approx(5.0)
    assert (profile.at(9.0).position, profile.at(9.0).speed) == (6.0, 0.0)


def test_a_short_way_peaks_below_the_profile_velocity() -> None:
    profile = move(0.0, 0.0, -0.3, MoveLimits(10.0, 100.0, 50.0))
    peak = math.sqrt(2 * 0.3 * 100.0 * 50.0 / 150.0)
    assert profile.duration_s == pytest.approx(peak / 100.0 + peak / 50.0)
    assert min(speed for _, _, speed in samples(profile, 3000)) == pytest.approx(-peak, rel=1e-3)


def test_a_start_too_fast_for_the_way_comes_back() -> None:
    profile = move(0.0, 10.0, 0.1, MoveLimits(10.0, 100.0, 50.0))
    assert max(place for _, place, _ in samples(profile)) == pytest.approx(1.0, rel=1e-3)
    assert profile.end_position == 0.1
    assert profile.end_speed == 0.0


def test_a_start_above_the_profile_velocity_slows_down_to_it() -> None:
    profile = move(0.0, 10.0, 5.0, MoveLimits(4.0, 100.0, 50.0))
    slowing, coming_to_rest = 6.0 / 50.0, 4.0 / 50.0
    cruise = (5.0 - 7.0 * slowing - 2.0 * coming_to_rest) / 4.0
    assert profile.duration_s == pytest.approx(slowing + cruise + coming_to_rest)


def test_an_end_velocity_is_kept_after_the_target() -> None:
    profile = move(0.0, 0.0, 5.0, MoveLimits(10.0, 100.0, 50.0, 2.0))
    assert profile.end_speed == pytest.approx(2.0)
    assert profile.at(profile.duration_s + 1.0).position == pytest.approx(7.0)


def test_speed_falls_by_the_deceleration_and_rises_by_the_acceleration() -> None:
    assert change(10.0, 4.0, 100.0, 50.0).duration_s == pytest.approx(6.0 / 50.0)
    assert change(-4.0, -10.0, 100.0, 50.0).duration_s == pytest.approx(6.0 / 100.0)
    through_zero = change(10.0, -10.0, 100.0, 50.0)
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
    profile = move(position, speed, target, limits)
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
    profile = change(start, target, acceleration, deceleration)
    assert profile.at(profile.duration_s).speed == target
    low, high = min(start, target), max(start, target)
    assert all(low - 1e-6 <= speed <= high + 1e-6 for _, _, speed in samples(profile, 50))


# ---- ramps by a sine squared, and with a limit of the jerk ----------------------------------------------

JERK = RampForm(1000.0)


@pytest.mark.parametrize(
    ("ramp", "speed", "time_s"),
    [
        (LINEAR, 10.0, 10.0 / 50.0),
        (SINE, 10.0, 2.0 * 10.0 / 50.0),
        (JERK, 10.0, 10.0 / 50.0 + 50.0 / 1000.0),
        (JERK, 1.6, 2.0 * math.sqrt(1.6 / 1000.0)),
    ],
)
def test_a_ramp_takes_the_time_of_its_form(ramp: RampForm, speed: float, time_s: float) -> None:
    profile = change(0.0, speed, 50.0, 70.0, ramp)
    assert profile.duration_s == pytest.approx(time_s)
    middle = profile.at(0.5 * time_s)
    assert (middle.position, middle.speed) == pytest.approx(
        (
            0.5 * speed * 0.5 * time_s - (profile.end_position - 2.0 * middle.position) * 0.5,
            0.5 * speed,
        )
    )
    assert profile.end_position == pytest.approx(0.5 * speed * time_s)
    assert middle.acceleration == pytest.approx(min(50.0, math.sqrt(1600.0) if speed < 2.0 else 50.0))


def test_the_acceleration_of_a_sine_squared_is_one() -> None:
    profile = change(0.0, 10.0, 50.0, 70.0, SINE)
    for share in (0.1, 0.3, 0.5, 0.9):
        wanted = 50.0 * math.sin(math.pi * share) ** 2
        assert profile.at(share * profile.duration_s).acceleration == pytest.approx(wanted)


@examples_of(100)
@given(
    st.floats(-1e3, 1e3), SPEEDS, st.floats(-1e3, 1e3), st.floats(1.0, 1e3), st.floats(1.0, 1e4),
    st.floats(1.0, 1e4), st.sampled_from([0.0, 1.0]),
    st.sampled_from([SINE, RampForm(10.0), RampForm(1e3), RampForm(1e6)]),
)  # fmt: skip
def test_every_shaped_move_ends_at_its_target_within_its_limits(
    position: float,
    speed: float,
    target: float,
    fastest: float,
    up: float,
    down: float,
    end_share: float,
    ramp: RampForm,
) -> None:
    """Position, speed and acceleration are each the integral of the next, by differences of samples."""
    limits = MoveLimits(fastest, up, down, end_share * fastest, ramp)
    profile = move(position, speed, target, limits)
    end = profile.at(profile.duration_s)
    scale = 1.0 + abs(position) + abs(target) + abs(speed) * profile.duration_s
    assert end.position == pytest.approx(target, abs=1e-6 * scale)
    assert abs(end.speed) <= limits.end_speed * (1.0 + 1e-9)
    assert end.acceleration == 0.0
    steepest = max(up, down)
    times = [profile.duration_s * k / 60 for k in range(61)]
    points = [profile.at(time_s) for time_s in times]
    assert max(abs(each.speed) for each in points) <= max(fastest, abs(speed)) * (1.0 + 1e-6)
    assert max(abs(each.acceleration) for each in points) <= steepest * (1.0 + 1e-6)
    for (t0, one), (t1, other) in pairwise(zip(times, points, strict=True)):
        step = t1 - t0
        room = 1e-6 * scale
        assert abs(other.speed - one.speed) <= steepest * step + 1e-6 * (1.0 + fastest + abs(speed))
        assert abs(other.position - one.position) <= max(fastest, abs(speed)) * step + room
        mean = 0.5 * (one.speed + other.speed)
        assert other.position - one.position == pytest.approx(mean * step, abs=steepest * step**2 + room)
        if ramp.jerk:
            assert abs(other.acceleration - one.acceleration) <= ramp.jerk * step + 1e-6 * steepest


@pytest.mark.parametrize("way", [0.3, 1.0, 30.0])
@pytest.mark.parametrize("ramp", [SINE, JERK])
def test_a_shaped_move_is_as_quick_as_its_limits_allow(ramp: RampForm, way: float) -> None:
    """It reaches the profile velocity, or could not be faster without passing the target."""
    limits = MoveLimits(10.0, 100.0, 50.0, ramp=ramp)
    profile = move(0.0, 0.0, way, limits)
    peak = max(speed for _, _, speed in samples(profile, 4000))
    needed = ramp.way(0.0, peak, 100.0) + ramp.way(0.0, peak, 50.0)
    if peak == pytest.approx(10.0, rel=1e-4):
        assert needed <= way * (1.0 + 1e-3)
    else:
        assert needed == pytest.approx(way, rel=1e-3)
    assert (way == 30.0) is (peak > 9.99)


def test_a_linear_ramp_is_the_limit_of_ever_larger_jerk() -> None:
    for start, target in ((0.0, 5.0), (3.0, 1.0), (-2.0, 0.1)):
        bent = move(0.0, start, target, MoveLimits(10.0, 100.0, 50.0, ramp=RampForm(1e9)))
        straight = move(0.0, start, target, MoveLimits(10.0, 100.0, 50.0))
        assert bent.duration_s == pytest.approx(straight.duration_s, rel=1e-5)
        time_s = 0.4 * straight.duration_s
        assert bent.at(time_s).position == pytest.approx(straight.at(time_s).position, abs=1e-4)


@pytest.mark.parametrize("acceleration", [80.0, -40.0])
def test_a_profile_goes_on_from_the_acceleration_that_there_is(acceleration: float) -> None:
    start = TrajectoryPoint(1.0, 4.0, acceleration)
    for profile in (
        plan_move(start, 9.0, MoveLimits(10.0, 100.0, 50.0, ramp=JERK)),
        plan_speed(start, 7.0, 100.0, 50.0, JERK),
    ):
        times = [k * 1e-4 for k in range(round(profile.duration_s * 1e4))]
        seen = [profile.at(time_s).acceleration for time_s in times]
        assert seen[0] == acceleration
        assert max(abs(after - before) for before, after in pairwise(seen)) <= 1000.0 * 1e-4 * 1.001
