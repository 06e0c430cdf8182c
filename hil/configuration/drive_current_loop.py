"""The current loop of a bench's drive: its order, how fast it is, and which key of the bench says so.

The bandwidth is where the open loop has gain 1, over 2 pi: of a loop of first order that is its pole.
"""

import math
from dataclasses import dataclass

from design.motor import PmsmParameters
from design.statespace import StateSpace
from hil.configuration.config import BenchConfig
from hil.configuration.config_axis import DriveConfig
from hil.configuration.current_controller_file import CurrentController
from hil.configuration.speed_controller_file import CurrentLoop, MadeFor


@dataclass(frozen=True, slots=True)
class KnownLoop:
    """What is known of a drive's current loop."""

    order: int
    bandwidth_hz: float
    key: str
    """Of the bench file, that says so."""


def current_loop_of(config: BenchConfig, axis: str, *, simulated: bool) -> KnownLoop | None:
    """The loop of an axis' drive; None: nobody has measured it.

    ``simulated``: the bench makes the drive itself, as its file says. Any other drive is known by what
    commissioning measured. The factors that set the simulated motor off from its file are left out: they are
    there to show what a design makes of a motor that it does not know.
    """
    drive, key = config.drive[axis], f"drive.{axis}"
    if simulated:
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
    """The closed loop of i_q with ``controller``, demand to current, and where it crosses over, rad/s."""
    from design.current.current_design import (
        complementary,  # with scipy: for the bench that has such a controller
    )
    from design.hinf.margins import margins
    from design.hinf.mixed_sensitivity import axis_plant
    from design.statespace import series

    plant, designed = axis_plant(motor.resistance_ohm, motor.inductance_q_h), controller.continuous()
    return complementary(plant, designed), margins(series(plant, designed)).phase_margin_rad_s


def certified_loop(wanted: MadeFor) -> CurrentLoop | None:
    """For which loops the certificates hold; None: the file does not name its plant."""
    if wanted.current_loop is not None or wanted.plant is None:
        return wanted.current_loop
    winding_hz = wanted.plant.resistance_ohm / wanted.plant.inductance_q_h / math.tau
    return CurrentLoop(bandwidth_hz=winding_hz, bandwidth_min_hz=winding_hz, bandwidth_max_hz=winding_hz)


def loop_fault(wanted: MadeFor, loop: KnownLoop, made_for_key: str) -> tuple[str, object, str] | None:
    """Key, value and what was expected, where the certificates do not hold for the drive's ``loop``."""
    certified = certified_loop(wanted)
    if certified is None or (loop.order == certified.order and certified.covers(loop.bandwidth_hz)):
        return None
    by = f"for which {made_for_key}.current_loop certifies the controller"
    if wanted.current_loop is None:
        by = f"R/L of the winding, as {made_for_key} names no current_loop"
    found = f"{loop.bandwidth_hz:.5g} Hz" + ("" if loop.order == 1 else f", of order {loop.order}")
    return loop.key, found, f"a loop of first order of {range_text(certified)}, {by}"


def range_text(certified: CurrentLoop) -> str:
    """The bandwidths in words."""
    least_hz, most_hz = certified.bandwidth_min_hz, certified.bandwidth_max_hz
    return f"{least_hz:.5g} Hz and no other" if least_hz == most_hz else f"{least_hz:.5g} to {most_hz:.5g} Hz"
