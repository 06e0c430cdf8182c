"""Speed and load profiles."""

import math
from array import array

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.hil.loop.scenario import (
    LevelStep,
    Quantity,
    Ramp,
    ReferenceProfile,
    Repeated,
    SCurve,
    Segment,
    Sine,
    Table,
    sine_of_turns,
)
from tests.draws import examples_of


def test_zero_before_the_first_segment_and_for_an_empty_profile() -> None:
    assert ReferenceProfile([]).value(3.0) == 0.0
    assert ReferenceProfile([LevelStep(1.0, 5.0)]).value(0.999) == 0.0


def test_segments_follow_each_other_in_time_whatever_their_order() -> None:
    profile = ReferenceProfile([Ramp(2.0, 20.0, 1.0), LevelStep(1.0, 10.0), Sine(4.0, 3.0, 0.5)])
    assert profile.value(1.0) == 10.0
    assert profile.value(2.25) == pytest.approx(12.5)
    assert profile.value(3.5) == 20.0
    assert profile.value(4.5) == pytest.approx(23.0)


def test_a_segment_that_is_cut_off_hands_over_the_speed_it_had_reached() -> None:
    profile = ReferenceProfile([Ramp(0.0, 10.0, 1.0), Ramp(0.5, 0.0, 1.0)])
    assert profile.value(0.5) == pytest.approx(5.0)
    assert profile.value(1.0) == pytest.approx(2.5)


def test_load_steps_hold_until_the_next() -> None:
    profile = ReferenceProfile([LevelStep(1.0, 0.6), LevelStep(1.5, 0.0)], Quantity.TORQUE)
    assert [profile.value(t) for t in (0.0, 1.0, 1.49, 1.5, 9.0)] == [0.0, 0.6, 0.6, 0.0, 0.0]


@examples_of(100)
@given(st.floats(-1000.0, 1000.0))
def test_the_portable_sine_agrees_with_the_library(turns: float) -> None:
    assert sine_of_turns(turns) == pytest.approx(math.sin(2.0 * math.pi * math.fmod(turns, 1.0)), abs=2e-12)


def doubles(*values: float) -> bytes:
    return array("d", values).tobytes()


CAM = Table(1.0, doubles(0.0, 0.5, 1.0), doubles(4.0, 8.0, 6.0), False)


@pytest.mark.parametrize(
    ("segment", "elapsed_s", "value", "rate"),
    [
        (LevelStep(1.0, 5.0), 0.0, 5.0, 0.0),
        (Ramp(1.0, 5.0, 0.5), 0.0, 2.0, 6.0),
        (Ramp(1.0, 5.0, 0.5), 0.25, 3.5, 6.0),
        (Ramp(1.0, 5.0, 0.5), 0.499, 4.994, 6.0),
        (Ramp(1.0, 5.0, 0.5), 0.5, 5.0, 0.0),
        (Ramp(1.0, 5.0, 0.5), 0.6, 5.0, 0.0),
        (Ramp(1.0, -1.0, 0.5), 0.25, 0.5, -6.0),
        (SCurve(1.0, 10.0, 0.5), 0.0, 2.0, 0.0),
        (SCurve(1.0, 10.0, 0.5), 0.25, 6.0, 30.0),
        (SCurve(1.0, 10.0, 0.5), 0.5, 10.0, 0.0),
        (SCurve(1.0, 10.0, 0.5), 0.6, 10.0, 0.0),
        (Repeated(1.0, CAM, 1.0, 2.0), 0.25, 6.0, 8.0),
        (Repeated(1.0, CAM, 1.0, 2.0), 1.25, 8.0, 8.0),
        (Repeated(1.0, CAM, 1.0, 2.0), 7.5, 22.0, -4.0),
        (Sine(1.0, 3.0, 0.5), 0.0, 2.0, 3.0 * math.pi),
        (Sine(1.0, 3.0, 0.5), 0.5, 5.0, 0.0),
        (Sine(1.0, 3.0, 0.5), 1.0, 2.0, -3.0 * math.pi),
        (Sine(1.0, 3.0, 0.5), 1.5, -1.0, 0.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), False), -1.0, 4.0, 0.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), False), 0.25, 5.0, 4.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), False), 1.0, 8.0, -2.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), False), 1.25, 7.5, -2.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), False), 1.5, 7.0, 0.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), True), 0.25, 4.0, 0.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), True), 1.0, 8.0, 0.0),
        (Table(1.0, doubles(0.0, 1.0, 1.5), doubles(4.0, 8.0, 7.0), True), 9.0, 7.0, 0.0),
        (Table(1.0, doubles(0.5), doubles(4.0), False), 0.0, 4.0, 0.0),
        (Table(1.0, doubles(0.5), doubles(4.0), False), 0.5, 4.0, 0.0),
        (Table(1.0, doubles(0.5), doubles(4.0), False), 0.75, 4.0, 0.0),
    ],
)
def test_level_and_rate_of_a_segment_that_begins_at_a_level_of_2(
    segment: Segment, elapsed_s: float, value: float, rate: float
) -> None:
    assert segment.at_s == 1.0
    assert segment.value(elapsed_s, 2.0) == pytest.approx(value, abs=1e-12)
    assert segment.rate(elapsed_s, 2.0) == pytest.approx(rate, abs=1e-11)


