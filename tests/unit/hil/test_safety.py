"""Host limits; each is shown to act, at its edge."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.control.compensation import AT_REST
from hil.loop.safety import SafetyGuard, SafetyLimits


def guard(slew: float | None = None) -> SafetyGuard:
    return SafetyGuard(SafetyLimits(5.0, 100.0, slew, 3), 0.001)


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


def test_a_tenth_of_a_second_without_reading_is_borne_where_nothing_else_is_said() -> None:
    checked = SafetyGuard(SafetyLimits(5.0, 100.0), 0.001)
    assert [checked.miss_cycle() for _ in range(100)] == [None] * 100
    assert "101 cycles (limit 100)" in str(checked.miss_cycle())
