"""What a run asks of an axis over time: a speed reference and a load torque."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


class Segment(Protocol):
    """One piece of a speed profile."""

    @property
    def at_s(self) -> float:
        """When the segment begins, s."""
        ...

    def value(self, elapsed_s: float, start_rad_s: float) -> float:
        """Speed ``elapsed_s`` after the segment began at ``start_rad_s``, rad/s."""
        ...


@dataclass(frozen=True, slots=True)
class SpeedStep:
    """Jump to a speed and stay."""

    at_s: float
    speed_rad_s: float

    def value(self, elapsed_s: float, start_rad_s: float) -> float:  # noqa: ARG002
        return self.speed_rad_s


@dataclass(frozen=True, slots=True)
class Ramp:
    """Go linearly to a speed within ``over_s``, then stay."""

    at_s: float
    speed_rad_s: float
    over_s: float

    def value(self, elapsed_s: float, start_rad_s: float) -> float:
        if elapsed_s >= self.over_s:
            return self.speed_rad_s
        return start_rad_s + (self.speed_rad_s - start_rad_s) * (elapsed_s / self.over_s)


@dataclass(frozen=True, slots=True)
class Sine:
    """Swing about the speed at which the segment began."""

    at_s: float
    amplitude_rad_s: float
    frequency_hz: float

    def value(self, elapsed_s: float, start_rad_s: float) -> float:
        return start_rad_s + self.amplitude_rad_s * sine_of_turns(elapsed_s * self.frequency_hz)


class SpeedProfile:
    """Speed reference of one axis: segments in order of time, 0 rad/s before the first."""

    def __init__(self, segments: Sequence[Segment]) -> None:
        self._segments = sorted(segments, key=lambda segment: segment.at_s)
        self._starts_s = [segment.at_s for segment in self._segments]
        self._start_speeds = self._speeds_at_starts()

    @property
    def change_times_s(self) -> tuple[float, ...]:
        """When a new segment begins, s."""
        return tuple(self._starts_s)

    def value(self, time_s: float) -> float:
        """Reference ``time_s`` after the run began, rad/s."""
        number = bisect_right(self._starts_s, time_s)
        if number == 0:
            return 0.0
        segment = self._segments[number - 1]
        return segment.value(time_s - segment.at_s, self._start_speeds[number - 1])

    def _speeds_at_starts(self) -> list[float]:
        speeds: list[float] = []
        for number, segment in enumerate(self._segments):
            if number == 0:
                speeds.append(0.0)
                continue
            before = self._segments[number - 1]
            speeds.append(before.value(segment.at_s - before.at_s, speeds[number - 1]))
        return speeds


class LoadProfile:
    """Load torque of one axis: steps in order of time, 0 N m before the first.

    ``steps``: pairs (at_s, torque_nm); a positive torque opposes positive speed.
    """

    def __init__(self, steps: Sequence[tuple[float, float]]) -> None:
        ordered = sorted(steps)
        self._starts_s = [at_s for at_s, _ in ordered]
        self._torques_nm = [0.0, *(torque for _, torque in ordered)]

    @property
    def change_times_s(self) -> tuple[float, ...]:
        """When the load changes, s."""
        return tuple(self._starts_s)

    def value(self, time_s: float) -> float:
        """Load torque ``time_s`` after the run began, N m."""
        return self._torques_nm[bisect_right(self._starts_s, time_s)]


_TAYLOR = tuple((-1.0) ** k * (2.0 * math.pi) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(9))


def sine_of_turns(turns: float) -> float:
    """sin(2 pi turns), error below 1e-13, by plain arithmetic.

    The C library's sine may differ in its last bit between machines, and a
    simulated run must give the same records on all of them.
    """
    fraction = turns - math.floor(turns)
    quarter = fraction - 0.5
    if quarter > 0.25:
        quarter = 0.5 - quarter
    elif quarter < -0.25:
        quarter = -0.5 - quarter
    square = quarter * quarter
    total = 0.0
    for coefficient in reversed(_TAYLOR):
        total = total * square + coefficient
    return -total * quarter
