"""Control at the floor: a Kalman filter for speed and load, the state predicted to when a command acts.

    samples     x0        x1        --        x3            filtered at the instant at which it was sampled
    commands       u0        u1        u2        u3         as they were sent, each from when it acts
    predicted                                 x3 ------> x(acts)

From the last sample on the model runs open, over all commands that are on their way: so through a dropout,
too. The feedback sees a plant without delay, and the load it knows is cancelled:

    u = T + k_T (T - T^) + k_omega (omega* - omega^)      T = T_L^ + B omega* + J d omega*/dt

Each is taken at the instant at which the command acts, the rise of the speed over the period from there.
Where positions are asked for, omega* - omega^ has K (theta* - theta^) in addition, bounded by what the shaft
can brake from.

The predictor that knows count and speed of each sample, 6064h and 606Ch of one SYNC, by constant gains.
"""

import math
from collections.abc import Sequence
from typing import Final

from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.hil.control.load_filter import FilterNoise, LoadFilter, ShaftMotion
from servobench.hil.loop.protocol import Compensator, Context, Controller, SetPoint, TorqueSetPoint
from servobench.hil.loop.samples import AT_REST, Sample, StateEstimate

PER_NS: Final = 1.0 / NS_PER_S


class Predicting(Compensator):
    """The state at the instant at which the present command will act; each filter is a subclass.

    ``dead_time``: of the drive, beside its current loop and its speed filter: from a command's instant to its
    voltage.
    """

    def __init__(self, plant: PredictorPlant, dead_time: Duration, period: Duration) -> None:
        self._plant = plant
        self.dead_time = dead_time
        self._period = period
        self._begin()

    def _begin(self) -> None:
        self.load_nm = 0.0
        """The load torque, as estimated from the readings."""
        self.innovation_rad_s = 0.0
        """The last reading's speed beside the one that was expected."""
        self._motion = ShaftMotion(self._plant)
        self._ahead = ShaftMotion(self._plant)
        self._last: Sample | None = None
        self._at = 0
        """For when the filter's state holds, ns."""
        self._acts_at: list[int] = [0]
        self._commands_nm: list[float] = [0.0]
        """Commands that act at the filter's instant or later, the one in force first."""

    def reset(self) -> None:
        self._begin()

    def sent(self, command: Command) -> None:
        acts_at = command.effective_at + self.dead_time
        while len(self._acts_at) > 1 and self._acts_at[-1] >= acts_at:
            self._acts_at.pop()
            self._commands_nm.pop()
        self._acts_at.append(acts_at)
        self._commands_nm.append(command.torque_nm)

    def receive(self, sample: Sample) -> None:
        speed = sample.reading.velocity_rad_s
        last, at, motion = self._last, sample.sampled_at, self._motion
        if last is None:
            motion.speed_rad_s = motion.filtered_rad_s = speed
            motion.angle_rad = sample.reading.counted_rad
            self._last, self._at = sample, at
            return
        if at <= self._at:
            return  # what it tells is known already
        periods = (at - last.sampled_at + self._period // 2) // self._period
        self._run(motion, self._at, at)
        self._last, self._at = sample, at
        self._forget()
        self.innovation_rad_s = speed - motion.filtered_rad_s
        self._correct(motion, sample, max(1, periods))

    def _correct(self, motion: ShaftMotion, sample: Sample, periods: int) -> None:
        """Correct the state by a sample, so many periods after the one before."""
        raise NotImplementedError

    def estimate(self, context: Context) -> StateEstimate:
        last = self._last
        if last is None:
            return AT_REST
        ahead, at = self._ahead, context.acts_at + self.dead_time
        ahead.copy(self._motion)
        self._run(ahead, self._at, at)
        speed, elapsed_s = ahead.speed_rad_s, (at - last.sampled_at) * PER_NS
        travelled_rad = 0.5 * (speed + self._motion.speed_rad_s) * elapsed_s
        return StateEstimate(
            last.reading.position_rad + travelled_rad, speed, ahead.torque_nm, Instant(at), last.sequence
        )

    def _run(self, motion: ShaftMotion, start: int, end: int) -> None:
        """Advance through the commands between two instants, in pieces of a period at most."""
        acts_at, load_nm, period = self._acts_at, self.load_nm, self._period
        count, place = len(acts_at), 0
        while start < end:
            while place + 1 < count and acts_at[place + 1] <= start:
                place += 1
            stop = min(end, start + period)
            if place + 1 < count and acts_at[place + 1] < stop:
                stop = acts_at[place + 1]
            motion.advance(self._commands_nm[place], load_nm, (stop - start) * PER_NS)
            start = stop

    def _forget(self) -> None:
        """Discard commands that acted before the filter's instant."""
        acts_at = self._acts_at
        while len(acts_at) > 1 and acts_at[1] <= self._at:
            acts_at.pop(0)
            self._commands_nm.pop(0)


class Predictor(Predicting):
    """By the speed alone; the gains follow the samples that are lost, and steps of the load."""

    def __init__(
        self, plant: PredictorPlant, noise: FilterNoise, dead_time: Duration, period: Duration
    ) -> None:
        self._noise = noise
        super().__init__(plant, dead_time, period)

    def _begin(self) -> None:
        super()._begin()
        self._filter = LoadFilter(self._plant, self._noise, self._period * PER_NS)

    def _correct(self, motion: ShaftMotion, sample: Sample, periods: int) -> None:  # noqa: ARG002
        self._filter.predict(periods)
        innovation = self.innovation_rad_s
        self._filter.correct(innovation)
        gains = self._filter.quiet
        motion.speed_rad_s += gains.speed_gain * innovation
        motion.filtered_rad_s += gains.filtered_gain * innovation
        self.load_nm += gains.load_gain * innovation


class LoadCancelling(Controller):
    """Feeds back its predictor's state, and cancels the estimated load: k_omega, and k_T in N m/N m."""

    def __init__(
        self, predictor: Predicting, plant: PredictorPlant, speed_gain_nm_s_rad: float, torque_gain: float
    ) -> None:
        self._predictor = predictor
        self._speed_gain = speed_gain_nm_s_rad
        self._torque_gain = torque_gain
        self._friction = plant.viscous_friction_nm_s
        self._inertia = plant.inertia_kg_m2

    def channels(self) -> tuple[str, ...]:
        return ("load_estimate_nm", "innovation_rad_s")

    def observer(self) -> Compensator:
        return self._predictor

    def output(self, context: Context) -> SetPoint:
        at = Instant(context.acts_at + self._predictor.dead_time)
        speed, following = self._speed(context, at), self._speed(context, Instant(at + context.period))
        rise_rad_s2 = (following - speed) / (context.period * PER_NS)
        aim_nm = self._predictor.load_nm + self._friction * speed + self._inertia * rise_rad_s2
        estimate = context.estimate
        return TorqueSetPoint(
            aim_nm
            + self._torque_gain * (aim_nm - estimate.torque_nm)
            + self._speed_gain * (self._held(context, at, speed) - estimate.velocity_rad_s)
        )

    def _speed(self, context: Context, at: Instant) -> float:
        """Return the speed that is asked for at an instant, rad/s."""
        return context.reference_at(at)

    def _held(self, context: Context, at: Instant, speed: float) -> float:  # noqa: ARG002
        """Return the speed that is fed back against where ``speed`` is asked for, rad/s."""
        return speed

    def telemetry(self) -> list[float]:
        return [self._predictor.load_nm, self._predictor.innovation_rad_s]


class PositionTracking(LoadCancelling):
    """Follows positions: K, 1/s, and the speed and the acceleration of an approach from afar."""

    def __init__(
        self,
        predictor: Predicting,
        plant: PredictorPlant,
        speed_gain_nm_s_rad: float,
        torque_gain: float,
        position_gain_per_s: float,
        approach_rad_s: float,
        approach_rad_s2: float,
    ) -> None:
        super().__init__(predictor, plant, speed_gain_nm_s_rad, torque_gain)
        self._position_gain = position_gain_per_s
        self._approach_rad_s = approach_rad_s
        self._approach_rad_s2 = approach_rad_s2

    def _speed(self, context: Context, at: Instant) -> float:
        return context.reference_rate_at(at)

    def _held(self, context: Context, at: Instant, speed: float) -> float:
        estimate = context.estimate
        if estimate.sequence == 0:
            return speed
        error_rad = context.reference_at(at) - estimate.position_rad
        braking = math.sqrt(2.0 * self._approach_rad_s2 * abs(error_rad))
        towards = math.copysign(min(self._position_gain * abs(error_rad), braking), error_rad)
        most = max(self._approach_rad_s, abs(speed))
        return max(-most, min(most, speed + towards))


STRAYS: Final = 6.0
"""A count so many standard deviations beyond what the speed explains is of another instant."""
_STEADILY: Final = 0.5
"""How far a speed that has changed steadily has moved a count, of the change times the time."""
_REGULAR: Final = 32
"""A SYNC that is off its place by less than such a part of a tick is on it."""


class FusedPredictor(Predicting):
    """``gains``: of the sample after 0, 1 .. lost ones: (speed, filtered speed, angle, load) each for the
    count and for the filtered speed; ``speed_gains``: of a sample without a count that is of use; ``tick``:
    at which the drive samples its encoder, 0: not known.

    A drive tells the count of its last tick. Where SYNCs come at equal distances, which a period of whole
    ticks keeps, the tick is always as long before. A SYNC that comes later within a period finds the same
    tick, or the next: that which count and speed speak for.

    A load moves a count from where it was expected by no more than the speed has changed, times the time
    since the last sample. What lies further off, by :data:`STRAYS` times ``spread_rad``, is of another
    instant: the ticks have drifted past a SYNC, or it was placed at another SYNC than its own. The angle then
    begins anew at that count, and the state is corrected by the speed alone.
    """

    def __init__(
        self,
        plant: PredictorPlant,
        gains: Sequence[Sequence[Sequence[float]]],
        speed_gains: Sequence[float],
        spread_rad: float,
        tick: Duration,
        dead_time: Duration,
        period: Duration,
    ) -> None:
        self._of_count = [[rows[0] for rows in each] for each in gains]
        self._of_speed = [[rows[1] for rows in each] for each in gains]
        self._alone = list(speed_gains)
        self._strays_rad = STRAYS * spread_rad
        self._tick = tick
        super().__init__(plant, dead_time, period)

    def _begin(self) -> None:
        super()._begin()
        self._ticked_at = 0
        """On the grid of ticks, as long behind one as the SYNCs are that come at equal distances."""
        self._before = 0
        """Instant of the sample before."""

    def _correct(self, motion: ShaftMotion, sample: Sample, periods: int) -> None:
        innovation, counted_rad = self.innovation_rad_s, sample.reading.counted_rad
        told_rad = innovation * (self._period * PER_NS) * periods
        beyond = self._beyond(motion, counted_rad, sample.sampled_at, _STEADILY * told_rad)
        explained = abs(told_rad) + self._strays_rad * periods
        if abs(beyond) <= explained:
            after = min(periods, len(self._of_count)) - 1
            of_count, of_speed = self._of_count[after], self._of_speed[after]
            motion.speed_rad_s += of_count[0] * beyond + of_speed[0] * innovation
            motion.filtered_rad_s += of_count[1] * beyond + of_speed[1] * innovation
            motion.angle_rad += of_count[2] * beyond + of_speed[2] * innovation
            self.load_nm += of_count[3] * beyond + of_speed[3] * innovation
            return
        speed, filtered, load = self._alone
        motion.speed_rad_s += speed * innovation
        motion.filtered_rad_s += filtered * innovation
        motion.angle_rad, self._ticked_at = counted_rad, sample.sampled_at
        self.load_nm += load * innovation

    def _beyond(self, motion: ShaftMotion, counted_rad: float, at: int, told_rad: float) -> float:
        """Return how far the count of a sample is beyond the expected one; NaN without a count.

        ``told_rad``: how far by what the speed tells, so that a load's step is not taken for a tick.
        """
        tick, beyond = self._tick, counted_rad - motion.angle_rad
        if tick == 0:
            return beyond
        off, apart, near = (at - self._ticked_at) % tick, (at - self._before) % tick, tick // _REGULAR
        self._before = at
        if min(off, tick - off) < near or min(apart, tick - apart) < near:
            self._ticked_at = at
            return beyond
        same = beyond + motion.speed_rad_s * (off * PER_NS)
        following = beyond - motion.speed_rad_s * ((tick - off) * PER_NS)
        if abs(same - told_rad) <= abs(following - told_rad):
            self._ticked_at = at - off
            return same
        self._ticked_at = at + tick - off
        return following
