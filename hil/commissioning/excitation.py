"""Set-points that excite a shaft: pulses, speed ramps, coasting, multisines; and the frequency response by a
multisine in whole periods: no leakage, and a meaningful coherence.

The resonance of a coupled load in a frequency response: where it shows, and its frequency and damping.

The torque is held between samples, so that the sampled response is rational in z, with the poles exp(p T) of
the machine: no filter in front of the samples and no delay moves them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.exchange import Command
from servobench.hil.commissioning.identify import Array, Mechanics
from servobench.hil.loop.protocol import Context, Controller, SetPoint, SpeedSetPoint, TorqueSetPoint

GUIDE_RAD_S: Final = 40.0
"""Bandwidth of the speed loop that only guides an exercise: slow enough for any delay of a bench."""
_INTEGRAL_PART: Final = 0.2
"""Share of the bandwidth at which the integral takes over: it costs 11 degrees of phase at the crossing."""
_SMOOTHING: Final = 4.0
"""Bandwidth of the guide's velocity filter over that of the loop: at its crossing it costs 14 degrees of
phase, and leaves a tenth of the velocity noise at 1 kHz in the change of torque from cycle to cycle. Such
changes act at instants that the payload's stuff bits move by some microseconds, so they blur the mean
torque."""


class TimedTorque(Controller):
    """A torque as a function of time."""

    def __init__(self, value: Callable[[float], float], period_s: float) -> None:
        self._value = value
        self._period_s = period_s
        self._cycle = 0

    def output(self, _context: Context) -> SetPoint:
        """Return the torque of this cycle."""
        return TorqueSetPoint(self._value(self._cycle * self._period_s))

    def update(self, _context: Context, _command: Command) -> None:
        """Advance by one period."""
        self._cycle += 1


class Pulse(Controller):
    """Raises the torque until the shaft has moved, holds it until it has moved far enough, and lowers it
    again.

        torque        /-----\\
                     /       \\
        ____________/         \\__________________
        moved            ^near  ^far     at rest: done
    """

    def __init__(
        self, peak_nm: float, rise_nm_s: float, near_rad: float, far_rad: float, period_s: float
    ) -> None:
        """``peak_nm``: the largest torque tried, with its sign."""
        self._peak = peak_nm
        self._step = math.copysign(rise_nm_s * period_s, peak_nm)
        self._near = near_rad
        self._far = far_rad
        self._torque = 0.0
        self._start: float | None = None
        self._last = math.nan
        self._still = 0
        self._stage = 0
        self._still_cycles = max(10, round(0.03 / period_s))
        self.moved = False
        """True once the shaft broke away."""

    def output(self, context: Context) -> SetPoint:
        """Return the torque of this cycle."""
        estimate = context.estimate
        if not estimate.sequence:
            return TorqueSetPoint(0.0)
        position = estimate.position_rad
        if self._start is None:
            self._start = position
        travel = abs(position - self._start)
        if self._stage == 0:
            self._torque += self._step
            if travel >= self._near:
                self._stage, self.moved = 1, True
            elif abs(self._torque) >= abs(self._peak):
                self._stage = 2
        elif self._stage == 1 and travel >= self._far:
            self._stage = 2
        elif self._stage == 2:
            self._torque -= self._step * 4.0
            if self._torque * self._step <= 0.0:
                self._torque, self._stage = 0.0, 3
        self._still = self._still + 1 if position == self._last else 0
        self._last = position
        return TorqueSetPoint(self._torque)

    def done(self) -> bool:
        """Return True once the torque is off and the shaft at rest."""
        return self._stage == 3 and self._still >= self._still_cycles


class SpeedGuide(Controller):
    """Follows a speed reference by torque: feed-forward of the known shaft, and a slow PI for the rest.

    ``free``: while true, no torque is given, and the shaft coasts. ``added``: additional torque.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        period_s: float,
        free: Callable[[float], bool] = lambda _time: False,
        added: Callable[[float], float] = lambda _time: 0.0,
        bandwidth_rad_s: float = GUIDE_RAD_S,
    ) -> None:
        self._mechanics = mechanics
        self._period_s = period_s
        self._free = free
        self._added = added
        self._gain = mechanics.inertia_kg_m2 * bandwidth_rad_s
        self._integral_gain = _INTEGRAL_PART * bandwidth_rad_s * self._gain
        self._smoothing = -math.expm1(-_SMOOTHING * bandwidth_rad_s * period_s)
        self._velocity = 0.0
        self._integral = 0.0
        self._reference: float | None = None
        self._cycle = 0
        self._error = 0.0
        self._demand = 0.0

    def output(self, context: Context) -> SetPoint:
        """Return the torque of this cycle."""
        reference = context.reference_rad_s
        time = self._cycle * self._period_s
        self._velocity += self._smoothing * (context.estimate.velocity_rad_s - self._velocity)
        if self._free(time):
            self._error = self._demand = 0.0
            self._reference = None
            return TorqueSetPoint(0.0)
        last = reference if self._reference is None else self._reference
        self._reference = reference
        self._error = reference - self._velocity
        mechanics = self._mechanics
        feed = mechanics.inertia_kg_m2 * (reference - last) / self._period_s + mechanics.friction_nm(
            reference
        )
        self._demand = feed + self._gain * self._error + self._integral + self._added(time)
        return TorqueSetPoint(self._demand)

    def update(self, _context: Context, command: Command) -> None:
        """Advance the integral unless a limit clips the torque."""
        self._cycle += 1
        if command.torque_nm == self._demand:
            self._integral += self._integral_gain * self._error * self._period_s


