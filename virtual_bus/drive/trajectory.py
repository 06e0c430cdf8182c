"""Motion profiles in closed form: from any start by ramps in speed to a target.

    speed     ____________               a: acceleration, d: deceleration, v: profile velocity
             /|          |\\              way through 1, 2, 3:  v^2/2a,  v T,  v^2/2d
            / |          | \\
    _______/ 1|    2     |3 \\______      a way too short for phase 2 peaks at sqrt(2 s a d / (a + d))

A ramp by D in speed at most as steep as a takes, by its form (CiA 402-2, 6086h),

    linear         D/a
    sine squared   2 D/a                             the acceleration is a sin^2, without a corner
    jerk-limited   D/a + a/j, or 2 sqrt(D/j) where it never comes to a

All are symmetric: the way is the mean speed times that. A peak below v has a closed form for linear ramps
alone; for others it is found by halving. A jerk-limited profile that begins while another accelerates takes
that acceleration back by its jerk first; a sine squared begins anew without it.

Pure: no time of their own, no units of their own. Positions, speeds and accelerations share one unit of
length and the second. Source: CiA 402-2, profile position and profile velocity mode.
"""

import math
from typing import Final, NamedTuple


class RampForm(NamedTuple):
    """Form of the ramps of a profile."""

    jerk: float = 0.0
    """0: none is limited."""
    sine: bool = False

    def time_s(self, change: float, rate: float) -> float:
        """Duration of a ramp by ``change``, at least 0, in speed."""
        if self.sine:
            return 2.0 * change / rate
        if self.jerk == 0.0:
            return change / rate
        if change * self.jerk < rate * rate:
            return 2.0 * math.sqrt(change / self.jerk)
        return change / rate + rate / self.jerk

    def way(self, slow: float, fast: float, rate: float) -> float:
        """From one speed to another; below 0 where ``fast`` is the slower one."""
        if not self.sine and self.jerk == 0.0:
            return (fast * fast - slow * slow) / (2.0 * rate)
        return math.copysign(0.5 * (slow + fast) * self.time_s(abs(fast - slow), rate), fast - slow)


LINEAR: Final = RampForm()
SINE: Final = RampForm(sine=True)
_HALVINGS: Final = 60
"""Of a peak in speed: to the last digit."""


class TrajectoryPoint:
    """Point of a profile at one instant."""

    __slots__ = ("acceleration", "position", "speed")

    def __init__(self, position: float, speed: float, acceleration: float = 0.0) -> None:
        self.position = position
        self.speed = speed
        self.acceleration = acceleration


class _ProfilePhase:
    """From ``start_s`` of the profile on: constant acceleration, constant jerk, or a sine squared that
    changes the speed by ``swing`` in ``swing_s``."""

    __slots__ = ("acceleration", "jerk", "position", "speed", "start_s", "swing", "swing_s")

    def __init__(self, start_s: float, position: float, speed: float) -> None:
        self.start_s = start_s
        self.position = position
        self.speed = speed
        self.acceleration = self.jerk = self.swing = self.swing_s = 0.0

    def at(self, t: float) -> TrajectoryPoint:
        """``t``: since its start."""
        a, jerk = self.acceleration, self.jerk
        if self.swing_s > 0.0:
            share, turn = t / self.swing_s, math.tau * t / self.swing_s
            bent = 0.5 * share * share - (1.0 - math.cos(turn)) / math.tau**2
            return TrajectoryPoint(
                self.position + t * self.speed + self.swing * self.swing_s * bent,
                self.speed + self.swing * (share - math.sin(turn) / math.tau),
                self.swing / self.swing_s * (1.0 - math.cos(turn)),
            )
        if jerk != 0.0:
            return TrajectoryPoint(
                self.position + t * (self.speed + t * (0.5 * a + jerk * t / 6.0)),
                self.speed + t * (a + 0.5 * jerk * t),
                a + jerk * t,
            )
        return TrajectoryPoint(self.position + t * (self.speed + 0.5 * a * t), self.speed + a * t, a)


