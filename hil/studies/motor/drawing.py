"""Draws what a motor file means: torque over speed, saturation, friction, the coupling's frequency response,
cogging."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from servobench.design.field import weakened_speed, weakened_torque_limit
from servobench.design.mechanism import Coupling, cogging_nm, friction_nm, speed_responses
from servobench.design.motor import PmsmParameters, speed_limit, torque_limit
from servobench.drivers.rotation import RAD_S_PER_RPM, RPM_PER_RAD_S
from servobench.hil.studies.drawing import picture
from servobench.virtual_bus.drive.mechanism import NO_FIELD, FieldOptions

_PANEL = (7.0, 4.2)
"""Width and height of each, inches."""
_FRICTION_SPEEDS = 8.0
"""The friction map reaches to so many times the Stribeck speed."""


def draw_motor(motor: PmsmParameters, path: Path, field: FieldOptions = NO_FIELD) -> None:
    """One panel below the other, of what the motor has; :mod:`servobench.hil.studies.drawing` for errors.

    ``field``: what its drive does besides a d current of zero.
    """
    panels: list[Callable[[Any, PmsmParameters], None]] = [partial(_draw_torque, field=field)]
    panels += [_draw_iron] if motor.iron is not None else []
    mechanism = motor.mechanism
    if mechanism is not None:
        panels += [_draw_friction] if mechanism.friction is not None else []
        panels += [_draw_responses] if mechanism.coupling is not None else []
        panels += [_draw_cogging] if mechanism.cogging or mechanism.cogging_points_nm else []
    size = (_PANEL[0], _PANEL[1] * len(panels))
    with picture(path, rows=len(panels), size=size, asked_by="--picture", squeeze=False) as axes:
        for axis, panel in zip(axes[:, 0], panels, strict=True):
            panel(axis, motor)
        axes[0, 0].set_title(motor.name)


def _draw_torque(axes: Any, motor: PmsmParameters, field: FieldOptions) -> None:
    speed = np.linspace(0.0, 1.02 * speed_limit(motor, 0.0), 600)
    axes.plot(speed * RPM_PER_RAD_S, torque_limit(motor, speed), label="peak, i_d = 0")
    if field.voltage_share:
        weaker = replace(motor, dc_bus_voltage_v=field.voltage_share * motor.dc_bus_voltage_v)
        speed = np.linspace(0.0, 1.02 * weakened_speed(weaker), 300)
        limit = weakened_torque_limit(weaker, speed)
        if not field.least_current:
            limit = np.minimum(limit, motor.torque_max_nm)
        axes.plot(speed * RPM_PER_RAD_S, limit, label="peak, weakened field")
    axes.axhline(motor.rated_torque_nm, color="0.5", linestyle="--", label="rated torque")
    axes.plot(motor.rated_speed_rad_s * RPM_PER_RAD_S, motor.rated_torque_nm, "o", label="rated point")
    link = f"speed, r/min (link at {motor.dc_bus_voltage_v:g} V)"
    axes.set(xlabel=link, ylabel="torque, N m", xlim=(0, None), ylim=(0, None))
    axes.legend(frameon=False)


def _draw_iron(axes: Any, motor: PmsmParameters) -> None:
    assert motor.iron is not None
    current = np.linspace(0.0, motor.current_max_a, 300)
    made = [motor.iron.fluxes(0.0, float(each))[0] / motor.flux_linkage_wb for each in current]
    linear = motor.torque_constant_nm_a * current
    axes.plot(current, linear, ":", label="as the drive believes")
    axes.plot(current, linear * np.asarray(made), label="made")
    axes.set(xlabel="q current, dq A", ylabel="torque, N m", xlim=(0, None), ylim=(0, None))
    axes.legend(frameon=False)


def _draw_friction(axes: Any, motor: PmsmParameters) -> None:
    assert motor.mechanism is not None
    friction = motor.mechanism.friction
    assert friction is not None
    end = _FRICTION_SPEEDS * friction.stribeck_rad_s
    for way, name in ((1.0, "forward"), (-1.0, "backward")):
        speed = way * np.linspace(0.0, end, 400)[1:]
        torque = friction_nm(friction, motor.coulomb_friction_nm, motor.viscous_friction_nm_s, speed)
        axes.plot(speed * RPM_PER_RAD_S, torque, label=name)
    for sign in (1.0, -1.0):
        axes.axhline(sign * friction.breakaway_nm, color="0.5", linestyle="--", linewidth=0.8)
    axes.set(
        xlabel=f"speed of the {friction.side.value}, r/min", ylabel="friction, N m (dashed: a start takes it)"
    )
    axes.legend(frameon=False)


def _draw_responses(axes: Any, motor: PmsmParameters) -> None:
    assert motor.mechanism is not None
    coupling = motor.mechanism.coupling
    assert coupling is not None
    hertz = _frequencies(coupling)
    on_motor, on_load = speed_responses(coupling, hertz)
    rigid = 1.0 / (math.tau * hertz * motor.inertia_kg_m2)
    for gain, name, style in (
        (np.abs(on_motor), "motor", "-"),
        (np.abs(on_load), "load", "-"),
        (rigid, "rigid shaft", ":"),
    ):
        axes.loglog(hertz, gain / RAD_S_PER_RPM, style, label=name)
    for at_hz, name in ((coupling.antiresonance_hz, "antiresonance"), (coupling.resonance_hz, "resonance")):
        axes.axvline(at_hz, color="0.5", linestyle="--", linewidth=0.8)
        axes.annotate(
            f"{name} {at_hz:.3g} Hz", (at_hz, 0.02), xycoords=("data", "axes fraction"), rotation=90
        )
    axes.set(xlabel="frequency, Hz", ylabel="speed over torque, r/min per N m")
    axes.legend(frameon=False)


def _frequencies(coupling: Coupling) -> Any:
    """Both resonances among them, whose peaks are narrow."""
    low, high = 0.1 * coupling.antiresonance_hz, 10.0 * coupling.resonance_hz
    found = np.geomspace(low, high, 1200)
    return np.unique(np.append(found, [coupling.antiresonance_hz, coupling.resonance_hz]))


def _draw_cogging(axes: Any, motor: PmsmParameters) -> None:
    assert motor.mechanism is not None
    periods = math.gcd(*(each.per_turn for each in motor.mechanism.cogging)) or 1
    angle = np.linspace(0.0, math.tau / periods, 600)
    axes.plot(np.degrees(angle), cogging_nm(motor.mechanism, angle))
    axes.set(xlabel=f"angle of the rotor, degrees ({periods} times a turn)", ylabel="cogging, N m")
