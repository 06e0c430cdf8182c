"""A position loop over a speed mode, and streams of set-points: what they ask for at which instant."""

import math

import pytest

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.control.controllers import PositionLoop, SetPointStream
from servobench.hil.loop.protocol import Context, PositionSetPoint, SpeedSetPoint, TorqueSetPoint
from servobench.hil.loop.samples import StateEstimate
from servobench.hil.loop.scenario import Quantity, Ramp, ReferenceProfile, Segment

PERIOD = Duration(NS_PER_MS)
DUE_AT = Instant(7_000 * NS_PER_MS)
"""Of the cycle 1 s after the first."""
ACTS_AT = Instant(DUE_AT + 400_000)
RAMP = Ramp(0.0, 100.0, 10.0)


def cycle(quantity: Quantity, segment: Segment = RAMP, origin_rad: float = 0.0) -> Context:
    profile = ReferenceProfile([segment], quantity)
    profile.count_from(origin_rad)
    context = Context(PERIOD, profile)
    context.begin(1001, DUE_AT, 1.0, 0.0, Instant(DUE_AT + 300_000), ACTS_AT)
    return context


def test_the_reference_is_told_at_any_instant_and_ahead() -> None:
    context = cycle(Quantity.POSITION, origin_rad=3.0)
    assert context.reference_at(Instant(DUE_AT - 500 * NS_PER_MS)) == pytest.approx(3.0 + 5.0)
    assert context.reference_rate_at(DUE_AT) == pytest.approx(10.0)
    assert context.preview(2) == pytest.approx([13.0, 13.01, 13.02])
    assert cycle(Quantity.SPEED, origin_rad=3.0).preview(0) == pytest.approx([10.0])


def test_a_stream_is_given_for_when_the_drive_will_be_there() -> None:
    position = SetPointStream(Quantity.POSITION, PERIOD).output(cycle(Quantity.POSITION, origin_rad=-2.0))
    assert isinstance(position, PositionSetPoint)
    assert position.position_rad == pytest.approx(-2.0 + 10.0 * 1.0014)
    speed = SetPointStream(Quantity.SPEED, PERIOD).output(cycle(Quantity.SPEED))
    assert isinstance(speed, SpeedSetPoint)
    assert speed.speed_rad_s == pytest.approx(10.0 * 1.0004)
    torque = SetPointStream(Quantity.TORQUE, PERIOD).output(cycle(Quantity.TORQUE))
    assert isinstance(torque, TorqueSetPoint)
    assert torque.torque_nm == pytest.approx(10.0 * 1.0004)


def loop_speed(context: Context, gain: float, feedforward: float, lead_ms: int = 0) -> float:
    asked = PositionLoop(gain, feedforward, Duration(lead_ms * NS_PER_MS)).output(context)
    assert isinstance(asked, SpeedSetPoint)
    return asked.speed_rad_s


@pytest.mark.parametrize("age_ms", [0, 5, 50])
def test_a_shaft_on_its_way_has_no_error_however_old_its_reading(age_ms: int) -> None:
    context = cycle(Quantity.POSITION, origin_rad=4.0)
    at = Instant(DUE_AT - age_ms * NS_PER_MS)
    context.estimate = StateEstimate(4.0 + 10.0 * (1.0 - age_ms / 1e3), 10.0, 0.0, at, 900)
    assert loop_speed(context, gain=80.0, feedforward=1.0) == pytest.approx(10.0)
    assert loop_speed(context, gain=80.0, feedforward=0.0) == pytest.approx(0.0, abs=1e-10)


def test_an_error_of_position_is_a_speed_and_before_the_first_reading_there_is_none() -> None:
    context = cycle(Quantity.POSITION)
    assert loop_speed(context, gain=80.0, feedforward=1.0) == pytest.approx(10.0)
    context.estimate = StateEstimate(9.9, 10.0, 0.0, DUE_AT, 900)
    assert loop_speed(context, gain=80.0, feedforward=0.0) == pytest.approx(8.0)


def test_the_speed_is_fed_forward_for_when_the_shaft_has_it() -> None:
    context = cycle(Quantity.POSITION, Ramp(1.003, 1.0, 0.1))
    assert loop_speed(context, gain=80.0, feedforward=1.0, lead_ms=2) == 0.0
    assert loop_speed(context, gain=80.0, feedforward=1.0, lead_ms=3) == pytest.approx(10.0)
    assert math.isnan(context.reference_nm)
