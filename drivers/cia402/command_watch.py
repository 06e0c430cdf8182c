"""Whether a drive still follows the commands that it is sent, by what it tells of its torque."""

from collections import deque

DEMAND_MARGIN_RAW = 2
"""6074h of a drive that keeps currents inside: its rounding to and fro, per thousand of the rated torque."""
ACTUAL_MARGIN_RAW = 100
"""6077h is measured: ripple, friction of the current loop and its lag come in."""


class CommandWatch:
    """Looks for what a drive tells among the last commands.

    Of the ``cycles`` after the last command that a drive has heard, half pass until that is no recent one any
    more, and half to make sure that the drive goes on with it. So a drive that acts on a command only after
    more than half of them is taken for one that hears none. Commands that stay the same prove nothing, and
    raise no alarm: the old one is as good as the new.
    """

    __slots__ = ("_followed", "_half", "_margin", "_recent", "_sent", "follows")

    def __init__(self, cycles: int, margin_raw: int) -> None:
        if cycles < 2:
            raise ValueError("commands are watched for at least two cycles")
        self._half = cycles // 2
        self._margin = margin_raw
        self._recent: deque[int] = deque(maxlen=self._half)
        self._sent = 0
        self._followed = 0
        self.follows = True
        """False once ``cycles`` commands went by unfollowed, and the drive has told so."""

    def sent(self, raw: int) -> None:
        """A command was handed to the bus."""
        self._recent.append(raw)
        self._sent += 1

    def told(self, raw: int) -> None:
        """The drive told its demand, or its torque."""
        margin = self._margin
        if any(-margin <= raw - command <= margin for command in reversed(self._recent)):
            self._followed = self._sent
        elif self._sent - self._followed >= self._half:
            self.follows = False
