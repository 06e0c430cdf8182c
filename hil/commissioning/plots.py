"""Plots for a commissioning report, and the torque that they show against the angle of the shaft.

Torque against the angle of the shaft: cogging, and friction that varies over a turn.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.hil.commissioning.excitation import ComplexArray, FrequencyResponse, StepLag
from servobench.hil.commissioning.exercise import Recording, smooth_speed
from servobench.hil.commissioning.identify import Array, Mechanics

_BINS: Final = 72
"""Bins of 5 degrees: twelve for a period of the sixth harmonic."""
_SMOOTHED: Final = 9
"""Samples of the line by which the speed is smoothed."""
_REACH_RAD: Final = 0.5
"""Span of those samples: half a period of the sixth harmonic, beyond which smoothing levels it."""
_FEWEST: Final = 5
"""Samples in a bin, for a mean with a scatter."""


class TorqueByAngle(NamedTuple):
    """Means over bins of the angle; NaN where too few samples fell."""

    angle_rad: Array
    """(72,) middle of each bin, from the drive's zero of position."""
    forward_nm: Array
    """(72,) torque beyond inertia and identified friction, turning towards positive positions."""
    backward_nm: Array
    error_nm: float
    """Standard error of a bin, root mean square."""

    @property
    def ripple_nm(self) -> float | None:
        """Half of peak to peak of the mean of both directions; None where bins are empty."""
        both = 0.5 * (self.forward_nm + self.backward_nm)
        return None if np.isnan(both).any() else float(np.ptp(both)) / 2.0


def torque_by_angle(recordings: Sequence[Recording], mechanics: Mechanics) -> TorqueByAngle:
    """Return the remaining torque by angle, from samples slow enough to know their acceleration."""
    samples = [np.zeros((3, 0))]
    for recording in recordings:
        if len(recording.time) <= _SMOOTHED:
            continue
        speed = recording.speed
        acceleration = smooth_speed(recording.time, speed)
        step = float(np.median(np.diff(recording.time)))
        slow = (np.abs(speed) * _SMOOTHED * step < _REACH_RAD) & (np.abs(speed) * _SMOOTHED * step > 0.01)
        sign = np.sign(speed)
        friction = (
            mechanics.viscous_friction_nm_s * speed
            + mechanics.coulomb_friction_nm * sign
            + mechanics.offset_nm
        )
        left = recording.torque - mechanics.inertia_kg_m2 * acceleration - friction
        samples.append(np.array([np.mod(recording.position, 2.0 * np.pi), left, sign])[:, slow])
    angle, torque, direction = np.concatenate(samples, axis=1)
    place = np.minimum(_BINS - 1, (angle / (2.0 * np.pi) * _BINS).astype(int))
    means, errors = [], []
    for way in (1.0, -1.0):
        parts = [torque[(place == number) & (direction == way)] for number in range(_BINS)]
        means.append(np.array([part.mean() if len(part) >= _FEWEST else np.nan for part in parts]))
        errors += [part.var(ddof=1) / len(part) for part in parts if len(part) >= _FEWEST]
    middle = (np.arange(_BINS) + 0.5) * 2.0 * np.pi / _BINS
    error = float(np.sqrt(np.mean(errors))) if errors else float("nan")
    return TorqueByAngle(middle, means[0], means[1], error)


_BLUE, _RED, _GREY = "#1f5fa8", "#c8442c", "#8a8f98"


@contextmanager
def _figure(path: Path, rows: int, height: float, **options: Any) -> Iterator[list[Any]]:
    """Yield axes one below the other; the picture is written afterwards."""
    figure = Figure(figsize=(8.0, height), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, 1, **options))
    for ax in axes:
        ax.grid(color="#e3e6ea", linewidth=0.6)
        ax.spines[["top", "right"]].set_visible(False)
    yield list(axes)
    figure.savefig(path, dpi=110)


def draw_mechanics(path: Path, recordings: Sequence[Recording], mechanics: Mechanics) -> None:
    """Plot speed over time, and the torque that the fit leaves for friction over speed."""
    with _figure(path, 2, 7.0) as (above, below):
        begin = 0.0
        for recording in recordings:
            above.plot(begin + recording.time, recording.speed * RPM_PER_RAD_S, color=_BLUE, linewidth=1.0)
            begin += float(recording.time[-1]) + 0.2
        above.set(xlabel="time, s (one exercise after the other)", ylabel="speed, r/min")
        top = 0.0
        for recording in recordings:
            speed = recording.speed
            acceleration = np.gradient(speed, recording.time)
            kernel = np.ones(25) / 25.0
            friction = np.convolve(recording.torque - mechanics.inertia_kg_m2 * acceleration, kernel, "same")
            below.plot(speed * RPM_PER_RAD_S, friction, ".", color=_GREY, markersize=1.5, alpha=0.5)
            top = max(top, float(np.abs(speed).max()))
        speeds = np.linspace(-top, top, 401)
        line = [mechanics.friction_nm(float(speed)) + mechanics.offset_nm for speed in speeds]
        below.plot(speeds * RPM_PER_RAD_S, line, color=_RED, linewidth=1.5, label="identified friction")
        peak = 3.0 * max(abs(value) for value in line) + 1e-12
        below.set(xlabel="speed, r/min", ylabel="torque less inertia, N m", ylim=(-peak, peak))
        below.legend(frameon=False)


