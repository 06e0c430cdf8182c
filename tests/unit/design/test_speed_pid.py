"""The PID rule: what it promises, and that more cannot be had."""

import math

import numpy as np
import pytest

from servobench.design.current.current_design import complementary
from servobench.design.errors import InfeasibleDesign
from servobench.design.papers.azaiz2007 import MOTOR, paper_design
from servobench.design.speed.speed_pid import SpeedPid, first_order_current_loop, pid_by_rule

Q = paper_design("q")[1]
T_I, CROSSOVER = complementary(Q.plant, Q.controller), Q.margins.phase_margin_rad_s


def _at(found: SpeedPid, omega: float) -> tuple[float, float]:
    """Degrees above -180, and the gain, of the loop as the gains are written."""
    s = 1j * omega
    controller = (
        found.proportional_nm_s_rad
        + found.integral_nm_rad / s
        + found.derivative_nm_s2_rad * s / (1.0 + found.derivative_filter_s * s)
    )
    shaft = MOTOR.inertia_kg_m2 * s + MOTOR.viscous_friction_nm_s
    loop = controller * np.exp(-s * found.dead_time_s) * T_I.at(s)[0, 0, 0] / shaft
    return 180.0 + math.degrees(np.angle(loop)), float(abs(loop))


@pytest.mark.parametrize("latency_s", [2e-4, 1e-3, 3e-3])
@pytest.mark.parametrize("margin_deg", [40.0, 50.0, 60.0])
def test_the_margin_asked_for_is_there(latency_s: float, margin_deg: float) -> None:
    found = pid_by_rule(MOTOR, T_I, CROSSOVER, 1e-3, latency_s, margin_deg)
    phase, gain = _at(found, found.crossover_rad_s)
    assert phase == pytest.approx(margin_deg, abs=1e-6)
    assert gain == pytest.approx(1.0, rel=1e-9)
    assert found.margins.phase_margin_deg == pytest.approx(margin_deg, abs=1e-6)
    assert found.margins.modulus_margin > 0.3
    assert found.dead_time_s == pytest.approx(latency_s + 5e-4)


def test_more_delay_costs_crossover() -> None:
    crossovers = [pid_by_rule(MOTOR, T_I, CROSSOVER, 1e-3, x).crossover_rad_s for x in (2e-4, 1e-3, 3e-3)]
    assert crossovers[0] > crossovers[1] > crossovers[2]


def test_the_integral_and_derivative_follow_the_rule() -> None:
    found = pid_by_rule(MOTOR, first_order_current_loop(5000.0), 5000.0, 1e-3, 5e-4, 50.0, 25.0)
    assert found.derivative_nm_s2_rad / found.proportional_nm_s_rad == pytest.approx(1.0 / 5000.0)
    assert found.proportional_nm_s_rad / found.integral_nm_rad == pytest.approx(25.0 / found.crossover_rad_s)


def test_a_margin_that_cannot_be_had_says_what_can() -> None:
    with pytest.raises(InfeasibleDesign, match=r"the best is .*shorten the delay"):
        pid_by_rule(MOTOR, T_I, CROSSOVER, 1e-3, 1e-3, 179.9)
