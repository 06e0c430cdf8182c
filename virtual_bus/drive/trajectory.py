"""Motion profiles in closed form: trapezoids in speed, from any start, as phases of constant acceleration.

    speed     ____________               a: acceleration, d: deceleration, v: profile velocity
             /|          |\\              way through 1, 2, 3:  v^2/2a,  v T,  v^2/2d
            / |          | \\
    _______/ 1|    2     |3 \\______      a way too short for phase 2 peaks at sqrt(2 s a d / (a + d))

Pure: no time of their own, no units of their own. Positions, speeds and accelerations share one unit of
length and the second. Source: CiA 402-2, profile position and profile velocity mode.
"""

import math


class TrajectoryPoint:
    """Point of a profile at one instant."""

    __slots__ = ("position", "speed")

    def __init__(self, position: float, speed: float) -> None:
        self.position = position
        self.speed = speed


class _ProfilePhase:
    """Constant acceleration from ``start_s`` of the profile on."""

    __slots__ = ("acceleration", "position", "speed", "start_s")

    def __init__(self, start_s: float, position: float, speed: float, acceleration: float) -> None:
        self.start_s = start_s
        self.position = position
        self.speed = speed
        self.acceleration = acceleration


class Trajectory:
    """Phases one after the other; after the last one the speed stays as it is."""

    __slots__ = ("_phases", "duration_s", "end_position", "end_speed")

    def __init__(self, position: float, speed: float) -> None:
        """Without phases: at ``position`` and going on at ``speed``."""
        self._phases: list[_ProfilePhase] = [_ProfilePhase(0.0, position, speed, 0.0)]
        self.duration_s = 0.0
        self.end_position = position
        self.end_speed = speed

    def add(self, duration_s: float, acceleration: float) -> None:
        """Append a phase; one without duration is left out."""
        if duration_s <= 0.0:
            return
        self._phases[-1].acceleration = acceleration
        self.end_position += duration_s * (self.end_speed + 0.5 * acceleration * duration_s)
        self.end_speed += acceleration * duration_s
        self.duration_s += duration_s
        self._phases.append(_ProfilePhase(self.duration_s, self.end_position, self.end_speed, 0.0))

    def end_at(self, position: float, speed: float) -> None:
        """Take the rounding off the end."""
        self.end_position, self.end_speed = position, speed
        last = self._phases[-1]
        last.position, last.speed = position, speed

    def at(self, elapsed_s: float) -> TrajectoryPoint:
        """Position and speed ``elapsed_s`` after the start."""
        phase = self._phases[0]
        for later in self._phases:
            if later.start_s > elapsed_s:
                break
            phase = later
        t = elapsed_s - phase.start_s
        return TrajectoryPoint(
            phase.position + t * (phase.speed + 0.5 * phase.acceleration * t),
            phase.speed + phase.acceleration * t,
        )


def plan_stop(position: float, speed: float, deceleration: float) -> Trajectory:
    """To rest on the shortest way."""
    profile = Trajectory(position, speed)
    profile.add(abs(speed) / deceleration, -math.copysign(deceleration, speed))
    profile.end_at(profile.end_position, 0.0)
    return profile


def plan_speed(start: float, target: float, acceleration: float, deceleration: float) -> Trajectory:
    """From one speed to another: slower by ``deceleration``, faster by ``acceleration``, both through 0."""
    profile = Trajectory(0.0, start)
    sign = math.copysign(1.0, start)
    if start * target < 0.0:
        profile.add(abs(start) / deceleration, -sign * deceleration)
        profile.add(abs(target) / acceleration, -sign * acceleration)
    elif abs(target) < abs(start):
        profile.add((abs(start) - abs(target)) / deceleration, -sign * deceleration)
    else:
        sign = math.copysign(1.0, target)
        profile.add((abs(target) - abs(start)) / acceleration, sign * acceleration)
    profile.end_at(profile.end_position, target)
    return profile


class MoveLimits:
    """Profile velocity, acceleration and deceleration of a move, all above 0; ``end_speed`` at its target."""

    __slots__ = ("acceleration", "deceleration", "end_speed", "speed")

    def __init__(
        self, speed: float, acceleration: float, deceleration: float, end_speed: float = 0.0
    ) -> None:
        self.speed = speed
        self.acceleration = acceleration
        self.deceleration = deceleration
        self.end_speed = min(end_speed, speed)


def plan_move(position: float, speed: float, target: float, limits: MoveLimits) -> Trajectory:
    """The quickest move to ``target`` within ``limits``, from any speed.

    A start that is too fast for the way overshoots, stops and comes back; one that moves away stops first.
    ``end_speed`` is in the direction of travel; the way may be too short to reach it, and a move that has to
    turn back ends at rest.
    """
    profile = Trajectory(position, speed)
    direction = math.copysign(1.0, target - position)
    end_speed = limits.end_speed
    if speed != 0.0 and _must_stop_first(speed * direction, abs(target - position), end_speed, limits):
        if speed * direction > 0.0:
            end_speed = 0.0
        profile.add(abs(speed) / limits.deceleration, -math.copysign(limits.deceleration, speed))
        profile.end_at(profile.end_position, 0.0)
        direction = math.copysign(1.0, target - profile.end_position)
    _add_way(profile, direction, abs(target - profile.end_position), end_speed, limits)
    profile.end_at(target, profile.end_speed if end_speed else 0.0)
    return profile


def _must_stop_first(speed: float, way: float, end_speed: float, limits: MoveLimits) -> bool:
    """``speed``: towards the target. Whether it leads away from the target, or beyond it."""
    if speed < 0.0:
        return True
    braking = (speed * speed - end_speed * end_speed) / (2.0 * limits.deceleration)
    # By rounding a move that is just braking may seem to need a hair more than it has.
    return braking > way * (1.0 + 1e-9)


def _add_way(profile: Trajectory, direction: float, way: float, end_speed: float, limits: MoveLimits) -> None:
    """Phases over ``way`` in ``direction``, from the profile's end, which does not move away."""
    a, d = limits.acceleration, limits.deceleration
    start = abs(profile.end_speed)
    if start > limits.speed:
        profile.add((start - limits.speed) / d, -direction * d)
        way -= (start * start - limits.speed * limits.speed) / (2.0 * d)
        start = limits.speed
    rising = (limits.speed * limits.speed - start * start) / (2.0 * a)
    falling = (limits.speed * limits.speed - end_speed * end_speed) / (2.0 * d)
    if rising + falling <= way:
        peak, cruise = limits.speed, way - rising - falling
    else:
        square = (way + start * start / (2.0 * a) + end_speed * end_speed / (2.0 * d)) * 2.0 * a * d / (a + d)
        peak, cruise = max(math.sqrt(max(square, 0.0)), start), 0.0
        if peak < end_speed:
            peak = end_speed = math.sqrt(start * start + 2.0 * a * max(way, 0.0))
    profile.add((peak - start) / a, direction * a)
    if cruise > 0.0:
        profile.add(cruise / peak, 0.0)
    profile.add((peak - end_speed) / d, -direction * d)