class Trajectory:
    """Phases one after the other; after the last one the speed stays as it is."""

    __slots__ = ("_phases", "_ramp", "duration_s", "end_position", "end_speed")

    def __init__(self, start: TrajectoryPoint, ramp: RampForm = LINEAR) -> None:
        """Begin there; before the first ramp an acceleration is taken back, if the jerk is limited."""
        self._phases: list[_ProfilePhase] = [_ProfilePhase(0.0, start.position, start.speed)]
        self._ramp = ramp
        self.duration_s = 0.0
        self.end_position = start.position
        self.end_speed = start.speed
        if ramp.jerk > 0.0:
            a = start.acceleration
            self._add(abs(a) / ramp.jerk, a, -math.copysign(ramp.jerk, a))

    def rise(self, change: float, rate: float) -> None:
        """Append a ramp that changes the speed by ``change``."""
        size, ramp = abs(change), self._ramp
        a = math.copysign(rate, change)
        if ramp.sine:
            self._swing(change, ramp.time_s(size, rate))
        elif ramp.jerk == 0.0:
            self._add(size / rate, a)
        else:
            jerk = math.copysign(ramp.jerk, change)
            bend_s = min(rate / ramp.jerk, math.sqrt(size / ramp.jerk))
            self._add(bend_s, 0.0, jerk)
            self._add(ramp.time_s(size, rate) - 2.0 * bend_s, a)
            self._add(bend_s, jerk * bend_s, -jerk)

    def go_on(self, duration_s: float) -> None:
        """Append a phase of constant speed."""
        self._add(duration_s, 0.0)

    def _add(self, duration_s: float, acceleration: float, jerk: float = 0.0) -> None:
        """Append a phase; one without duration is left out."""
        if duration_s <= 0.0:
            return
        last = self._phases[-1]
        last.acceleration, last.jerk = acceleration, jerk
        self._end_with(duration_s, last)

    def _swing(self, change: float, duration_s: float) -> None:
        if duration_s <= 0.0:
            return
        last = self._phases[-1]
        last.swing, last.swing_s = change, duration_s
        self._end_with(duration_s, last)

    def _end_with(self, duration_s: float, last: _ProfilePhase) -> None:
        end = last.at(duration_s)
        self.end_position, self.end_speed = end.position, end.speed
        self.duration_s += duration_s
        self._phases.append(_ProfilePhase(self.duration_s, end.position, end.speed))

    def end_at(self, position: float, speed: float) -> None:
        """Take the rounding off the end."""
        self.end_position, self.end_speed = position, speed
        last = self._phases[-1]
        last.position, last.speed = position, speed

    def at(self, elapsed_s: float) -> TrajectoryPoint:
        """Where it is ``elapsed_s`` after the start."""
        phase = self._phases[0]
        for later in self._phases:
            if later.start_s > elapsed_s:
                break
            phase = later
        return phase.at(elapsed_s - phase.start_s)


def plan_stop(position: float, speed: float, deceleration: float) -> Trajectory:
    """To rest on the shortest way."""
    profile = Trajectory(TrajectoryPoint(position, speed))
    profile.rise(-speed, deceleration)
    profile.end_at(profile.end_position, 0.0)
    return profile


def plan_speed(
    start: TrajectoryPoint, target: float, acceleration: float, deceleration: float, ramp: RampForm = LINEAR
) -> Trajectory:
    """From one speed to another: slower by ``deceleration``, faster by ``acceleration``, both through 0."""
    profile = Trajectory(TrajectoryPoint(0.0, start.speed, start.acceleration), ramp)
    speed = profile.end_speed
    if speed * target < 0.0:
        profile.rise(-speed, deceleration)
        profile.rise(target, acceleration)
    else:
        profile.rise(target - speed, deceleration if abs(target) < abs(speed) else acceleration)
    profile.end_at(profile.end_position, target)
    return profile


