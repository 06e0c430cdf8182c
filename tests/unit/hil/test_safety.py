"""Host limits; each is shown to act, at its edge."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servobench.drivers.exchange import Command, PositionCommand, SpeedCommand
from servobench.drivers.timebase import Instant
from servobench.hil.loop.protocol import (
    PositionSetPoint,
    SetPoint,
    SpeedSetPoint,
    TorqueSetPoint,
    WrongSetPoint,
)
from servobench.hil.loop.safety import Limits, PositionLimits, SafetyGuard, SpeedLimits, TorqueLimits
from servobench.hil.loop.samples import AT_REST


def guard(slew: float | None = None) -> SafetyGuard:
    return SafetyGuard(TorqueLimits(5.0, 100.0, slew, 3), 0.001)


@settings(derandomize=True, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=40))
def test_no_torque_leaves_the_limits_whatever_is_asked(demands: list[float]) -> None:
    checked, last = guard(slew=400.0), 0.0
    for demand in demands:
        torque = checked.limit(demand)
        assert -5.0 <= torque <= 5.0
        assert math.isnan(demand) or abs(torque - last) <= 0.4 + 1e-12
        last = last if math.isnan(demand) else torque


@pytest.mark.parametrize(("demand", "allowed"), [(4.999, 4.999), (5.001, 5.0), (-7.0, -5.0)])
def test_torque_is_cut_at_its_limit_on_both_sides(demand: float, allowed: float) -> None:
    assert guard().limit(demand) == allowed


@pytest.mark.parametrize(("speed", "stops"), [(100.0, False), (100.1, True), (-100.0, False), (-100.1, True)])
def test_speed_limit_on_both_sides(speed: float, stops: bool) -> None:
    assert (guard().check_speed(speed) is not None) is stops


def test_a_torque_that_is_not_a_number_stops_the_run_and_sends_none() -> None:
    checked = guard()
    assert checked.limit(math.nan) == 0.0
    assert "not a number" in str(checked.check_cycle(True, math.nan, AT_REST))


def test_consecutive_dropouts_are_counted_from_the_last_fresh_sample() -> None:
    checked = guard()
    reasons = [checked.check_cycle(fresh, 0.0, AT_REST) for fresh in (False, False, False, True, False)]
    assert reasons == [None] * 5
    reasons = [checked.check_cycle(False, 0.0, AT_REST) for _ in range(3)]
    assert reasons[:2] == [None, None]
    assert reasons[2] is not None


ANY = (TorqueLimits(5.0, 100.0), SpeedLimits(30.0, 40.0), PositionLimits(50.0, 60.0))
"""Of each quantity, with what else stands for itself."""


@pytest.mark.parametrize("limits", ANY)
def test_a_tenth_of_a_second_without_reading_is_borne_where_nothing_else_is_said(limits: Limits) -> None:
    checked = SafetyGuard(limits, 0.001)
    assert [checked.miss_cycle() for _ in range(100)] == [None] * 100
    assert "101 cycles (limit 100)" in str(checked.miss_cycle())


# ---- an axis that is given speeds -------------------------------------------------------------------------

AT, UNTIL = Instant(10), Instant(20)


def speeds() -> SafetyGuard:
    """Set-points to 30 rad/s, by 2 rad/s a cycle; the shaft to 40 rad/s."""
    return SafetyGuard(SpeedLimits(30.0, 40.0, 2000.0, 3), 0.001)


def test_what_is_let_through_is_a_command_of_the_quantity_that_is_limited() -> None:
    assert guard().command(7, 6.0, AT, UNTIL) == Command(7, 5.0, AT, UNTIL)
    speed = speeds().command(7, 1.5, AT, UNTIL)
    assert speed == SpeedCommand(7, 1.5, AT, UNTIL)
    assert math.isnan(speed.torque_nm), "a speed is no torque"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_speed_is_cut_at_its_own_limits(sign: float) -> None:
    checked = speeds()
    sent = [checked.limit(sign * 1e6) for _ in range(16)]
    assert sent == [sign * 2.0 * cycle for cycle in range(1, 16)] + [sign * 30.0]
    assert checked.check_speed(sign * 40.0) is None
    assert "limit of 40.0 rad/s" in str(checked.check_speed(sign * 40.1))


def test_a_speed_without_a_limit_of_acceleration_is_cut_at_its_limit_alone() -> None:
    assert SafetyGuard(SpeedLimits(30.0, 40.0), 0.001).limit(1e6) == 30.0


def test_a_speed_that_is_not_a_number_stops_the_run_and_sends_none() -> None:
    checked = speeds()
    assert checked.command(7, math.nan, AT, UNTIL) == SpeedCommand(7, 0.0, AT, UNTIL)
    assert "speed is not a number" in str(checked.check_cycle(True, math.nan, AT_REST))


# ---- an axis that is given positions ----------------------------------------------------------------------


def positions() -> SafetyGuard:
    """Set-points that move by 0.05 rad a cycle at most; the shaft to 60 rad/s."""
    return SafetyGuard(PositionLimits(50.0, 60.0, None, 3), 0.001)


def test_a_position_is_reached_at_its_own_rate_from_where_the_shaft_is() -> None:
    checked = positions()
    checked.start_from(3.0)
    assert checked.command(7, 9.0, AT, UNTIL) == PositionCommand(7, 3.05, AT, UNTIL)
    assert checked.limit(3.07) == 3.07
    assert "limit of 60.0 rad/s" in str(checked.check_speed(-60.1))


def test_a_position_changes_its_rate_by_its_acceleration() -> None:
    checked = SafetyGuard(PositionLimits(50.0, 60.0, 2000.0), 0.001)
    checked.start_from(0.0)
    assert [checked.limit(1.0), checked.limit(1.0)] == pytest.approx([0.002, 0.006])


def test_a_position_that_is_not_a_number_stops_the_run_where_the_set_point_was() -> None:
    checked = positions()
    checked.start_from(3.0)
    assert checked.command(7, math.nan, AT, UNTIL) == PositionCommand(7, 3.0, AT, UNTIL)
    assert "position is not a number" in str(checked.check_cycle(True, math.nan, AT_REST))


SET_POINTS = (TorqueSetPoint(1.5), SpeedSetPoint(1.5), PositionSetPoint(1.5))


@pytest.mark.parametrize("place", range(3))
def test_each_axis_takes_the_quantity_that_its_limits_are_for(place: int) -> None:
    checked = SafetyGuard(ANY[place], 0.001)
    assert checked.takes_positions is (place == 2)
    assert checked.demand(SET_POINTS[place]) == 1.5
    others: list[SetPoint] = [asked for asked in SET_POINTS if asked is not SET_POINTS[place]]
    for asked in others:
        with pytest.raises(WrongSetPoint, match=f"takes a {type(SET_POINTS[place]).__name__}"):
            checked.demand(asked)


def test_an_axis_of_torques_or_speeds_starts_anywhere() -> None:
    for limits in ANY[:2]:
        checked = SafetyGuard(limits, 0.001)
        checked.start_from(3.0)
        assert checked.limit(1.5) == 1.5
