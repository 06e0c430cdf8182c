"""The current loop of a bench's drive: its order, its bandwidth, the key that states it, and whether it
matches the one that the controller was made for.

The bandwidth is where the open loop has gain 1, over 2 pi: of a loop of first order that is its pole.
"""

import math
from dataclasses import dataclass
from typing import Final

from servobench.design.motor import PmsmParameters
from servobench.design.statespace import StateSpace
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.controller_files import CurrentController, CurrentLoop, MadeFor
from servobench.hil.configuration.controller_kinds import PidController

_PHASE_LOST_DEG: Final = 5.0
"""Phase loss, against the rule's margin of 50 degrees, from which the response to a load step changes
visibly."""
_CASCADE: Final = 5.0
"""Least ratio of inner bandwidth to outer crossover: the inner loop then costs 11 degrees there."""
_LOWEST_RAD_S, _HIGHEST_RAD_S, _BISECTIONS = 1e-3, 1e6, 60
"""Nine decades halved so often are narrower than the last bit of a double."""


@dataclass(frozen=True, slots=True)
class KnownLoop:
    """Known data of a drive's current loop."""

    order: int
    bandwidth_hz: float
    key: str
    """The key of the bench file that states it."""


def current_loop_of(config: BenchConfig, axis: str) -> KnownLoop | None:
    """Return the loop of an axis' drive; None: not measured.

    A simulated drive follows the bench file, any other one the measurements of commissioning. The factors
    between the simulated motor and its file are ignored: they show how a design copes with an unknown motor.
    """
    drive, key = config.drive[axis], f"drive.{axis}"
    if config.simulated:
        return _simulated(drive, key)
    measured = None if drive.commissioned is None else drive.commissioned.current_loop
    if measured is None:
        return None
    return KnownLoop(measured.order, measured.bandwidth_hz, f"{key}.commissioned.current_loop.bandwidth_hz")


def _simulated(drive: DriveConfig, key: str) -> KnownLoop:
    controller = drive.current_control.controller
    if controller is not None:
        _, crossover_rad_s = closed_loop(drive.motor.parameters, controller)
        order = 1 + controller.continuous().order
        return KnownLoop(order, crossover_rad_s / math.tau, f"{key}.current_control.controller")
    simulation = drive.simulation
    said = "inner_rate_hz" if simulation.current_bandwidth_hz is None else "current_bandwidth_hz"
    return KnownLoop(1, simulation.current_loop_hz, f"{key}.simulation.{said}")


def closed_loop(motor: PmsmParameters, controller: CurrentController) -> tuple[StateSpace, float]:
    """Return the closed loop of i_q with ``controller``, demand to current, and its crossover, rad/s."""
    from servobench.design.current.current_design import (
        complementary,  # with scipy: for the bench that has such a controller
    )
    from servobench.design.hinf.margins import margins
    from servobench.design.hinf.mixed_sensitivity import axis_plant
    from servobench.design.statespace import series

    plant, designed = axis_plant(motor.resistance_ohm, motor.inductance_q_h), controller.continuous()
    return complementary(plant, designed), margins(series(plant, designed)).phase_margin_rad_s


def certified_loop(made_for: MadeFor) -> CurrentLoop | None:
    """Return the loops for which the certificates hold; None: the file does not name its plant."""
    if made_for.current_loop is not None or made_for.plant is None:
        return made_for.current_loop
    winding_hz = made_for.plant.resistance_ohm / made_for.plant.inductance_q_h / math.tau
    return CurrentLoop(bandwidth_hz=winding_hz, bandwidth_min_hz=winding_hz, bandwidth_max_hz=winding_hz)


def loop_fault(made_for: MadeFor, loop: KnownLoop, made_for_key: str) -> tuple[str, object, str] | None:
    """Return key, value and expectation if the certificates do not hold for the drive's ``loop``."""
    certified = certified_loop(made_for)
    if certified is None or (loop.order == certified.order and certified.covers(loop.bandwidth_hz)):
        return None
    by = f"for which {made_for_key}.current_loop certifies the controller"
    if made_for.current_loop is None:
        by = f"R/L of the winding, as {made_for_key} names no current_loop"
    own = f"{loop.bandwidth_hz:.5g} Hz" + ("" if loop.order == 1 else f", of order {loop.order}")
    return loop.key, own, f"a loop of first order of {range_text(certified)}, {by}"


def range_text(certified: CurrentLoop) -> str:
    """Give the bandwidths in words."""
    least_hz, most_hz = certified.bandwidth_min_hz, certified.bandwidth_max_hz
    return f"{least_hz:.5g} Hz and no other" if least_hz == most_hz else f"{least_hz:.5g} to {most_hz:.5g} Hz"


def slow_for_pid(own: KnownLoop, pid: PidController, motor: PmsmParameters) -> str:
    """Explain why a drive's current loop is too slow for the PID around it; empty if it is not.

    A PID has no certificate. Before the run only the phase lost at its crossover to a slower current loop is
    known; if its file does not say what it was tuned for, the rule of cascaded loops applies.
    """
    that = f"that of this drive has {own.bandwidth_hz:.4g} Hz ({own.key})"
    own_rad_s = math.tau * own.bandwidth_hz
    if pid.made_for is None:
        crossover = crossover_rad_s(pid, motor)
        if own_rad_s >= _CASCADE * crossover:
            return ""
        needed_hz = _CASCADE * crossover / math.tau
        return (
            f"its PID crosses over at {crossover:.4g} rad/s, which asks for a current loop of "
            f"{needed_hz:.4g} Hz or more, five times as fast; {that}"
        )
    crossover, made_hz = pid.made_for.crossover_rad_s, pid.made_for.current_loop.bandwidth_hz
    lost_deg = math.degrees(math.atan(crossover / own_rad_s) - math.atan(crossover / (math.tau * made_hz)))
    if lost_deg < _PHASE_LOST_DEG:
        return ""
    return (
        f"its PID crosses over at {crossover:.4g} rad/s, tuned for a current loop of {made_hz:.4g} Hz; "
        f"{that}, which takes about {lost_deg:.0f} degrees from its phase margin"
    )


def crossover_rad_s(pid: PidController, motor: PmsmParameters) -> float:
    """Return the highest frequency at which PID and shaft have gain 1, without current loop and delays."""

    def gain(omega: float) -> float:
        s = 1j * omega
        derivative = pid.derivative_nm_s2_rad * s / (1.0 + pid.derivative_filter_s * s)
        shaft = motor.inertia_kg_m2 * s + motor.viscous_friction_nm_s
        return abs((pid.proportional_nm_s_rad + pid.integral_nm_rad / s + derivative) / shaft)

    low, high = math.log(_LOWEST_RAD_S), math.log(_HIGHEST_RAD_S)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if gain(math.exp(middle)) > 1.0 else (low, middle)
    return math.exp(low)
