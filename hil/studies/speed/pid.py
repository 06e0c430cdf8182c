"""``hil design pid``: the rule of :mod:`design.speed.speed_pid` for two files, motor and current control."""

import math
from dataclasses import asdict, dataclass
from typing import Any

from design.motor import PmsmParameters
from design.speed.speed_pid import SpeedPid, first_order_current_loop, pid_by_rule
from design.statespace import StateSpace
from hil.configuration.current_controller_file import CurrentController
from hil.configuration.drive_current_loop import closed_loop
from hil.configuration.toml_text import toml_text
from hil.studies.numbers import finite, short


@dataclass(frozen=True, slots=True)
class PidRequest:
    """What was asked for."""

    motor: PmsmParameters
    current_control: CurrentController | None
    """On the q axis of the drive; None: PI current loops."""
    current_bandwidth_hz: float
    """Of the PI."""
    period_s: float
    latency_s: float
    phase_margin_deg: float
    ratio: float


def design_pid(request: PidRequest) -> SpeedPid:
    """The gains. Raises InfeasibleDesign for a margin that cannot be had."""
    closed, crossover = _current_loop(request)
    return pid_by_rule(
        request.motor,
        closed,
        crossover,
        request.period_s,
        request.latency_s,
        request.phase_margin_deg,
        request.ratio,
    )


def _current_loop(request: PidRequest) -> tuple[StateSpace, float]:
    """The closed loop of i_q and its crossover, rad/s."""
    if request.current_control is not None:
        return closed_loop(request.motor, request.current_control)
    bandwidth = math.tau * request.current_bandwidth_hz
    return first_order_current_loop(bandwidth), bandwidth


def pid_figures(pid: SpeedPid) -> dict[str, Any]:
    """What ``--json`` prints."""
    figures = asdict(pid)
    figures |= figures.pop("margins")
    return {key: finite(value) for key, value in figures.items()}


def controller_text(request: PidRequest, pid: SpeedPid) -> str:
    """A controller file for ``controller = ...`` of a bench; the friction is fed forward."""
    closed, crossover = _current_loop(request)
    table = {
        "kind": "pid",
        "proportional_nm_s_rad": short(pid.proportional_nm_s_rad),
        "integral_nm_rad": short(pid.integral_nm_rad),
        "derivative_nm_s2_rad": short(pid.derivative_nm_s2_rad),
        "derivative_filter_s": pid.derivative_filter_s,
        "feedforward_nm_s_rad": request.motor.viscous_friction_nm_s,
        "made_for": {
            "crossover_rad_s": short(pid.crossover_rad_s),
            "current_loop": {
                "order": closed.order,
                "bandwidth_hz": short(crossover / math.tau),
            },
        },
    }
    return toml_text({"controller": table})
