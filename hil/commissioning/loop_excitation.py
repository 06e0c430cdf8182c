"""Turns the shaft by a drive's own speed loop, with sines on its set-point.

It turns one way, so that friction does not change its sign, and swings by sines that no limit of speed,
torque or acceleration cuts.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.commissioning.excitation import frequency_response, lines_hz, multisine
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.findings import refuse_losses
from servobench.hil.commissioning.identify import Array
from servobench.hil.commissioning.loop_response import BLOCKS, Excited, Gains, NotFound
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_mechanics import ramp_time
from servobench.hil.loop.scenario import Ramp

_BLOCK_S: Final = 0.5
"""A period of the sines: their frequencies are whole multiples of 2 Hz."""
_SETTLED_S: Final = 0.7
"""From the end of the ramp until the first block."""
_LOWEST_HZ: Final = 4.0
_HIGHEST: Final = 0.25
"""Share of the sampling rate: above it the set-point's corners swing the torque as much as its sines do."""
_LINES: Final = 28
_EVEN_HZ: Final = 20.0
"""Above it sines of less speed: all take the same torque to turn the inertia."""
_BASE_SHARE: Final = 0.5
"""Share of the speed limit at which the shaft turns."""
_PART_OF_TURN: Final = 0.381966
"""A block ends this far in a turn: the steps of an encoder and the teeth of a motor, which come again each
turn, then are noise that the mean over blocks takes out, and no line of each block. A golden section, so that
no few blocks are whole turns together."""
_SPEED_SHARE: Final = 0.5
"""Share of the base speed in which the sines are."""
_TORQUE_SHARE: Final = 0.4
"""Share of the torque that friction leaves."""
_STEEP_SHARE: Final = 0.5
"""Share of the acceleration limit."""
_TRAVEL_SHARE: Final = 0.8


def excite(session: Session, gains: Gains, way: float = 1.0) -> Excited:
    """Turn the shaft with sines on its speed, forwards or (``way`` = -1) backwards.

    Raises NotFound, StepFailed for lost readings, or a fault of the drive.
    """
    limits, period_s = session.limits, session.found.period / NS_PER_S
    sines_s = BLOCKS * _BLOCK_S + 0.2
    base = _BASE_SHARE * limits.speed_rad_s
    over = max(0.3, ramp_time(session, base))
    base = min(base, _TRAVEL_SHARE * limits.travel_rad / (0.5 * over + _SETTLED_S + sines_s))
    turns = base * _BLOCK_S / math.tau
    if turns > 1.0:
        base *= (math.floor(turns - _PART_OF_TURN) + _PART_OF_TURN) / turns
    lines = lines_hz(_LOWEST_HZ, _HIGHEST / period_s, _LINES, _BLOCK_S)
    added = _sines(session, gains, lines, base)
    start = over + _SETTLED_S
    with session.exercising(replace(limits, power_w=math.inf, energy_j=math.inf)) as exerciser:
        recording = exerciser.run_speeds(
            start + sines_s,
            [Ramp(0.0, way * base, over)],
            added=lambda time: added(time) if time >= over else 0.0,
        )
    refuse_losses(recording.lost, recording.cycles)
    try:
        return session.meanwhile(_responses, recording, lines, gains, period_s, start)
    except ValueError as error:
        raise NotFound(str(error)) from error


def _responses(recording: Recording, lines: Array, gains: Gains, period_s: float, skip_s: float) -> Excited:
    time, given = recording.time, recording.speed_given
    told = frequency_response(time, given, recording.velocity, lines, _BLOCK_S, period_s, skip_s)
    grid = np.arange(time[0], time[-1], period_s)
    speed = np.diff(np.interp(grid, time, recording.position)) / period_s
    s = 2j * math.pi * lines
    made = frequency_response(
        grid[1:], np.interp(grid[1:], time, given), speed, lines, _BLOCK_S, period_s, skip_s
    )
    differenced = (1.0 - np.exp(-s * period_s)) / (s * period_s)
    return Excited(told, replace(made, response=made.response / differenced), gains)


def _sines(session: Session, gains: Gains, lines: Array, base: float) -> Callable[[float], float]:
    """Return sines as large as speed, torque and acceleration leave room for."""
    limits, mechanics = session.limits, session.mechanics
    weights = np.minimum(1.0, _EVEN_HZ / lines)
    seed = session.request.node
    unit = multisine(lines, 1.0, seed, weights)
    step_s = 1.0 / (8.0 * float(lines[-1]))
    count = round(_BLOCK_S / step_s)
    spectrum = np.fft.rfft([unit(k * _BLOCK_S / count) for k in range(count)])
    omega = np.asarray(math.tau * np.arange(len(spectrum)) / _BLOCK_S, dtype=float)
    torque = spectrum.copy()
    torque[1:] *= gains.response(omega[1:]) + 1j * omega[1:] * mechanics.inertia_kg_m2
    steepest = float(np.abs(np.fft.irfft(1j * omega * spectrum, count)).max())
    strongest = float(np.abs(np.fft.irfft(torque, count)).max())
    left_nm = max(0.1 * limits.torque_nm, limits.torque_nm - abs(mechanics.friction_nm(base)))
    amplitude = min(
        _SPEED_SHARE * base,
        _TORQUE_SHARE * left_nm / strongest,
        _STEEP_SHARE * limits.acceleration_rad_s2 / steepest,
    )
    return multisine(lines, amplitude, seed, weights)
