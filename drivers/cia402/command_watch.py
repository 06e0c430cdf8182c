"""Whether a drive still follows the commands that it is sent, by the torque or the demand that it tells."""

from collections import deque
from typing import Final

DEMAND_MARGIN_RAW: Final = 2
"""6074h of a drive that keeps currents inside: its rounding to and fro, per thousand of the rated torque."""
ACTUAL_MARGIN_RAW: Final = 100
"""6077h is measured: ripple, friction of the current loop and its lag come in."""
ACTUAL_SHARE: Final = 4
"""And a fourth of the command: the torque constant is warm or cold, and known to some ten percent."""
TOLD_THE_SAME: Final = 8
"""Torque demands, each behind a further command, that are one by chance once in some million: thousandths of
the rated torque are so coarse that of commands that vary at all one in nine equals the one before."""
_WORD: Final = 1 << 32
_HALF_WORD: Final = 1 << 31


class CommandWatch:
    """Looks for what a drive tells among the last commands.

    Of the ``cycles`` after the last command that a drive has heard, half pass until that is no recent one any
    more, and half to make sure that the drive goes on with it. So a drive that acts on a command only after
    more than half of them is taken for one that hears none. Commands that stay the same prove nothing, and
    raise no alarm: the old one is as good as the new.

    A demand that stays the same to the last digit, for as long as half of the ``cycles``, while the commands
    do not, is followed neither, whatever they are; one of torque :data:`TOLD_THE_SAME` times, too. That alone
    is asked of speeds and positions, which a drive may reach by a ramp.
    """

    def __init__(self, cycles: int, margin_raw: int, *, equal: bool = True, share: int = 0) -> None:
        """``margin_raw``: of a demand that follows; ``share``: beside it, one part in so many of the command.
        ``equal``: the demand of a drive that follows is a command; False: it is on the way to one."""
        if cycles < 2:
            raise ValueError("commands are watched for at least two cycles")
        self._half = cycles // 2
        self._margin = margin_raw
        self._equal = equal
        self._share = share
        self._recent: deque[int] = deque(maxlen=self._half)
        self._sent = 0
        self._followed = 0
        self._told_raw = 0
        self._changed = -1
        """Commands sent before the demand took its present value; -1: it was told but once, or measured."""
        self._same = 0
        """How often it was told since, each time behind a further command."""
        self._heard = 0
        """Commands sent before it was told last."""
        self.follows = True
        """False once ``cycles`` commands went by unfollowed, and the drive has told so."""

    def sent(self, raw: int) -> None:
        """A command was handed to the bus."""
        self._recent.append(raw)
        self._sent += 1

    def excuse(self) -> None:
        """The drive tells by other means that it does not follow, or why it cannot."""
        self._followed, self._changed = self._sent, -1

    def told(self, raw: int, limited: bool = False) -> None:
        """The drive told its demand, or its torque; ``limited``: and that it cuts a command."""
        if limited and (self._share or not self._equal):
            self.excuse()
            return
        followed = not self._equal or self._among(raw, limited)
        if raw != self._told_raw or self._changed < 0:
            self._told_raw, self._changed, self._same = raw, self._sent, 0
        else:
            self._same += self._sent != self._heard
            if followed and not (limited or self._share) and self._stays():
                followed = not self._vary()
        self._heard = self._sent
        if followed:
            self._followed = self._sent
        elif self._sent - self._followed >= self._half:
            self.follows = False

    def _among(self, raw: int, limited: bool) -> bool:
        """It is one of the last commands; of those that the drive cuts, none that is beyond it."""
        for command in reversed(self._recent):
            margin = self._margin if self._share == 0 else self._margin + abs(command) // self._share
            if -margin <= raw - command <= margin:
                return True
            if limited and min(command, 0) - margin <= raw <= max(command, 0) + margin:
                return True
        return False

    def _stays(self) -> bool:
        """The demand has stayed the same for longer than chance has it."""
        often = self._same >= TOLD_THE_SAME or not self._equal
        return often and self._sent - self._changed >= self._half

    def _vary(self) -> bool:
        """The middle half of the last commands spreads over more than one demand may stand for."""
        newest = self._recent[-1]
        ways = sorted((command - newest + _HALF_WORD) % _WORD - _HALF_WORD for command in self._recent)
        count = len(ways)
        return ways[3 * count // 4] - ways[count // 4] > 2 * self._margin