def draw_angle(path: Path, by_angle: TorqueByAngle) -> None:
    """Plot the torque beyond inertia and friction over the angle, each way."""
    with _figure(path, 1, 4.5) as (ax,):
        degrees = np.degrees(by_angle.angle_rad)
        ax.plot(degrees, by_angle.forward_nm, color=_BLUE, linewidth=1.2, label="forwards")
        ax.plot(degrees, by_angle.backward_nm, color=_RED, linewidth=1.2, label="backwards")
        ax.set(xlabel="angle of the shaft, degrees", ylabel="torque less inertia and friction, N m")
        ax.set(xlim=(0.0, 360.0), title=f"standard error of a point {by_angle.error_nm:.2g} N m")
        ax.legend(frameon=False)


def draw_current(path: Path, current: Array, torque: Array, slope: float, offset: float) -> None:
    """Plot torque over current with the line through it."""
    with _figure(path, 1, 4.5) as (ax,):
        ax.plot(current, torque, ".", color=_GREY, markersize=2)
        ends = np.array([current.min(), current.max()])
        ax.plot(ends, slope * ends + offset, color=_RED, linewidth=1.5, label=f"{slope:.4g} N m/A")
        ax.set(xlabel="current 6078h, A rms", ylabel="torque 6077h, N m")
        ax.legend(frameon=False)


def draw_response(path: Path, response: FrequencyResponse, model: ComplexArray) -> None:
    """Plot magnitude, phase and coherence of torque to speed, with the identified inertia and friction."""
    frequency = response.frequency_hz
    with _figure(path, 3, 9.0, sharex=True) as (magnitude, phase, coherence):
        magnitude.loglog(
            frequency, np.abs(response.response), "o", color=_BLUE, markersize=3, label="measured"
        )
        magnitude.loglog(frequency, np.abs(model), color=_RED, linewidth=1.2, label="1/(J s + B)")
        magnitude.set(ylabel="speed / torque, rad/s per N m")
        magnitude.legend(frameon=False)
        phase.semilogx(
            frequency, np.degrees(np.unwrap(np.angle(response.response))), "o", color=_BLUE, markersize=3
        )
        phase.semilogx(frequency, np.degrees(np.unwrap(np.angle(model))), color=_RED, linewidth=1.2)
        phase.set(ylabel="phase, degrees")
        coherence.semilogx(frequency, response.coherence, "o", color=_BLUE, markersize=3)
        coherence.set(ylabel="coherence", xlabel="frequency, Hz", ylim=(0.0, 1.05))


def draw_delays(path: Path, readings_us: Array, age_us: Array, part: Array, lag: StepLag) -> None:
    """Plot a histogram of the readings' delay, and the response to a step of the command."""
    with _figure(path, 2, 7.0) as (above, below):
        above.hist(readings_us, bins=60, color=_BLUE)
        above.set(xlabel="from SYNC to reading, us", ylabel="readings")
        below.plot(age_us, part, ".", color=_GREY, markersize=2)
        below.axvline(lag.half_us, color=_RED, linewidth=1.2, label=f"half after {lag.half_us:.0f} us")
        below.set(xlabel="age of the command at the sample, us", ylabel="part of the step", ylim=(-0.3, 1.4))
        below.legend(frameon=False)


def draw_verification(path: Path, recording: Recording, time: Array, reference: Array) -> None:
    """Plot speed with its reference, and the torque."""
    with _figure(path, 2, 7.0, sharex=True) as (above, below):
        above.plot(time, reference * RPM_PER_RAD_S, color=_RED, linewidth=1.2, label="reference")
        above.plot(
            recording.time, recording.velocity * RPM_PER_RAD_S, color=_BLUE, linewidth=1.0, label="measured"
        )
        above.set(ylabel="speed, r/min")
        above.legend(frameon=False)
        below.plot(recording.time, recording.torque, color=_BLUE, linewidth=0.8)
        below.set(xlabel="time, s", ylabel="torque, N m")
