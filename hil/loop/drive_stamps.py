"""Where the stamps of one drive lie on the host's time, and how far they are from their SYNCs.

The map of the drive's clock, the steps by which its stamps advance, and what map and steps leave over
(:mod:`servobench.hil.loop.residuals`): all learned while calibrating, and followed from reading to reading.
"""

import math
from bisect import insort
from collections import deque
from collections.abc import Sequence
from itertools import combinations
from typing import Final

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.hil.loop.clock_map import STAMP_RESOLUTION, ClockMap, evenly_spaced, residuals_of, step_of
from servobench.hil.loop.residuals import Residuals
from servobench.hil.loop.syncs import SyncMark

MATCH_NS: Final = 3 * NS_PER_US
"""A stamp of 1 us so near to a SYNC is its own: a step of the stamp and two of rounding. A coarser one may be
off by as much more as its step is longer."""
COARSE_PARTS: Final = 10
"""A stamp that advances by more than this part of a period is coarse: map and stamp may both be off by a
step, and twice both, the bound of a sample, is half a period. So half a step to either side is reckoned with.
"""
COARSEST_PARTS: Final = 3
"""One that advances by more leaves open which SYNC it is of, and any coarse one where echoes err. Order knows
more."""
TICK_MOST: Final = 125 * NS_PER_US
"""The longest tick that a stamp may wait for where nothing shows whether it waits for one."""
LEARNED_MIN: Final = 8
"""Fewer than so many say little of how far residuals reach."""
LEARNED_MAX: Final = 64
"""Readings of a calibration that are remembered: as many as it has SYNCs at the most."""


PHASES_MIN: Final = 3
"""Different phases of stamps that show the step by which all advance: jitter, or a clock that was set, puts
two on a grid of ten microseconds by chance once in a hundred times."""
PHASES_MAX: Final = 64
"""Of changes behind a SYNC that are compared: as many as a period of 2 ms has ticks of 62.5 us, in whole
microseconds."""


class LatchSteps:
    """The steps by which the stamps of changes advance, which those of SYNCs need not show.

    A drive that latches stamps at the ticks of its inner loops stamps a change up to a tick late. Its SYNCs
    lie at one phase of the ticks, as long as they come at equal distances.

        ticks     |       |       |       |       |       |
        stamps    s       c               s               c      all a whole number of ticks apart
    """

    def __init__(self) -> None:
        self.most: int | None = None
        """None: only changes show them, as no SYNCs came at other distances."""
        self._step = 0
        """0: no change has shown one yet. Those that come with a SYNC show none, and are off as that is."""
        self._phases = [0]
        """Different ones, in order."""
        self._unit = 0

    @property
    def step(self) -> int:
        """The longest that they may be, ns."""
        return self._step if self.most is None else min(self._step, self.most)

    def add(self, phase_ns: int, resolution: Duration) -> None:
        """A change was stamped so long after a SYNC; ``resolution``: of stamps, as far as it is known."""
        phases = self._phases
        if 0 < self.step <= 2 * resolution or phase_ns in phases or len(phases) == PHASES_MAX:
            return
        insort(phases, phase_ns)
        self._unit = math.gcd(self._unit, phase_ns)
        rounding = 2 * max(resolution, self._unit)  # each phase is the difference of two stamps
        apart = (later - earlier for earlier, later in combinations(phases, 2))
        self._step = min((gap for gap in apart if gap >= rounding), default=self._unit)