class SpeedReference(Controller):
    """Passes the reference on to a drive that takes speeds."""

    def output(self, context: Context) -> SetPoint:
        """Return the speed of this cycle."""
        return SpeedSetPoint(context.reference_rad_s)


class TimedSpeed(Controller):
    """Adds a speed as a function of time to the reference."""

    def __init__(self, added: Callable[[float], float], period_s: float) -> None:
        self._added = added
        self._period_s = period_s
        self._cycle = 0

    def output(self, context: Context) -> SetPoint:
        """Return the speed of this cycle."""
        return SpeedSetPoint(context.reference_rad_s + self._added(self._cycle * self._period_s))

    def update(self, _context: Context, _command: Command) -> None:
        """Advance by one period."""
        self._cycle += 1


def multisine(
    frequencies_hz: Array, amplitude: float, seed: int, weights: Array | float = 1.0
) -> Callable[[float], float]:
    """Return a sum of sines with random phases, with its crest near ``amplitude``.

    ``weights``: amplitudes of the sines, of which only the ratios count.
    """
    random = np.random.Generator(np.random.PCG64(seed))
    omega = 2.0 * math.pi * frequencies_hz
    time = np.arange(0.0, 1.0 / float(np.min(frequencies_hz)), 1.0 / (8.0 * float(np.max(frequencies_hz))))

    def crest_of(phases: Array) -> float:
        return float(np.max(np.abs((weights * np.sin(np.outer(time, omega) + phases)).sum(axis=1))))

    phases = min((random.uniform(0.0, 2.0 * math.pi, len(omega)) for _ in range(20)), key=crest_of)
    crest = crest_of(phases)

    def value(time_s: float) -> float:
        return amplitude * float((weights * np.sin(omega * time_s + phases)).sum()) / crest

    return value


ComplexArray = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyResponse:
    """Output over input at the excited lines."""

    frequency_hz: Array
    response: ComplexArray
    coherence: Array
    """0..1: the part of the output explained by the input."""


def lines_hz(low_hz: float, high_hz: float, count: int, block_s: float) -> Array:
    """Return up to ``count`` different lines, whole multiples of 1/block, evenly spaced by ratio."""
    steps = np.geomspace(low_hz * block_s, high_hz * block_s, count)
    return np.asarray(np.unique(np.round(steps)) / block_s)


def frequency_response(
    time: Array, source: Array, output: Array, lines: Array, block_s: float, period_s: float, skip_s: float
) -> FrequencyResponse:
    """Return H1 = S_yu / S_uu over whole blocks, after ``skip_s``; lost samples are interpolated."""
    count = round(block_s / period_s)
    start = time[0] + skip_s
    blocks = int((time[-1] - start) / block_s)
    if blocks < 2:
        raise ValueError(f"{blocks} whole blocks of {block_s:g} s, at least two are needed")
    grid = start + period_s * np.arange(blocks * count)
    u = np.interp(grid, time, source).reshape(blocks, count)
    y = np.interp(grid, time, output).reshape(blocks, count)
    spectrum_u = np.fft.rfft(u - u.mean(), axis=1)
    spectrum_y = np.fft.rfft(y - y.mean(), axis=1)
    bins = np.round(lines * block_s).astype(int)
    u_lines, y_lines = spectrum_u[:, bins], spectrum_y[:, bins]
    cross = (y_lines * u_lines.conj()).mean(axis=0)
    power_u = (np.abs(u_lines) ** 2).mean(axis=0)
    power_y = (np.abs(y_lines) ** 2).mean(axis=0)
    coherence = np.abs(cross) ** 2 / np.maximum(power_u * power_y, 1e-300)
    return FrequencyResponse(lines, cross / np.maximum(power_u, 1e-300), np.minimum(coherence, 1.0))


@dataclass(frozen=True, slots=True)
class StepLag:
    """Response of a first-order lag behind a dead time to a step."""

    half_us: float
    """Time to half of the step."""
    dead_us: float
    lag_us: float
    """Time constant."""
    mean_us: float
    """Area above the response: its final lag behind the step, whatever its shape. For a loop with one
    integrator it is 1/bandwidth, however long the dead time in the loop is."""


