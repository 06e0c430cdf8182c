"""Detects a drive that no longer follows its commands, by the torque or the demand that it reports."""

from collections import deque
from itertools import islice
from typing import Final

DEMAND_MARGIN_RAW: Final = 2
"""Rounding of 6074h to and fro in a drive that computes in currents, per thousand of the rated torque."""
ACTUAL_MARGIN_RAW: Final = 100
"""6077h is measured: ripple, friction of the current loop and its lag come in."""
ACTUAL_SHARE: Final = 4
"""Plus a quarter of the command: the torque constant depends on temperature, and is known to some ten
percent."""
TOLD_THE_SAME: Final = 8
"""Equal torque demands, each after a further command, that occur by chance once in some million: in
thousandths of the rated torque, one in nine varying commands equals the one before."""
RAMP_UNITS: Final = 2
"""A ramp shows the same demand for the time of one unit, and for twice that if it is read seldom."""
_WORD: Final = 1 << 32
_HALF_WORD: Final = 1 << 31


class CommandWatch:
    """Looks for the value that a drive reports among the last commands.

    Of the ``cycles`` after the last command that a drive has heard, half pass until that is no recent one any
    more, and half to make sure that the drive goes on with it. So a drive that acts on a command only after
    more than half of them counts as deaf. Commands that stay the same prove nothing, and raise no alarm: the
    old one is as good as the new.

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
        """Commands sent before the demand took its present value; -1: reported only once, or measured."""
        self._same = 0
        """Repetitions of that value since, each after a further command."""
        self._base = self._low = self._high = 0
        """The command at that time, and how far the later ones lie below and above it."""
        self._heard = 0
        """Commands sent before the last report."""
        self.follows = True
        """False once ``cycles`` commands went by unfollowed according to the drive's reports."""

    def sent(self, raw: int) -> None:
        """A command was handed to the bus."""
        self._recent.append(raw)
        self._sent += 1
        if not self._equal:
            way = _way(self._base, raw)
            self._low, self._high = min(self._low, way), max(self._high, way)

    def excuse(self) -> None:
        """The drive reports by other means that it does not follow, or why it cannot."""
        self._followed, self._changed = self._sent, -1

    def told(self, raw: int, limited: bool = False) -> None:
        """Take in the reported demand or torque; ``limited``: the drive says that it clips a command."""
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
        """Return True if it is one of the last commands; not beyond it if the drive clips."""
        recent = self._recent
        for back in range(1, len(recent) + 1):
            command = recent[-back]
            margin = self._margin if self._share == 0 else self._margin + abs(command) // self._share
            if -margin <= raw - command <= margin:
                return True
            if limited and min(command, 0) - margin <= raw <= max(command, 0) + margin:
                return True
        return False

    def _stays(self, raw: int) -> bool:
        """Return True if the demand has stayed the same for longer than chance, or a ramp, explains."""
        if self._sent - self._changed < self._stays_for:
            return False
        return self._same >= TOLD_THE_SAME if self._equal else not self._is_near(raw)

    def _is_near(self, raw: int) -> bool:
        """Return True if the newest half of the last commands sway about it: it is one of them or, for a
        speed, a value that a drive may show between two commands, included if they differ by less than
        counts."""
        newest = islice(reversed(self._recent), max(1, self._half // 2))
        ways = [_way(raw, command) for command in newest]
        low, high = min(ways), max(ways)
        if self._least is not None and high - low <= self._least:
            return low - self._margin <= 0 <= high + self._margin
        return any(abs(way) <= self._margin for way in ways)

    def _vary(self) -> bool:
        """Return True if the commands spread over more than one demand can represent: the middle half of the
        last ones, or all since the demand has stayed."""
        if not self._equal:
            return self._high - self._low > 2 * self._margin
        newest = self._recent[-1]
        ways = sorted(_way(newest, command) for command in self._recent)
        count = len(ways)
        return ways[3 * count // 4] - ways[count // 4] > 2 * self._margin

    def _turned_away(self, raw: int) -> bool:
        """Return True for a speed to which no recent command leads: 0, or against all of them. A speed that
        is only slower or faster may have been clipped, or raised to the drive's least."""
        least = self._least
        if least is None:
            return False
        up = raw <= 0 and all(command >= least for command in self._recent)
        return up or (raw >= 0 and all(command <= -least for command in self._recent))


def _way(start: int, end: int) -> int:
    """Return the shorter way between two 32-bit values: positions wrap."""
    return (end - start + _HALF_WORD) % _WORD - _HALF_WORD
