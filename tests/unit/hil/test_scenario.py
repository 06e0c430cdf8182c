"""Speed and load profiles."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.loop.scenario import LevelStep, Quantity, Ramp, ReferenceProfile, Sine, sine_of_turns


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


@settings(derandomize=True, deadline=None)
@given(st.floats(-1000.0, 1000.0))
def test_the_portable_sine_agrees_with_the_library(turns: float) -> None:
    assert sine_of_turns(turns) == pytest.approx(math.sin(2.0 * math.pi * math.fmod(turns, 1.0)), abs=2e-12)