class DriveStamps:
    """Knowledge of the stamps of one drive."""

    def __init__(
        self, period: Duration, echo_error: int, resolution: Duration, echoes_late: bool = False
    ) -> None:
        """``resolution``: of a stamp. ``echo_error``: how far an echo may be from the end of its SYNC, ns;
        ``echoes_late``: it may be stamped any time after."""
        self.clock = ClockMap(resolution)
        self.residuals = Residuals(echo_error / 3.0)
        self._changes = LatchSteps()
        self.resolution = self._told = resolution
        """Resolution as given, or as the steps of the stamps have shown while learning."""
        self._echo_error = echo_error
        self._echoes_late = echoes_late
        self._period = period
        self._farthest = period // 4
        """How far from its SYNC a stamp is that one's only: SYNCs are at least half a period apart."""
        self._echo_variance_ns2 = float(echo_error) ** 2 / 9.0
        self.unmapped_ns = self._unmapped()
        """How far a stamp may lie from its SYNC if neither is late: by its step and the echo."""
        self._learned: deque[tuple[int, Instant]] = deque(maxlen=LEARNED_MAX)
        """Stamps and SYNCs of a calibration."""
        self._handed: deque[tuple[int, Instant]] = deque(maxlen=LEARNED_MAX)
        """Its stamps, and when their SYNCs were handed over, which no adapter stamps."""
        self._first: int | None = None
        self._grid = 0
        """The greatest common divisor of all distances from the first stamp, as far as it is looked for."""
        self._heard_late = False
        """True if SYNCs are another's, and their instants may all be late: they show no steps of stamps."""
        self._may_hide = 0

    @property
    def coarse(self) -> bool:
        """True if they tell which SYNC they are of, but hardly when that came to the drive."""
        return COARSE_PARTS * self.resolution > self._period

    @property
    def too_coarse(self) -> bool:
        """True if they do not tell which SYNC they are of."""
        parts = COARSEST_PARTS if self._echo_error <= NS_PER_US else COARSE_PARTS
        return parts * self.resolution > self._period

    @property
    def match_ns(self) -> int:
        """The same by its instant on the map, which may be off besides."""
        return self.unmapped_ns + self.clock.error_ns

    @property
    def near_ns(self) -> int:
        """The same of a SYNC and a stamp that are as late as any."""
        return self.match_ns + self.residuals.spread

    @property
    def variance_ns2(self) -> float:
        """Variance of a stamp from its SYNC."""
        return self.residuals.change_ns**2 + self.resolution**2 / 12.0

    @property
    def hidden_ns(self) -> int:
        """Greatest lateness of a SYNC at the drive that its stamp may not tell, as that may wait for a
        tick."""
        return max(self._may_hide, self.residuals.hidden)

    @property
    def unshown_ns(self) -> int:
        """The same where no stamp tells, as the map itself may err by all that residuals reach over."""
        residuals = self.residuals
        jitters = residuals.width > 2 * self.unmapped_ns
        return max(self.match_ns, residuals.reach - self.match_ns) if jitters else self.match_ns

    def change_error_ns(self, device_ns: int) -> int:
        """By how much the map may misplace a change with this stamp, which shows its own steps."""
        clock, changes = self.clock, self._changes
        changes.add(clock.since_last(device_ns), clock.resolution)
        all_ns = 0 if self._echoes_late else self._echo_error  # of the instants of all SYNCs, in no residual
        return clock.error_ns + max(0, changes.step - clock.resolution) + all_ns

    def learn(self, device_ns: int, mark: SyncMark, on_bus_at: Instant) -> None:
        """Take a stamp that can only be of the SYNC of ``mark``."""
        residuals, learned = self.residuals, self._learned
        self._first = device_ns if self._first is None else self._first
        self._grid = math.gcd(self._grid, device_ns - self._first)
        self.clock.observe(device_ns, on_bus_at, self._echo_variance_ns2)
        learned.append((device_ns, on_bus_at))
        self._handed.append((device_ns, mark.handed_at))
        if self._echoes_late and mark.handed_at == on_bus_at:
            self._heard_late, self._farthest = True, self._period * 7 // 16
        if len(learned) < LEARNED_MIN:
            return
        pairs = list(learned)
        handed = list(self._handed)
        self._coarsen(step_of(evenly_spaced(handed, self._period) if self._heard_late else handed))
        residuals.learn(residuals_of(pairs), self.unmapped_ns)
        tick_most = min(TICK_MOST, self._period // COARSEST_PARTS)
        self._may_hide = min(residuals.reach, tick_most) if residuals.spread else 0
        if mark.handed_at != on_bus_at:  # a SYNC of our own, at a distance that was drawn
            self._changes.most = residuals.reach
        elif self.resolution <= STAMP_RESOLUTION and (residuals.spread or not self._shows_uneven(pairs)):
            self._may_hide = tick_most
        if residuals.spread:
            self.clock.start_anew(pairs, residuals.variance_ns2(self.unmapped_ns))

    def _coarsen(self, step: int) -> None:
        """Stamps advance by ``step`` at a time; one of a maker is known to be of that resolution at least.

        The map took each for exact so far, and its steps for the rate of the clock: it is learned anew.
        """
        if step > self.resolution and not self._explains(step):
            self.resolution = Duration(step)
            self.clock.set_resolution(self.resolution)
            self.unmapped_ns = self._unmapped()
            self.clock.start_anew(list(self._learned), self._echo_variance_ns2)

    def _shows_uneven(self, pairs: list[tuple[int, Instant]]) -> bool:
        """Return whether SYNCs came at distances so uneven that stamps that wait for a tick would lie off
        them."""
        first_at = pairs[0][1]
        even = [(round((at - first_at) / self._period) * self._period, at) for _, at in pairs]
        off = residuals_of(even)
        return max(off) - min(off) > 4 * self.unmapped_ns

    def _explains(self, step: int) -> bool:
        """Return whether a coarse resolution that was told explains all that is seen of a larger ``step``,
        which may be that of the SYNCs: they are late by parts of a period only."""
        if self._told <= STAMP_RESOLUTION or 2 * step <= self._period:
            return False
        off = residuals_of(list(self._learned))
        return max(off) - min(off) <= self._told

    def show_coarser(self, device_ns: int) -> bool:
        """Return whether this stamp and all before lie on a grid that is too coarse: their resolution from
        now on. SYNCs at equal distances hide such steps until the clock's rate has moved it against them."""
        assert self._first is not None
        before = self.resolution
        self.resolution = Duration(math.gcd(self._grid, device_ns - self._first))
        if self.resolution > before and self.too_coarse:
            return True
        self.resolution = before
        return False

    def heed_steps(self, stamps: Sequence[int]) -> None:
        """Stamps of SYNCs that a drive heard with jitter lie off the map. Where all advance by a step between
        those of SYNCs, that is what they are rounded to, be the SYNCs as regular as they may. A step above
        half a period is the period itself, as a clock that drifts counts it: 999 us of 1000."""
        if self._first is None:
            return
        off = [device_ns - self._first for device_ns in stamps]
        step = math.gcd(self._grid, *off)
        phases = {each % self._period for each in off}
        if len(phases) >= PHASES_MIN and self.resolution < step and 2 * step <= self._period:
            self.resolution = Duration(step)
            self.clock.set_resolution(self.resolution)
            self.unmapped_ns = self._unmapped()

    def _unmapped(self) -> int:
        off = self.resolution
        if self.coarse:
            off = self.clock.off_most = Duration(off // 2)
        return MATCH_NS + off - STAMP_RESOLUTION + self._echo_error

    def fits(self, residual: int) -> bool:
        """Return whether a stamp lies on its SYNC: as near as others do, and not so far that it may be
        another's."""
        most = max(self.match_ns, self._farthest)
        middle = self.residuals.middle if self.residuals.spread else 0
        return -most <= residual - middle <= most and self.reaches(residual)

    def reaches(self, residual: int) -> bool:
        """Return whether a stamp lies as near to a SYNC as others do to theirs, be it nearer to another."""
        residuals = self.residuals
        least = self.match_ns + residuals.slack
        return -least - residuals.early <= residual <= least + residuals.late

    def lies_apart(self, residual: int) -> bool:
        """Return whether a stamp lies further off its SYNC, or before it, than most lie from one another."""
        return self.residuals.lies_apart(residual, MATCH_NS + self.resolution)

    def lateness(self, residual: int) -> int:
        """By how much a stamp with this residual is later than the earliest ones."""
        residuals = self.residuals
        return max(0, residual - residuals.least) if residuals.spread else residual

    def sampled_at(self, on_bus_at: Instant, residual: int, latest: Instant) -> Instant:
        """When a reading with this residual was sampled, whose SYNC ended at ``on_bus_at``; ``latest``: when
        its frame can have begun at the latest."""
        residuals, lateness = self.residuals, self.lateness(residual)
        if self._echoes_late and residuals.spread:
            # What is early and late cannot be told apart: the clock's map alone knows when it was, to half of
            # what residuals reach over.
            return Instant(on_bus_at + residual - residuals.middle)
        if residuals.early or residuals.late or lateness > self.match_ns:
            # Late to the drive: the stamp knows better. What lies beyond ``latest`` is the residuals' error.
            return Instant(min(on_bus_at + lateness, max(on_bus_at, latest)))
        return on_bus_at

    def lie_early(self, pairs: list[tuple[int, Instant]]) -> bool:
        """Return whether all of these stamps lie before their SYNCs by more than any has: a clock was set
        back, by less than stamps spread over. Late ones may be late SYNCs too, which their bounds hold."""
        latest = self.residuals.least - self.residuals.slack - self.match_ns
        return all(self.clock.place(device_ns) - at < latest for device_ns, at in pairs)

    def follow(self, device_ns: int, on_bus_at: Instant, residual: int) -> None:
        """Let map and residuals follow a stamp that lies on its SYNC."""
        residuals, match_ns = self.residuals, self.match_ns
        if self._grid > self.resolution and self._first is not None:
            self._grid = math.gcd(self._grid, device_ns - self._first)
        on_map = Instant(on_bus_at + residual - residuals.cut(residual, match_ns))
        self.clock.observe(
            device_ns, on_map, max(self._echo_variance_ns2, residuals.variance_ns2(self.unmapped_ns))
        )
        residuals.add(residual, match_ns)

    def move_to(self, pairs: list[tuple[int, Instant]]) -> None:
        """The clock was set: the map goes through these stamps and their SYNCs, in any order."""
        pairs.sort()
        residuals = self.residuals
        self.clock.move_to(pairs, residuals.variance_ns2(self.unmapped_ns))
        if residuals.spread:  # from here on they lie about another line
            residuals.learn(residuals_of(pairs), self.unmapped_ns, anew=False)
