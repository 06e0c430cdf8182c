"""A sampled controller in state space, as H-infinity synthesis finds it, on the speed error.

    u_k = C x_k + D e_k + ff_k           e_k = omega*(delayed) - omega_k
    x_k+1 = A x_k + B e_k + L (s_k - ff_k)      s_k: the command as it was sent, after all limits

What a limit cuts off, the states know: A has only poles that decay, so nothing winds up. The feed-forward
carries friction and inertia along the reference; the error is taken to the reference as it was when the
commands were given that a reading tells of, so a ramp makes none.
"""

from collections.abc import Sequence

from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.loop.axis_roles import Controller
from servobench.hil.loop.context import Context, SetPoint, TorqueSetPoint


class HinfFeedback(Controller):
    """``states``: A, (n, n), of any entries; those that are 0 cost nothing.

    ``inputs``: B, (n,), of the speed error, rad/s; ``sent_inputs``: L, (n,), of the command that was sent,
    N m; ``outputs``: C, (n,), N m; ``direct``: D, N m per rad/s. ``answer_periods``: from a reading to where
    the speed of a later one has answered to its command.
    """

    def __init__(
        self,
        states: Sequence[Sequence[float]],
        inputs: Sequence[float],
        sent_inputs: Sequence[float],
        outputs: Sequence[float],
        direct: float,
        inertia_kg_m2: float,
        viscous_friction_nm_s: float,
        answer_periods: float,
    ) -> None:
        self._inputs = list(inputs)
        self._sent_inputs = list(sent_inputs)
        self._outputs = list(outputs)
        self._direct = direct
        self._order = len(outputs)
        self._diagonal = [row[place] for place, row in enumerate(states)]
        self._places: list[int] = []
        self._gains: list[float] = []
        self._ends: list[int] = []
        for place, row in enumerate(states):
            for other, gain in enumerate(row):
                if gain != 0.0 and other != place:
                    self._places.append(other)
                    self._gains.append(gain)
            self._ends.append(len(self._places))
        self._inertia = inertia_kg_m2
        self._friction = viscous_friction_nm_s
        self._whole = int(answer_periods)
        self._part = answer_periods - self._whole
        self._begin()

    def _begin(self) -> None:
        self._state = [0.0] * self._order
        self._error_rad_s = 0.0
        self._forward_nm = 0.0
        self._references: list[float] = []
        """The last ones, as a ring; empty before the first cycle."""
        self._newest = 0

    def reset(self) -> None:
        self._begin()

    def channels(self) -> Sequence[str]:
        return ("feedback_error_rad_s",)

    def output(self, context: Context) -> SetPoint:
        ahead = context.preview(1)
        reference = ahead[0]
        if not self._references:
            self._references = [reference] * (self._whole + 2)
        error = self._answered(reference) - context.estimate.velocity_rad_s
        period_s = context.period / NS_PER_S
        forward = self._friction * reference + self._inertia * (ahead[1] - reference) / period_s
        torque, state, outputs = self._direct * error, self._state, self._outputs
        for place in range(self._order):
            torque += outputs[place] * state[place]
        self._error_rad_s, self._forward_nm = error, forward
        return TorqueSetPoint(torque + forward)

    def _answered(self, reference: float) -> float:
        """The reference of ``answer_periods`` ago, between two cycles in proportion."""
        ring, size = self._references, self._whole + 2
        later = reference if self._whole == 0 else ring[(self._newest - self._whole + 1) % size]
        earlier = ring[(self._newest - self._whole) % size]
        return later + self._part * (earlier - later)

    def update(self, context: Context, command: Command) -> None:
        error, sent, state = self._error_rad_s, command.torque_nm - self._forward_nm, self._state
        inputs, sent_inputs, diagonal = self._inputs, self._sent_inputs, self._diagonal
        places, gains, ends, entry = self._places, self._gains, self._ends, 0
        after: list[float] = []
        for place in range(self._order):
            value = diagonal[place] * state[place] + inputs[place] * error + sent_inputs[place] * sent
            end = ends[place]
            while entry < end:
                value += gains[entry] * state[places[entry]]
                entry += 1
            after.append(value)
        self._state = after
        self._newest = (self._newest + 1) % (self._whole + 2)
        self._references[self._newest] = context.reference_rad_s

    def telemetry(self) -> Sequence[float]:
        return [self._error_rad_s]
