"""Set-points by which every command can be told from its neighbours: small torques of alternating sign."""

import math
import random
from collections import deque
from typing import Final

from drivers.errors import BadInput
from drivers.exchange import Command
from hil.loop.axis_roles import Controller
from hil.loop.context import Context, SetPoint, TorqueSetPoint

TORQUE_SHARE: Final = 0.03
"""Of the rated torque: thirty steps of 6071h, hardly more than the friction of most motors."""
STEPS_MIN: Final = 8
"""Distinct magnitudes: with fewer, commands that are four cycles apart may be equal."""
CALM_SHARE: Final = 0.25
"""Of the speed limit: beyond it torques only brake, instead of changing their sign."""


def steps_of(torque_max_nm: float | None, rated_torque_nm: float) -> int:
    """How many steps of 6071h, thousandths of the rated torque, a command may have.

    Raises BadInput for a bound that leaves fewer than :data:`STEPS_MIN`, or is beyond the rated torque.
    """
    if torque_max_nm is None:
        return round(1000.0 * TORQUE_SHARE)
    unit_nm = rated_torque_nm / 1000.0
    steps = int(torque_max_nm / unit_nm + 1e-9)
    if not STEPS_MIN <= steps <= 1000:
        raise BadInput(
            "--torque-max-nm",
            "",
            torque_max_nm,
            f"from {STEPS_MIN * unit_nm:g} N m, {STEPS_MIN} steps of the drive's torque, to the rated"
            f" {rated_torque_nm:g} N m",
        )
    return steps


class Excitation(Controller):
    """Torques of 1 to ``steps`` units, no magnitude twice within half as many cycles.

    The sign alternates, so that the speed stays where it was; where it has wandered off by more than
    :data:`CALM_SHARE` of its limit the torque brakes.
    """

    def __init__(self, steps: int, unit_nm: float, speed_max_rad_s: float, seed: int) -> None:
        self._unit_nm = unit_nm
        self._calm_rad_s = CALM_SHARE * speed_max_rad_s
        self._random = random.Random(seed)
        self._rested = list(range(1, steps + 1))
        self._recent: deque[int] = deque()
        self._kept_away = steps // 2
        self._sign = 1.0
        self._magnitude = 0
        self._draw()

    def output(self, context: Context) -> SetPoint:
        """The torque of this cycle."""
        sign, speed_rad_s = self._sign, context.estimate.velocity_rad_s
        if abs(speed_rad_s) > self._calm_rad_s:
            sign = -math.copysign(1.0, speed_rad_s)
        return TorqueSetPoint(sign * self._magnitude * self._unit_nm)

    def update(self, context: Context, command: Command) -> None:  # noqa: ARG002
        """Draw the next."""
        self._sign = -math.copysign(1.0, command.torque_nm)
        self._draw()

    def _draw(self) -> None:
        self._magnitude = self._rested.pop(self._random.randrange(len(self._rested)))
        self._recent.append(self._magnitude)
        if len(self._recent) > self._kept_away:
            self._rested.append(self._recent.popleft())
