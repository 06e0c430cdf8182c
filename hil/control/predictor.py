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
"""

import math
from typing import Final

from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_S, Duration, Instant
from servobench.hil.control.load_filter import FilterNoise, LoadFilter
from servobench.hil.control.motion import ShaftMotion
from servobench.hil.loop.axis_roles import Compensator, Controller
from servobench.hil.loop.context import Context, SetPoint, TorqueSetPoint
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
