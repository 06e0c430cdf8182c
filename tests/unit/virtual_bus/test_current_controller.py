"""Current controllers in state space inside the compiled firmware."""

from dataclasses import replace

import numpy as np
import pytest

from servobench.design.current.current_loop import held
from servobench.design.papers.azaiz2007 import MOTOR, paper_design
from servobench.design.statespace import StateSpace, connect, series, tustin
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.drive.current_controller import take_back_gain
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl

RATE_HZ = 16_000
K_Q = tustin(paper_design("q")[1].controller, RATE_HZ, 145.0)
K_D = tustin(paper_design("d")[1].controller, RATE_HZ, 61.0)
HEAVY = replace(MOTOR, inertia_kg_m2=1e3)
"""Its shaft stands still, so the two axes are apart."""


def _currents(parameters: FirmwareParameters, torque_nm: float, ticks: int) -> np.ndarray:
    firmware = Firmware(HEAVY, parameters)
    firmware.start(Instant(0))
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(torque_nm)
    seen = []
    for tick in range(1, ticks + 1):
        firmware.advance_to(Instant(-(-tick * 1_000_000_000 // RATE_HZ)))
        seen.append(float(firmware.inner.current_q_a))
    return np.array(seen)


def test_the_step_of_i_q_is_that_of_the_sampled_loop() -> None:
    """The loop of the plant behind a hold, one period of computation, and K_q."""
    current = 2.0
    seen = _currents(FirmwareParameters(controller_q=K_Q, controller_d=K_D), current * 0.72, 400)
    loop = connect(series(held(paper_design("q")[0].plant, RATE_HZ, 1), K_Q), [[-1.0]], [[1.0]], [[1.0]])
    state, wanted = np.zeros(loop.order), []
    for _ in range(400):
        wanted.append(float((loop.C @ state)[0]))
        state = loop.A @ state + loop.B[:, 0] * current
    # tick 1 samples first: the plant has then seen no voltage for one period
    assert seen == pytest.approx(np.array(wanted), abs=2e-3)
    assert seen[-1] == pytest.approx(current, rel=0.03)


def test_an_axis_without_a_controller_keeps_its_pi() -> None:
    plain = _currents(FirmwareParameters(), 1.0, 100)
    assert _currents(FirmwareParameters(controller_d=K_D), 1.0, 100) == pytest.approx(plain, abs=1e-6)
    own = _currents(FirmwareParameters(controller_q=K_Q), 1.0, 100)
    assert np.abs(own - plain).max() > 0.1


def test_the_voltage_limit_winds_nothing_up() -> None:
    """With 6 V the current ends at some 5.8 A; released, it must come down at once and not ring."""
    weak = replace(HEAVY, dc_bus_voltage_v=6.0)
    firmware = Firmware(weak, FirmwareParameters(controller_q=K_Q, controller_d=K_D))
    firmware.start(Instant(0))
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(14.0)
    firmware.advance_to(Instant(300_000_000))
    assert firmware.inner.current_q_a == pytest.approx(weak.voltage_max_v / 0.6, rel=0.02)
    firmware.demand_torque(0.72)
    firmware.advance_to(Instant(340_000_000))
    assert firmware.inner.current_q_a == pytest.approx(1.0, abs=0.1)


def test_the_take_back_gain_leaves_stable_states() -> None:
    for controller in (K_D, K_Q):
        left = controller.A - take_back_gain(controller) @ controller.C
        assert np.abs(np.linalg.eigvals(left)).max() < 1.0


def test_the_turning_motor_may_differ_from_the_one_set() -> None:
    nominal = _currents(FirmwareParameters(controller_q=K_Q), 1.0, 50)
    varied = _currents(FirmwareParameters(controller_q=K_Q, inductance_factor=1.5), 1.0, 50)
    assert np.all(varied[5:] < nominal[5:])


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (tustin(paper_design("q")[1].controller, 8000.0), "inner rate"),
        (paper_design("q")[1].controller, "inner rate"),
        (
            StateSpace(np.eye(9), np.ones((9, 1)), np.ones((1, 9)), np.eye(1), 1 / RATE_HZ),
            "at most 8",
        ),
    ],
)
def test_what_the_kernel_cannot_run_is_refused(controller: StateSpace, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FirmwareParameters(controller_q=controller)