class MoveLimits:
    """Profile velocity, acceleration and deceleration of a move, all above 0; ``end_speed`` at its target."""

    __slots__ = ("acceleration", "deceleration", "end_speed", "ramp", "speed")

    def __init__(
        self,
        speed: float,
        acceleration: float,
        deceleration: float,
        end_speed: float = 0.0,
        ramp: RampForm = LINEAR,
    ) -> None:
        self.speed = speed
        self.acceleration = acceleration
        self.deceleration = deceleration
        self.end_speed = min(end_speed, speed)
        self.ramp = ramp


def plan_move(start: TrajectoryPoint, target: float, limits: MoveLimits) -> Trajectory:
    """The quickest move to ``target`` within ``limits``, from any speed.

    A start that is too fast for the way overshoots, stops and comes back; one that moves away stops first.
    ``end_speed`` is in the direction of travel; the way may be too short to reach it, and a move that has to
    turn back ends at rest.
    """
    profile = Trajectory(start, limits.ramp)
    speed, way = profile.end_speed, target - profile.end_position
    direction = math.copysign(1.0, way)
    end_speed = limits.end_speed
    if speed != 0.0 and _must_stop_first(speed * direction, abs(way), end_speed, limits):
        if speed * direction > 0.0:
            end_speed = 0.0
        profile.rise(-speed, limits.deceleration)
        profile.end_at(profile.end_position, 0.0)
        direction = math.copysign(1.0, target - profile.end_position)
    _add_way(profile, direction, abs(target - profile.end_position), end_speed, limits)
    profile.end_at(target, profile.end_speed if end_speed else 0.0)
    return profile


def _must_stop_first(speed: float, way: float, end_speed: float, limits: MoveLimits) -> bool:
    """``speed``: towards the target. Whether it leads away from the target, or beyond it."""
    if speed < 0.0:
        return True
    braking = limits.ramp.way(end_speed, speed, limits.deceleration)
    # By rounding a move that is just braking may seem to need a hair more than it has.
    return braking > way * (1.0 + 1e-9)


def _add_way(profile: Trajectory, direction: float, way: float, end_speed: float, limits: MoveLimits) -> None:
    """Phases over ``way`` in ``direction``, from the profile's end, which does not move away."""
    a, d, ramp = limits.acceleration, limits.deceleration, limits.ramp
    start = abs(profile.end_speed)
    if start > limits.speed:
        profile.rise(-direction * (start - limits.speed), d)
        way -= ramp.way(limits.speed, start, d)
        start = limits.speed
    rising = ramp.way(start, limits.speed, a)
    falling = ramp.way(end_speed, limits.speed, d)
    if rising + falling <= way:
        peak, cruise = limits.speed, way - rising - falling
    else:
        peak, cruise = _peak(start, end_speed, way, limits), 0.0
        end_speed = min(end_speed, peak)
    profile.rise(direction * (peak - start), a)
    if cruise > 0.0:
        profile.go_on(cruise / peak)
    profile.rise(direction * (end_speed - peak), d)


def _peak(start: float, end_speed: float, way: float, limits: MoveLimits) -> float:
    """Return the largest speed of a move too short for the profile velocity; below ``end_speed`` where that
    is not reached."""
    a, d, ramp = limits.acceleration, limits.deceleration, limits.ramp
    if ramp == LINEAR:
        square = (way + start * start / (2.0 * a) + end_speed * end_speed / (2.0 * d)) * 2.0 * a * d / (a + d)
        peak = max(math.sqrt(max(square, 0.0)), start)
        return peak if peak >= end_speed else math.sqrt(start * start + 2.0 * a * max(way, 0.0))
    low, high = start, limits.speed
    for _ in range(_HALVINGS):
        peak = 0.5 * (low + high)
        if ramp.way(start, peak, a) + max(ramp.way(end_speed, peak, d), 0.0) <= way:
            low = peak
        else:
            high = peak
    return low