def test_the_rate_of_a_table_is_asked_for_before_its_value() -> None:
    table = Table(0.0, doubles(0.0, 1.0, 2.0, 3.0, 4.0), doubles(0.0, 1.0, 3.0, 6.0, 10.0), False)
    assert [table.rate(at_s, 0.0) for at_s in (3.5, 0.5, 2.5, 1.5, 3.0, 4.0)] == [4, 1, 3, 2, 4, 0]


def test_the_rate_of_a_profile_is_that_of_the_segment_at_hand() -> None:
    profile = ReferenceProfile([Ramp(1.0, 10.0, 1.0), Ramp(1.5, 0.0, 2.5), Sine(5.0, 1.0, 1.0)])
    assert [profile.rate(at_s) for at_s in (0.0, 0.999, 1.0, 1.499, 1.5, 3.999, 4.0)] == pytest.approx(
        [0.0, 0.0, 10.0, 10.0, -2.0, -2.0, 0.0]
    )
    assert profile.rate(5.0) == pytest.approx(math.tau)
    assert ReferenceProfile([]).rate(1.0) == 0.0


def test_the_first_segment_begins_at_zero_and_segments_at_one_instant_follow_each_other() -> None:
    assert ReferenceProfile([Ramp(1.0, 10.0, 1.0)]).value(1.5) == pytest.approx(5.0)
    assert ReferenceProfile([Sine(1.0, 3.0, 0.5)]).value(1.5) == pytest.approx(3.0)
    twice = ReferenceProfile([LevelStep(1.0, 4.0), Ramp(1.0, 10.0, 2.0)])
    assert [twice.value(at_s) for at_s in (0.5, 1.0, 2.0, 3.0)] == pytest.approx([0.0, 4.0, 7.0, 10.0])


@examples_of(100)
@given(st.floats(0.0, 1.0), st.floats(0.01, 10.0), st.floats(-100.0, 100.0))
def test_an_s_curve_is_the_polynomial_that_begins_and_ends_at_rest_without_acceleration(
    x: float, over_s: float, level: float
) -> None:
    """Witness: numpy's, solved from the six conditions on both ends."""
    powers = np.arange(6)
    bends = powers * (powers - 1)
    rows = [np.eye(6)[0], np.ones(6), np.eye(6)[1], powers, 2.0 * np.eye(6)[2], bends]
    way = np.polynomial.Polynomial(np.linalg.solve(rows, np.eye(6)[1]))
    curve, elapsed_s = SCurve(0.0, level, over_s), x * over_s
    rise = level - 3.0
    assert curve.value(elapsed_s, 3.0) == pytest.approx(3.0 + rise * way(x), abs=1e-9 * abs(rise) + 1e-12)
    expected = rise / over_s * way.deriv()(x)
    assert curve.rate(elapsed_s, 3.0) == pytest.approx(expected, abs=1e-8 * abs(rise / over_s) + 1e-9)


@pytest.mark.parametrize(
    ("quantity", "origin"), [(Quantity.POSITION, 7.0), (Quantity.SPEED, 0.0), (Quantity.TORQUE, 0.0)]
)
def test_positions_alone_count_from_where_the_shaft_is(quantity: Quantity, origin: float) -> None:
    profile = ReferenceProfile([LevelStep(1.0, 5.0), Ramp(2.0, 9.0, 1.0)], quantity)
    assert profile.quantity is quantity
    profile.count_from(7.0)
    asked = [profile.value(at_s) - origin for at_s in (0.0, 1.0, 2.5, 3.0)]
    assert asked == pytest.approx([0.0, 5.0, 7.0, 9.0])
    assert profile.rate(2.5) == pytest.approx(4.0), "an origin does not move"


def test_a_reference_is_a_speed_if_nobody_says_otherwise() -> None:
    assert ReferenceProfile([]).quantity is Quantity.SPEED


@pytest.mark.parametrize("turns", range(-3, 4))
def test_the_portable_sine_at_the_quarters_of_a_turn(turns: int) -> None:
    quarters = [sine_of_turns(turns + quarter / 4) for quarter in range(4)]
    assert quarters == pytest.approx([0.0, 1.0, 0.0, -1.0], abs=1e-13)
    eighths = [sine_of_turns(turns + (2 * eighth + 1) / 8) for eighth in range(4)]
    half = math.sqrt(0.5)
    assert eighths == pytest.approx([half, half, -half, -half], abs=1e-13)
