"""``hil design pid``: inputs of :mod:`servobench.design.speed.speed_pid`, its figures and its file."""

import math
from dataclasses import asdict
from typing import Any

from servobench.design.motor import PmsmParameters
from servobench.design.speed.speed_pid import SpeedPid, first_order_current_loop
from servobench.design.statespace import StateSpace
from servobench.hil.configuration.controller_files import CurrentController
from servobench.hil.configuration.controller_kinds import PidController, TunedFor
from servobench.hil.configuration.drive_current_loop import closed_loop
from servobench.hil.configuration.drive_file import LoopOfDrive
from servobench.hil.studies.numbers import finite, short


def current_loop_of(
    motor: PmsmParameters, controller: CurrentController | None, bandwidth_hz: float
) -> tuple[StateSpace, float]:
    """Return the closed loop of i_q and its crossover, rad/s; without a ``controller`` that of PI current
    loops."""
    if controller is not None:
        return closed_loop(motor, controller)
    bandwidth = math.tau * bandwidth_hz
    return first_order_current_loop(bandwidth), bandwidth


def pid_figures(pid: SpeedPid) -> dict[str, Any]:
    """Return the figures for ``--json``."""
    figures = asdict(pid)
    figures |= figures.pop("margins")
    if pid.resonance_hz is None:
        del figures["resonance_hz"]
    return {key: finite(value) for key, value in figures.items()}


def controller_of(motor: PmsmParameters, order: int, crossover_rad_s: float, pid: SpeedPid) -> PidController:
    """Return the table [controller]; the friction is fed forward. ``order``, crossover: of the current
    loop."""
    return PidController(
        kind="pid",
        proportional_nm_s_rad=short(pid.proportional_nm_s_rad),
        integral_nm_rad=short(pid.integral_nm_rad),
        derivative_nm_s2_rad=short(pid.derivative_nm_s2_rad),
        derivative_filter_s=pid.derivative_filter_s,
        feedforward_nm_s_rad=motor.viscous_friction_nm_s,
        made_for=TunedFor(
            crossover_rad_s=short(pid.crossover_rad_s),
            current_loop=LoopOfDrive(order=order, bandwidth_hz=short(crossover_rad_s / math.tau)),
        ),
    )
