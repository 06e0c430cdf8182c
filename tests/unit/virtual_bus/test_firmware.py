"""The inner loops: grid and causality, current control inside its limits, encoder, ramps, brake."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.design.motor import PmsmParameters
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from tests.draws import examples_of
from tests.motors import AZAIZ, LING

TICK_NS = 62_500


def torque_drive(motor: PmsmParameters = LING, **parameters: float) -> Firmware:
    """A drive in torque control at rest, no torque asked."""
    firmware = Firmware(motor, replace(FirmwareParameters(), **parameters))  # type: ignore[arg-type]
    firmware.control(InnerControl.TORQUE)
    return firmware


def trace(firmware: Firmware, name: str, ticks: int) -> list[float]:
    """One signal of the state at each of the next ticks."""
    values = []
    for _ in range(ticks):
        assert firmware.advance_to(Instant(firmware.tick_at + TICK_NS))
        values.append(getattr(firmware.inner, name))
    return values


def spun(speed_rad_s: float, motor: PmsmParameters = LING) -> Firmware:
    """A drive in torque control on a shaft so heavy that it keeps its speed."""
    firmware = torque_drive(replace(motor, inertia_kg_m2=1e6, viscous_friction_nm_s=0.0))
    firmware.inner.speed_rad_s = speed_rad_s
    trace(firmware, "speed_rad_s", 400)
    return firmware


def test_ticks_stand_on_a_grid_from_power_on() -> None:
    firmware = Firmware(LING, FirmwareParameters())
    firmware.start(Instant(1_000))
    assert not firmware.advance_to(Instant(1_000 + TICK_NS - 1))
    assert firmware.advance_to(Instant(1_000 + TICK_NS))
    assert (firmware.ticks, firmware.tick_at) == (1, 1_000 + TICK_NS)
    assert not firmware.advance_to(Instant(1_000 + TICK_NS))


def test_a_rate_that_no_ns_fits_does_not_drift() -> None:
    firmware = Firmware(LING, FirmwareParameters(inner_rate_hz=12_000))
    firmware.advance_to(Instant(3 * NS_PER_S))
    assert firmware.ticks == 36_000
    assert firmware.tick_at == 3 * NS_PER_S


@examples_of(200)
@given(
    st.sampled_from([1_000, 4_001, 16_000, 99_991]),
    st.integers(0, NS_PER_S),
    st.integers(0, 2 * NS_PER_MS),
    st.integers(-1, 1),
)
def test_the_next_tick_is_the_first_at_or_after(rate_hz: int, begun: int, passed: int, off: int) -> None:
    """Just before a tick, at it, and just after it: by fractions of nanoseconds."""
    firmware = torque_drive(inner_rate_hz=rate_hz)
    firmware.start(Instant(begun))
    at = math.ceil(Fraction(passed * rate_hz // NS_PER_S * NS_PER_S, rate_hz))
    now = begun + max(at + off, 0)
    ticks = math.ceil(Fraction((now - begun) * rate_hz, NS_PER_S))
    assert firmware.tick_after(Instant(now)) == begun + math.ceil(Fraction(ticks * NS_PER_S, rate_hz))
    firmware.advance_to(Instant(now))
    assert firmware.ticks == (now - begun) * rate_hz // NS_PER_S
    assert firmware.tick_at == begun + math.floor(Fraction(firmware.ticks * NS_PER_S, rate_hz))


@examples_of(40)
@given(st.lists(st.integers(0, 3 * NS_PER_MS), min_size=1, max_size=8))
def test_how_often_it_is_advanced_makes_no_difference(pauses: list[int]) -> None:
    pieces, whole = torque_drive(), torque_drive()
    now = 0
    for drive in (pieces, whole):
        drive.demand_torque(1.0)
    for pause in pauses:
        now += pause
        pieces.advance_to(Instant(now))
    whole.advance_to(Instant(now))
    assert pieces.inner.state() == whole.inner.state()


def test_a_set_point_acts_one_period_after_the_tick_that_takes_it() -> None:
    firmware = torque_drive()
    trace(firmware, "current_q_a", 4)
    firmware.demand_torque(1.0)
    current = trace(firmware, "current_q_a", 3)
    assert current[0] == current[1] == 0.0, "taken at the first tick, applied from the second on"
    assert current[2] > 0.1


@pytest.mark.parametrize("motor", [LING, AZAIZ], ids=["ling", "azaiz"])
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_torque_step_is_quick_exact_and_nearly_without_overshoot(motor: PmsmParameters, share: float) -> None:
    firmware = spun(share * motor.rated_speed_rad_s, motor)
    target = 0.3 * motor.rated_torque_nm
    firmware.demand_torque(target)
    torque = trace(firmware, "torque_measured_nm", 160)
    reached = next(tick for tick, value in enumerate(torque) if value > 0.9 * target)
    assert reached <= 12, "0.75 ms"
    assert max(torque) < 1.06 * target
    assert np.mean(torque[80:]) == pytest.approx(target, rel=0.005)


@pytest.mark.parametrize("motor", [LING, AZAIZ], ids=["ling", "azaiz"])
def test_d_current_stays_at_zero_at_speed(motor: PmsmParameters) -> None:
    firmware = spun(0.8 * motor.rated_speed_rad_s, motor)
    firmware.demand_torque(0.5 * motor.rated_torque_nm)
    i_d = trace(firmware, "current_d_a", 320)
    i_q = 0.5 * motor.rated_current_a
    assert max(abs(value) for value in i_d) < 0.12 * i_q
    assert abs(np.mean(i_d[160:])) < 0.01 * i_q


def test_voltage_stays_in_the_circle_and_the_limit_leaves_no_wind_up() -> None:
    fast = 1.2 * LING.voltage_max_v / (LING.pole_pairs * LING.flux_linkage_wb)
    firmware = spun(fast)
    firmware.demand_torque(3.0)
    trace(firmware, "torque_measured_nm", 1600)
    assert firmware.inner.limited == 1.0
    assert firmware.inner.torque_measured_nm < 3.0
    v = np.hypot(firmware.inner.voltage_d_v, firmware.inner.voltage_q_v)
    assert v == pytest.approx(LING.voltage_max_v, rel=1e-9)
    firmware.inner.speed_rad_s = 0.5 * fast
    torque = trace(firmware, "torque_measured_nm", 800)
    assert max(torque[80:]) < 1.1 * 3.0
    assert torque[-1] == pytest.approx(3.0, rel=0.01)


def test_current_never_exceeds_its_limit_by_more_than_the_step_response() -> None:
    firmware = torque_drive()
    firmware.demand_torque(100.0)
    current = trace(firmware, "current_q_a", 400)
    assert max(current) < 1.06 * LING.current_max_a
    assert current[-1] == pytest.approx(LING.current_max_a, rel=0.01)
    assert firmware.inner.limited == 1.0


def test_a_coarse_encoder_measures_the_speed_in_the_mean() -> None:
    firmware = torque_drive(
        replace(LING, inertia_kg_m2=1e6, viscous_friction_nm_s=0.0), encoder_counts_per_revolution=1024
    )
    firmware.inner.speed_rad_s = 40.0
    measured = trace(firmware, "speed_measured_rad_s", 3200)[400:]
    assert np.mean(measured) == pytest.approx(40.0, rel=0.005)
    assert np.std(measured) > 0.5, "a coarse encoder must show its quantisation"
    angle = float(firmware.inner.angle_rad) / math.tau
    assert firmware.inner.count == math.floor((firmware.inner.turns + angle) * 1024)


def test_ramp_to_rest_follows_its_deceleration_under_load() -> None:
    firmware = torque_drive()
    firmware.demand_torque(1.5)
    trace(firmware, "speed_rad_s", 1200)
    start = firmware.speed_rad_s
    firmware.inner.load_nm = 0.6
    firmware.ramp_to_speed(0.0, 800.0)
    speeds = trace(firmware, "speed_rad_s", round(start / 800.0 * 16_000) + 1600)
    middle = round(start / 800.0 * 8_000)
    slope = (speeds[middle + 400] - speeds[middle - 400]) / 0.05
    assert slope == pytest.approx(-800.0, rel=0.05)
    assert firmware.rested_for_s() > 0.02
    assert min(speeds) > -0.1 * start


def test_going_over_to_the_ramp_is_bumpless() -> None:
    firmware = torque_drive(replace(LING, viscous_friction_nm_s=0.01))
    firmware.demand_torque(1.0)
    trace(firmware, "speed_rad_s", 8000)
    firmware.ramp_to_speed(0.0, 1.0)
    demand = trace(firmware, "torque_demand_nm", 16)
    assert all(value == pytest.approx(1.0, abs=0.1) for value in demand)


def test_inverter_off_lets_the_current_die_and_the_shaft_coast() -> None:
    firmware = torque_drive()
    firmware.demand_torque(2.0)
    trace(firmware, "speed_rad_s", 400)
    start = firmware.speed_rad_s
    firmware.control(InnerControl.OFF)
    current = trace(firmware, "current_q_a", 10)
    assert current[-1] == 0.0
    assert all(later <= earlier for earlier, later in itertools.pairwise(current))
    assert firmware.speed_rad_s == pytest.approx(start, rel=0.02)


@pytest.mark.parametrize(("brake_nm", "held"), [(None, True), (0.5, False), (0.0, False)])
def test_brake_holds_a_resting_shaft_against_the_load_as_far_as_it_can(
    brake_nm: float | None, held: bool
) -> None:
    firmware = Firmware(LING, FirmwareParameters(brake_torque_nm=brake_nm))
    firmware.advance_to(Instant(NS_PER_MS))
    firmware.inner.load_nm = 0.6
    firmware.advance_to(Instant(100 * NS_PER_MS))
    assert (firmware.speed_rad_s == 0.0) == held


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("inner_rate_hz", 999),
        ("encoder_counts_per_revolution", 8),
        ("current_bandwidth_hz", 2001.0),
        ("current_bandwidth_hz", 0.0),
    ],
)
def test_settings_that_cannot_work_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        replace(FirmwareParameters(), **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("rate_hz", [4_000, 8_000, 64_000])
def test_every_inner_rate_has_current_loops_that_settle(rate_hz: int) -> None:
    firmware = Firmware(LING, FirmwareParameters(inner_rate_hz=rate_hz))
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(0.5)
    firmware.advance_to(Instant(30 * NS_PER_MS))
    assert firmware.inner.torque_measured_nm == pytest.approx(0.5, rel=0.02)


@examples_of(50)
@given(
    st.lists(
        st.tuples(st.floats(-8.0, 8.0), st.floats(0.0, 6.0), st.floats(1.0, 200.0), st.booleans()),
        min_size=1,
        max_size=8,
    )
)
def test_the_torque_demand_told_is_the_one_in_force(steps: list[tuple[float, float, float, bool]]) -> None:
    """Between two ticks and after one, whatever was written last: as the limits cut it then."""
    firmware, asked_nm = torque_drive(), 0.0
    for at_ms, (torque_nm, most_nm, speed_max, limits_last) in enumerate(steps, start=1):
        for limits in (not limits_last, limits_last):
            if limits:
                firmware.limit(most_nm, 15.0, speed_max)
            else:
                asked_nm = torque_nm
                firmware.demand_torque(asked_nm)
            assert firmware.torque_demand_nm == in_force(firmware, asked_nm)
        firmware.advance_to(Instant(at_ms * NS_PER_MS))
        assert firmware.torque_demand_nm == in_force(firmware, asked_nm)


def in_force(firmware: Firmware, asked_nm: float) -> float:
    """Cut in front of the speed limit, then at the torque and current limits."""
    inner = firmware.inner
    most_nm = min(inner.torque_up_nm, inner.torque_constant_nm_a * inner.current_max_a)
    up = inner.speed_limit_gain * (inner.speed_max_rad_s - inner.speed_measured_rad_s)
    down = -inner.speed_limit_gain * (inner.speed_max_rad_s + inner.speed_measured_rad_s)
    return min(max(min(max(asked_nm, down), up), -most_nm), most_nm)