_SETTLED_LAGS = 6.0
"""After half of the step: the remainder, 0.1 % of a first-order lag, is less than the error of a drive's
torque feedback, which would add to the area for as long as it is taken."""


def step_lag(age_us: Array, part: Array) -> StepLag:
    """Find the lag from samples of a step response at many ages: the part of the step reached.

    Equivalent-time sampling: each sample is of another repetition of the step. The answer at each age is the
    median of its neighbours. Raises ValueError if the samples do not show the rise.
    """
    order = np.argsort(age_us, kind="stable")
    age, value = age_us[order], part[order]
    count = max(5, len(age) // 150) | 1
    if len(age) < 5 * count:
        raise ValueError(f"{len(age)} samples are too few")
    windows = np.lib.stride_tricks.sliding_window_view
    middle = np.median(windows(value, count), axis=1)
    smooth = np.maximum.accumulate(middle)
    at = windows(age, count).mean(axis=1)
    low, half, most = (_crossing(at, smooth, level) for level in (0.1, 0.5, 0.9))
    # 1 - exp(-t/T) passes 10 % and 90 % ln 9 time constants apart, and 50 % after ln 2 of them.
    lag = (most - low) / float(np.log(9.0))
    there = at <= half + _SETTLED_LAGS * lag
    mean = float(at[0] + np.trapezoid(1.0 - middle[there], at[there]))
    return StepLag(half, half - lag * float(np.log(2.0)), lag, mean)


def _crossing(at: Array, value: Array, level: float) -> float:
    above = int(np.argmax(value >= level))
    if value[above] < level or value[0] >= level:
        raise ValueError(f"the answer to the step does not pass {100 * level:.0f} % where it was sampled")
    before, after = value[above - 1], value[above]
    part = (level - before) / (after - before) if after > before else 0.0
    return float(at[above - 1] + part * (at[above] - at[above - 1]))


RISE_MIN: Final = 1.5
"""Above the rigid shaft: less is the error of a response, or a coupling that no speed loop feels."""
_BELOW, _ABOVE = 0.75, 1.3
"""The lines of a closer look, of the frequency of the highest rise: the resonance is a tenth off at most."""
_LINES_MAX: Final = 20
_COHERENT: Final = 0.3
"""A line counts by the square root of its signal over its noise; below this it says nothing."""
_NUMERATOR: Final = 4
"""Coefficients: two zeros, and one for the slope of all that is further away."""
_ROUNDS: Final = 8
"""Of the fit; each weighs by the denominator of the one before."""
_DAMPING_MAX: Final = 0.3
"""More is no resonance."""


class Resonance(NamedTuple):
    """A pair of poles."""

    frequency_hz: float
    damping_ratio: float
    magnitude: float
    """The largest measured, rad/s per N m."""


def closer_lines_hz(near_hz: float, block_s: float, highest_hz: float) -> Array:
    """Return lines (k,) around a resonance, whole multiples of 1/block, as far as they can be excited."""
    low, high = _BELOW * near_hz * block_s, min(_ABOVE * near_hz, highest_hz) * block_s
    every = np.arange(math.ceil(low), high)
    spread = np.linspace(0, len(every) - 1, min(_LINES_MAX, len(every)))
    return np.asarray(every[np.round(spread).astype(int)] / block_s)


def resonance_of(measured: FrequencyResponse, period_s: float) -> Resonance | None:
    """Fit a pair of poles to the coherent lines; None where they show none inside their band."""
    good = measured.coherence > _COHERENT
    frequency, response = measured.frequency_hz[good], measured.response[good]
    if len(frequency) < 2 * (_NUMERATOR + 2):
        return None
    back = np.exp(-2j * math.pi * frequency * period_s)
    coherence = np.minimum(measured.coherence[good], 0.99)
    sure = np.sqrt(coherence / (1.0 - coherence)) / np.abs(response)
    weight = sure
    poles = np.zeros(2)
    for _ in range(_ROUNDS):
        columns = [back**power for power in range(_NUMERATOR)]
        columns += [-response * back, -response * back**2]
        matrix = np.stack(columns, axis=1) * weight[:, None]
        right = response * weight
        scale = np.linalg.norm(matrix, axis=0)
        both = np.vstack([matrix.real, matrix.imag]) / scale
        solution = np.linalg.lstsq(both, np.concatenate([right.real, right.imag]), rcond=None)[0] / scale
        poles = solution[_NUMERATOR:]
        below = 1.0 + poles[0] * back + poles[1] * back**2
        weight = sure / np.maximum(np.abs(below), 1e-9)
    roots = np.roots([1.0, *poles])
    rate = np.log(roots[np.argmax(roots.imag)].astype(complex)) / period_s
    hz, damping = abs(rate) / math.tau, -rate.real / abs(rate)
    if not (frequency[0] < hz < frequency[-1] and 0.0 < damping < _DAMPING_MAX):
        return None
    return Resonance(float(hz), float(damping), float(np.abs(response).max()))
