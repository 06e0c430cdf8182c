"""P and I of a drive's own loop, against closed forms and a step in time."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servobench.design.errors import InfeasibleDesign
from servobench.design.speed.drive_loop import (
    PHASE_MARGIN_MIN_DEG,
    closed_by,
    figures_of,
    pi_for_bandwidth,
    pi_for_phase_margin,
    position_plant,
    shaft_plant,
    winding_plant,
)

J = 2.0e-4


@pytest.mark.parametrize("hertz", [5.0, 40.0, 300.0])
def test_p_alone_on_an_inertia_crosses_at_its_bandwidth(hertz: float) -> None:
    """L = P/(J s): T = 1/(1 + s/w_c), so P = J w."""
    found = pi_for_bandwidth(shaft_plant(J, 0.0, 0.0), hertz, integral_share=0.0)
    assert found.proportional == pytest.approx(J * math.tau * hertz, rel=1e-6)
    assert found.integral == 0.0
    assert found.figures.bandwidth_hz == pytest.approx(hertz, rel=1e-6)
    assert found.figures.margins.phase_margin_deg == pytest.approx(90.0, abs=1e-6)


def test_a_phase_margin_is_what_delay_and_integral_leave() -> None:
    """180 - 90 - atan(0.2) - w_c Td = 60 degrees."""
    delay_s = 1e-3
    found = pi_for_phase_margin(shaft_plant(J, 0.0, delay_s), 60.0, 1.0, 1000.0)
    w_c = math.radians(30.0 - math.degrees(math.atan(0.2))) / delay_s
    assert found.figures.crossover_hz * math.tau == pytest.approx(w_c, rel=1e-4)
    assert found.figures.margins.phase_margin_deg == pytest.approx(60.0, abs=0.01)
    assert found.integral / found.proportional == pytest.approx(0.2 * w_c, rel=1e-4)


def test_the_bandwidth_asked_for_is_that_of_the_closed_loop_in_time() -> None:
    """A sine of that frequency comes through with 0.707 of its amplitude: integrated, not transformed."""
    hertz = 30.0
    found = pi_for_bandwidth(shaft_plant(J, 1e-4, 0.0, torque_lag_s=5e-4), hertz)
    omega = math.tau * hertz

    def slope(time: float, state: np.ndarray) -> list[float]:
        speed, torque, integral = state
        error = math.sin(omega * time) - speed
        asked = found.proportional * error + found.integral * integral
        return [(torque - 1e-4 * speed) / J, (asked - torque) / 5e-4, error]

    times = np.linspace(1.0 - 5.0 / hertz, 1.0, 2000)
    speed = solve_ivp(slope, (0.0, 1.0), [0.0, 0.0, 0.0], t_eval=times, rtol=1e-8, atol=1e-10).y[0]
    assert (speed.max() - speed.min()) / 2.0 == pytest.approx(math.sqrt(0.5), rel=1e-3)


def test_a_winding_and_a_position_loop_are_plants_too() -> None:
    current = pi_for_bandwidth(winding_plant(0.5, 1e-3, 1e-4), 400.0)
    assert current.figures.bandwidth_hz == pytest.approx(400.0, rel=1e-5)
    speed = pi_for_bandwidth(shaft_plant(J, 0.0, 5e-4), 60.0)
    L = closed_by(shaft_plant(J, 0.0, 5e-4), speed.proportional, speed.integral)
    place = pi_for_bandwidth(position_plant(L), 8.0, integral_share=0.0)
    assert place.figures.bandwidth_hz == pytest.approx(8.0, rel=1e-5)
    assert place.proportional == pytest.approx(math.tau * 8.0, rel=0.2)


def test_what_cannot_be_is_refused_with_its_reason() -> None:
    plant = shaft_plant(J, 0.0, 2e-3)
    with pytest.raises(InfeasibleDesign, match="degrees of phase"):
        pi_for_bandwidth(plant, 200.0)
    with pytest.raises(InfeasibleDesign, match="the best is 7"):
        pi_for_phase_margin(plant, 85.0, 1.0, 100.0)
    with pytest.raises(InfeasibleDesign, match="nothing is known"):
        pi_for_phase_margin(shaft_plant(J, 0.0, 0.0), 60.0, 1.0, 100.0)


def test_a_loop_that_is_there_is_judged_alike() -> None:
    plant = shaft_plant(J, 0.0, 1e-3)
    calm = figures_of(closed_by(plant, J * 100.0, J * 2000.0), 0.1, 1e4)
    hot = figures_of(closed_by(plant, J * 1500.0, J * 2000.0), 0.1, 1e4)
    assert calm.stands
    assert not hot.stands
    assert hot.margins.phase_margin_deg < PHASE_MARGIN_MIN_DEG < calm.margins.phase_margin_deg
