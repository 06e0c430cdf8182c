"""A current controller in state space, given to the inner loops of the core.

How fast the simulated drive's current loops are if nothing else is asked for.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.design.statespace import StateSpace
from servobench.virtual_bus.core.native import InnerLoops

CONTROLLER_ORDER_MAX: Final = 8
"""Limit in core/inner_loops.h."""


def check_controller(controller: StateSpace | None, inner_rate_hz: int) -> None:
    """Error: ValueError for a controller that the inner loops cannot run at ``inner_rate_hz``."""
    if controller is None:
        return
    if controller.D.shape != (1, 1) or controller.order > CONTROLLER_ORDER_MAX:
        raise ValueError(
            f"a current controller with {controller.order} states and gains {controller.D.shape}: one input, "
            f"one output and at most {CONTROLLER_ORDER_MAX} states expected"
        )
    if controller.period_s is None or abs(controller.period_s * inner_rate_hz - 1.0) > 1e-9:
        raise ValueError(f"a current controller sampled at the inner rate, {inner_rate_hz} Hz, is expected")


def fill_controllers(inner: InnerLoops, d_axis: StateSpace | None, q_axis: StateSpace | None) -> None:
    """Give ``inner`` both axes' controllers; None keeps the PI."""
    for axis, controller in enumerate((d_axis, q_axis)):
        if controller is not None:
            parts = (controller.D, controller.A, controller.B, controller.C, take_back_gain(controller))
            values = np.concatenate([np.ravel(part) for part in parts])
            inner.set_controller(axis, controller.order, values.tobytes())


def take_back_gain(controller: StateSpace) -> NDArray[np.float64]:
    """L (n, 1): x = A x + B e + L (v_out - v) keeps the state where its output is what really goes out.

    L is the observer gain of (A, C) that balances what the error drives, B B', against D^2: without a limit
    it does nothing, under one the state follows A - L C, which is stable.
    """
    n = controller.order
    if not n:
        return np.zeros((0, 1))
    from scipy.linalg import solve_discrete_are  # an extra that other runs do without

    a, c = controller.A, controller.C
    noise = max(float(controller.D[0, 0]) ** 2, float((c @ controller.B)[0, 0]) ** 2, 1e-12)
    p = solve_discrete_are(a.T, c.T, controller.B @ controller.B.T, np.array([[noise]]))
    return np.asarray(a @ p @ c.T / (c @ p @ c.T + noise), dtype=float)


INNER_RATE_OVER_BANDWIDTH: Final = 20
"""PI loops that sample twenty times faster than their bandwidth, with 1.5 periods of delay, keep a phase
margin of 90 - 360 * 1.5 / 20 = 63 degrees."""


def current_bandwidth_hz(asked_hz: float | None, inner_rate_hz: int) -> float:
    """Return the bandwidth of the PI current loops, Hz; ``asked_hz`` None: default for ``inner_rate_hz``."""
    return inner_rate_hz / INNER_RATE_OVER_BANDWIDTH if asked_hz is None else asked_hz
