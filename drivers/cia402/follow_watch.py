"""Watches whether an enabled drive follows its commands, by its displayed mode and by its statusword.

    6061h    another mode than the one of the commands    it follows nothing that is sent
    bit 12   0 in a mode of FOLLOWS_BIT                    it ignores the target value (CiA 402-2)

Bit 12 counts from when it was first seen set: some drives never set it. Where it goes to 0 beside bit 11,
internal limit active, the drive follows a command that it has cut (Synapticon Somanet clears bit 12 while
6072h or 607Dh cuts the target), and no lapse begins; one that has begun ends with bit 12 alone. 6061h counts
from when it first showed the mode of the commands, or shows another one again and again.
"""

from collections.abc import Callable
from typing import Final

from servobench.drivers.cia402.profile import Mode, Status
from servobench.drivers.core.native import FollowReports
from servobench.drivers.timebase import NS_PER_S, Instant

FOLLOWS_BIT: Final[dict[Mode, int]] = {
    Mode.CYCLIC_SYNCHRONOUS_POSITION: Status.FOLLOWS_COMMAND,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY: Status.FOLLOWS_COMMAND,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE: Status.FOLLOWS_COMMAND,
    Mode.INTERPOLATED_POSITION: Status.MODE_12,
}
"""The bit of the statusword that a mode clears while the drive ignores its target; in IP it is "interpolation
is active". In the modes that are left out bit 12 means something else: set-point acknowledge in PP, speed is
0 in PV, homing attained in HM; in VL and TQ it is reserved."""
OLDER_MAX: Final = 4
"""Reports of another mode sent before the commanded one was shown: fewer were under way when it was changed,
as 6061h is sent every 25 ms and no frame is under way for longer than 50 ms."""


class Lapse:
    """A time in which a drive did not follow its commands."""

    def __init__(self, began_at: Instant, mode: Mode, shown: int) -> None:
        self.began_at: Final = began_at
        """The instant of the frame that showed it."""
        self.ended_at: Instant | None = None
        """The instant of the frame that shows it following again; None until then."""
        self.mode: Final = mode
        """Commanded mode."""
        self.shown = shown
        """Displayed mode, 6061h."""
        self.cycles = 0
        """Cycles of the loop that began meanwhile."""

    def __str__(self) -> str:
        if self.shown != self.mode:
            return f"left {self.mode.title} for {mode_title(self.shown)}"
        return f"ignores the commands of {self.mode.title}"

    def told(self, zero: Instant | None) -> str:
        """Describe the lapse, with its time since ``zero`` if given."""
        cycles = f"{self.cycles} cycle{'' if self.cycles == 1 else 's'}"
        at = "" if zero is None else f" at {(self.began_at - zero) / NS_PER_S:.4f} s"
        return f"{self}{at} and did not follow for {cycles}"

    @property
    def evidence(self) -> str:
        """The drive's report that shows the lapse."""
        if self.shown != self.mode:
            return f"6061h is {self.shown}, {self.mode.value} was commanded"
        return "bit 12 of its statusword is 0"


def mode_title(shown: int) -> str:
    """Describe a value of 6061h in words."""
    if shown < 0:
        return f"mode {shown} of its maker"
    try:
        return Mode(shown).title if shown else "no mode"
    except ValueError:
        return f"mode {shown}, which CiA 402-2 does not define"


class FollowWatch:
    """Watch over one drive. Call :meth:`aim` whenever a mode is commanded; active from :meth:`begin` to
    :meth:`end`."""

    def __init__(self) -> None:
        self.lapse: Lapse | None = None
        """The present lapse; None while the drive follows, as far as it reports."""
        self.lapses: list[Lapse] = []
        """All lapses since the last :meth:`begin`."""
        self.on_change: Callable[[Lapse], None] | None = None
        """Called with each lapse when it begins, and when the drive follows again."""
        self.reports: Final = FollowReports(self._judge, OLDER_MAX)
        """Takes in 6061h and 6041h."""
        self._active = False
        self._mode = Mode.NONE
        self._bit = 0

    @property
    def has_bit(self) -> bool:
        """True if the statusword shows in the commanded mode whether the drive follows."""
        return self._bit != 0

    @property
    def mode_shown(self) -> bool:
        """True once 6061h has shown the mode of the commands."""
        return self.reports.mode_shown

    @property
    def bit_watched(self) -> bool:
        """True once bit 12 was seen set."""
        return self.reports.bit_watched

    def aim(self, mode: Mode) -> None:
        """Expect ``mode``: the drive confirmed it by SDO, or (NONE) is about to be given another one."""
        self._mode, self._bit = mode, FOLLOWS_BIT.get(mode, 0)
        self.reports.aim(mode.value, self._bit)
        self._set_lapse(None)

    def begin(self) -> None:
        """Begin the watch: the drive is enabled now."""
        self._active = True
        self.lapses = []
        if self.reports.shown != self._mode.value:
            self._judge(self.reports.mode_at)  # it left its mode before

    def end(self) -> None:
        """End the watch: the drive need not follow any more."""
        self._active = False
        self.reports.end()
        self._set_lapse(None)

    def mode_told(self, shown: int, at: Instant) -> None:
        """Take in a 6061h that arrived."""
        self.reports.mode_told(shown, at)

    def status_told(self, statusword: int, at: Instant) -> None:
        """Take in a 6041h that arrived."""
        self.reports.status_told(statusword, at)

    def _judge(self, at: Instant) -> None:
        """Begin or end a lapse after a change of the reports."""
        reports, changed, lapse = self.reports, self.lapse, None
        if changed is not None:
            changed.ended_at = at
        if self._active and (reports.ignores or reports.shown != self._mode.value):
            lapse = changed = Lapse(at, self._mode, reports.shown)
            self.lapses.append(lapse)
        self._set_lapse(lapse)
        if changed is not None and self.on_change is not None:
            self.on_change(changed)

    def _set_lapse(self, lapse: Lapse | None) -> None:
        self.lapse = lapse
        self.reports.lapsed = lapse is not None
