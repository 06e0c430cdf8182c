"""A sampled controller in state space, as H-infinity synthesis finds it, on the speed error.

    u_k = C x_k + D e_k + ff_k           e_k = omega*(delayed) - omega_k
    x_k+1 = A x_k + B e_k + L (s_k - ff_k)      s_k: the command as it was sent, after all limits

What a limit cuts off, the states know: A has only poles that decay, so nothing winds up. The feed-forward
carries friction and inertia along the reference; the error is taken to the reference as it was when the
commands were given that a reading tells of, so a ramp makes none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.exchange import Command
from drivers.timebase import NS_PER_S
from hil.loop.axis_roles import Controller
from hil.loop.context import Context, SetPoint, TorqueSetPoint

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class HinfSettings:
    """The matrices, and what the feed-forward goes by."""

    A: Rows
    """(n, n)."""
    B: tuple[float, ...]
    """(n,), of the speed error, rad/s."""
    L: tuple[float, ...]
    """(n,), of the command that was sent, N m."""
    C: tuple[float, ...]
    """(n,), N m."""
    D: float
    """N m per rad/s."""
    inertia_kg_m2: float
    viscous_friction_nm_s: float
    answer_periods: float
    """From a reading to where the speed of a later one has answered to its command."""


class HinfFeedback(Controller):
    """``settings.A`` may have any entries; those that are 0 cost nothing."""

    def __init__(self, settings: HinfSettings) -> None:
        self._inputs = list(settings.B)
        self._sent_inputs = list(settings.L)
        self._outputs = list(settings.C)
        self._direct = settings.D
        self._order = len(settings.C)
        self._diagonal = [row[place] for place, row in enumerate(settings.A)]
        self._places: list[int] = []
        self._gains: list[float] = []
        self._ends: list[int] = []
        for place, row in enumerate(settings.A):
            for other, gain in enumerate(row):
                if gain != 0.0 and other != place:
                    self._places.append(other)
                    self._gains.append(gain)
            self._ends.append(len(self._places))
        self._inertia = settings.inertia_kg_m2
        self._friction = settings.viscous_friction_nm_s
        self._whole = int(settings.answer_periods)
        self._part = settings.answer_periods - self._whole
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
