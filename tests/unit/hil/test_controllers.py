"""PID and state feedback."""

import math

import pytest

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.control.controllers import Pid, PidGains, StateFeedback
from servobench.hil.loop.protocol import Controller
from servobench.hil.loop.samples import StateEstimate
from tests.unit.hil.cycles import advance, torque_of

PERIOD_S = 0.001


def estimate(speed: float, number: int = 0, torque: float = 0.0) -> StateEstimate:
    return StateEstimate(0.0, speed, torque, Instant(number * NS_PER_MS), number)


def step(controller: Controller, state: StateEstimate, reference: float, limit: float = math.inf) -> float:
    demand = torque_of(controller, state, reference)
    advance(controller, state, min(max(demand, -limit), limit))
    return demand


def test_output_changes_nothing() -> None:
    pid = Pid(PidGains(0.1, 2.0, 0.001), PERIOD_S)
    step(pid, estimate(1.0, 0), 10.0)
    state = estimate(2.0, 1)
    assert torque_of(pid, state, 10.0) == torque_of(pid, state, 10.0)


def test_the_integral_grows_by_gain_times_error_times_period() -> None:
    pid = Pid(PidGains(0.0, 2.0), PERIOD_S)
    demands = [step(pid, estimate(0.0, number), 10.0) for number in range(4)]
    assert demands == pytest.approx([0.0, 0.02, 0.04, 0.06])


def test_back_calculation_bounds_the_integral_at_a_limit() -> None:
    with_limit = Pid(PidGains(0.05, 5.0), PERIOD_S)
    for number in range(3000):
        step(with_limit, estimate(0.0, number), 100.0, limit=1.0)
    # At rest: Ki e = (u - u_sat)/Tt, so u - u_sat = Tt Ki e = Kp e.
    assert step(with_limit, estimate(0.0, 3000), 100.0, limit=1.0) == pytest.approx(
        1.0 + 0.05 * 100.0, rel=1e-3
    )


def test_without_a_limit_back_calculation_does_nothing() -> None:
    free, tracked = Pid(PidGains(0.1, 2.0), PERIOD_S), Pid(PidGains(0.1, 2.0, anti_windup_s=0.002), PERIOD_S)
    for number in range(50):
        speed = 0.1 * number
        assert step(free, estimate(speed, number), 10.0) == step(tracked, estimate(speed, number), 10.0)


def test_the_filtered_derivative_settles_on_the_slope() -> None:
    pid = Pid(PidGains(0.0, 0.0, derivative_nm_s2_rad=0.01, derivative_filter_s=0.003), PERIOD_S)
    slope = 50.0
    for number in range(60):
        demand = step(pid, estimate(slope * number * PERIOD_S, number), 0.0)
    assert demand == pytest.approx(-0.01 * slope, rel=1e-6)


def test_a_held_estimate_leaves_the_derivative_alone_and_a_late_one_is_not_inflated() -> None:
    gains = PidGains(0.0, 0.0, derivative_nm_s2_rad=0.01, derivative_filter_s=0.0)
    pid = Pid(gains, PERIOD_S)
    step(pid, estimate(0.0, 0), 0.0)
    first = step(pid, estimate(0.05, 1), 0.0)
    assert step(pid, estimate(0.05, 1), 0.0) == first
    # Three periods later, on the same slope: the same derivative.
    assert step(pid, estimate(0.20, 4), 0.0) == pytest.approx(first)


def test_state_feedback_has_the_papers_signs() -> None:
    # K2 < 0: a speed below the reference (e > 0) must raise the current ([Ling2012] 5, K = [0, -0.0212]).
    controller = StateFeedback((0.0, -0.0212), 0.4, 0.00185)
    low, exact = estimate(140.0), estimate(157.0)
    steady = 0.00185 * 157.0
    assert torque_of(controller, exact, 157.0) == pytest.approx(steady)
    assert torque_of(controller, low, 157.0) == pytest.approx(steady + 0.4 * 0.0212 * 17.0)


def test_state_feedback_weighs_the_current_error() -> None:
    controller = StateFeedback((0.5, 0.0), 0.4, 0.0, feedforward_load_nm=0.8)
    # i_q* = 2 A; i_q = 1 A: u = K1 e_q = 0.5 A and i_qr = i_qr* - u = 1.5 A.
    assert torque_of(controller, estimate(0.0, torque=0.4), 0.0) == pytest.approx(0.4 * 1.5)


def test_state_feedback_integrates_once_a_period_and_not_at_a_limit() -> None:
    controller = StateFeedback((0.0, -0.02, -0.1), 0.4, 0.0, period_s=0.01)
    slow = estimate(90.0)
    assert step(controller, slow, 100.0) == pytest.approx(0.4 * 0.02 * 10.0)
    # 10 rad/s for 10 ms are 0.1 rad, and so 0.01 A more
    second = 0.4 * (0.02 * 10.0 + 0.1 * 0.1)
    assert step(controller, slow, 100.0, limit=0.5 * second) == pytest.approx(second)
    assert torque_of(controller, slow, 100.0) == pytest.approx(second)
