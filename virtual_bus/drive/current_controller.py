"""A current controller in state space, put into the arrays of the compiled kernel."""

import numpy as np
import scipy  # loads scipy.linalg when it is used first

from design.statespace import StateSpace
from virtual_bus.drive import motor_kernel as kernel
from virtual_bus.drive.motor_kernel import FloatArray

_NONE = -1.0
"""In the place of an order: this axis keeps its PI."""


def check_controller(controller: StateSpace | None, inner_rate_hz: int) -> None:
    """Error: ValueError for a controller that the kernel cannot run at ``inner_rate_hz``."""
    if controller is None:
        return
    if controller.D.shape != (1, 1) or controller.order > kernel.CONTROLLER_ORDER_MAX:
        raise ValueError(
            f"a current controller with {controller.order} states and gains {controller.D.shape}: one input, "
            f"one output and at most {kernel.CONTROLLER_ORDER_MAX} states expected"
        )
    if controller.period_s is None or abs(controller.period_s * inner_rate_hz - 1.0) > 1e-9:
        raise ValueError(f"a current controller sampled at the inner rate, {inner_rate_hz} Hz, is expected")


def fill_controllers(p: FloatArray, d_axis: StateSpace | None, q_axis: StateSpace | None) -> None:
    """Write both axes' controllers into ``p``, (PARAMETERS_SIZE,); None keeps the PI."""
    p[kernel.P_CONTROLLERS] = float(d_axis is not None or q_axis is not None)
    for at, controller in ((kernel.P_CONTROLLER_D, d_axis), (kernel.P_CONTROLLER_Q, q_axis)):
        p[at] = _NONE
        if controller is not None:
            _fill(p, at, controller)


def _fill(p: FloatArray, at: int, controller: StateSpace) -> None:
    n, most = controller.order, kernel.CONTROLLER_ORDER_MAX
    p[at], p[at + 1] = n, controller.D[0, 0]
    places = p[at + 2 : at + kernel.CONTROLLER_SIZE].reshape(most + 3, most)
    places[:n, :n] = controller.A
    places[most, :n] = controller.B[:, 0]
    places[most + 1, :n] = controller.C[0]
    places[most + 2, :n] = take_back_gain(controller)[:, 0]


def take_back_gain(controller: StateSpace) -> FloatArray:
    """L (n, 1): x = A x + B e + L (v_out - v) keeps the state where its output is what really goes out.

    L is the observer gain of (A, C) that balances what the error drives, B B', against D^2: without a limit
    it does nothing, under one the state follows A - L C, which is stable.
    """
    n = controller.order
    if not n:
        return np.zeros((0, 1))
    a, c = controller.A, controller.C
    noise = max(float(controller.D[0, 0]) ** 2, float((c @ controller.B)[0, 0]) ** 2, 1e-12)
    p = scipy.linalg.solve_discrete_are(a.T, c.T, controller.B @ controller.B.T, np.array([[noise]]))
    return np.asarray(a @ p @ c.T / (c @ p @ c.T + noise), dtype=float)
