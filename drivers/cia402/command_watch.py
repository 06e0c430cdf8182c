"""Whether a drive still follows the commands that it is sent, by the torque or the demand that it tells."""

from collections import deque
from itertools import islice
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
RAMP_UNITS: Final = 2
"""A ramp shows the same demand for as long as a unit takes, and for twice that where it is read seldom."""
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
    is asked of speeds and positions, which a drive may reach by a ramp: the commands since the demand came to
    rest spread over more than twice the margin, and none of the newest is the demand. A speed that stays at
    0, or against the commands, is on the way to none of them, though they be constant.
    """

    def __init__(
        self,
        cycles: int,
        margin_raw: int,
        *,
        equal: bool = True,
        share: int = 0,
        least_raw: int | None = None,
        unit_cycles: int = 0,
    ) -> None:
        """``margin_raw``: of a demand that follows; ``share``: beside it, one part in so many of the command.
        ``equal``: the demand of a drive that follows is a command; False: it is on the way to one, by a ramp
        that takes ``unit_cycles`` for a unit. ``least_raw``: the least speed whose sign counts; None: the
        demand is no speed."""
        if cycles < 2:
            raise ValueError("commands are watched for at least two cycles")
        self._half = cycles // 2
        self._margin = margin_raw
        self._equal = equal
        self._share = share
        self._least = least_raw
        self._stays_for = max(self._half, RAMP_UNITS * unit_cycles)
        self._recent: deque[int] = deque(maxlen=self._half)
        self._sent = 0
        self._followed = 0
        self._told_raw = 0
        self._changed = -1
        """Commands sent before the demand took its present value; -1: it was told but once, or measured."""
        self._same = 0
        """How often it was told since, each time behind a further command."""
        self._base = self._low = self._high = 0
        """The command then, and how far those since lie below and above it."""
        self._heard = 0
        """Commands sent before it was told last."""
        self.follows = True
        """False once ``cycles`` commands went by unfollowed, and the drive has told so."""

    def sent(self, raw: int) -> None:
        """A command was handed to the bus."""
        self._recent.append(raw)
        self._sent += 1
        if not self._equal:
            way = _way(self._base, raw)
            self._low, self._high = min(self._low, way), max(self._high, way)

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
            self._base, self._low, self._high = self._recent[-1] if self._recent else 0, 0, 0
        else:
            self._same += self._sent != self._heard
            if followed and not (limited or self._share) and self._stays(raw):
                followed = not (self._vary() or self._turned_away(raw))
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

    def _stays(self, raw: int) -> bool:
        """The demand has stayed the same for longer than chance, or a ramp, has it."""
        often = self._same >= TOLD_THE_SAME if self._equal else not self._is_near(raw)
        return often and self._sent - self._changed >= self._stays_for

    def _is_near(self, raw: int) -> bool:
        """The newest half of the last commands sway about it: it is one of them, or of a speed, which a drive
        may show on the way from one command to the next, among them where they differ by less than counts."""
        newest = islice(reversed(self._recent), max(1, self._half // 2))
        ways = [_way(raw, command) for command in newest]
        low, high = min(ways), max(ways)
        if self._least is not None and high - low <= self._least:
            return low - self._margin <= 0 <= high + self._margin
        return any(abs(way) <= self._margin for way in ways)

    def _vary(self) -> bool:
        """The commands spread over more than one demand may stand for: the middle half of the last ones, or
        all since the demand stays."""
        if not self._equal:
            return self._high - self._low > 2 * self._margin
        newest = self._recent[-1]
        ways = sorted(_way(newest, command) for command in self._recent)
        count = len(ways)
        return ways[3 * count // 4] - ways[count // 4] > 2 * self._margin

    def _turned_away(self, raw: int) -> bool:
        """A speed to which no recent command leads: 0, or against all of them. One that is only slower, or
        faster, the drive may have cut, or raised to its least."""
        least = self._least
        if least is None:
            return False
        up = raw <= 0 and all(command >= least for command in self._recent)
        return up or (raw >= 0 and all(command <= -least for command in self._recent))


def _way(start: int, end: int) -> int:
    """From one value of 32 bits to another, the shorter way round: positions go on beyond their end."""
    return (end - start + _HALF_WORD) % _WORD - _HALF_WORD
