"""Pace of a loop: its cycles start by ticks of this process, or by SYNCs that somebody else makes.

OwnSync       tick      0        1        2        3         a grid of this process; it sends a SYNC at each
              SYNC      |        |                 |         tick 2: the host came too late, missed

HeardSync     SYNC      |        |                  |  |     the grid follows the SYNCs
              cycle     1        2        3         4        3: no SYNC by half a period after it was due
                                                       a SYNC within half a period of another is surplus
"""

from collections.abc import Callable, Sequence
from random import Random
from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.exchange import Master
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Clock, Duration, Instant
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.sync_period import RANGE, period_of
from servobench.hil.loop.syncs import SURPLUS, SyncLog, SyncMark

CALIBRATION_SYNCS: Final = 16
"""Enough for a first rate of the drive's clock to some 20 ppm, at stamps of 1 us."""
CALIBRATION_SYNCS_MAX: Final = 4 * CALIBRATION_SYNCS
"""Where three of four SYNCs teach nothing, more of them will not help."""
CALIBRATION_LATE: Final = 8
"""By up to such a part of a period they are late: more than the coarsest stamp that says something advances
at a time, and less than the period by which a settling bus exceeds the deadline."""
CALIBRATION_SEED: Final = 35
WATERMARK_SEED: Final = 53
CALIBRATION_SPACINGS: Final = 32
"""Spacings of SYNCs that are heard: jitter of half a period is 1.6 % of so many, less than what is
refused."""
DOUBTED_SPACINGS: Final = 96
"""Listened to beside them before a period is refused: where stamps are late by up to two thirds of a period,
another one looks right in one of six cases by 33 SYNCs, in none of sixty by 129."""
PERIOD_ERROR_MAX: Final = 0.02
"""Of the period of SYNCs that are heard. Quartz clocks are within 0.02 %; the smallest mistake in a setting
is 1024 us for 1000 us, 2.4 %."""
SILENCE_MAX: Final = Duration(NS_PER_S)
"""Without SYNC while calibrating, two periods apart: so even a producer of a period of 1 s is waited for."""

Stall = Callable[[Instant], Duration]
"""For how long the host, which is to act at an instant, is kept from it."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Start:
    """Start of a cycle: the fate of the next tick."""

    def __init__(self, due_at: Instant, woke_at: Instant | None, served: bool) -> None:
        """``woke_at``: when the host came for it; None if it did not. ``served``: it is a cycle now."""
        self.due_at = due_at
        self.woke_at = woke_at
        self.served = served


class Pace:
    """Starts cycles. Override all but ``_wake``."""

    can_probe = False
    """True if a SYNC can be had late."""

    def __init__(self, network: Master, clock: Clock, period: Duration, stall: Stall | None) -> None:
        self._network = network
        self._now = clock.now
        self._sleep_until = clock.sleep_until
        self._period = period
        self._stall = stall

    def calibrate(self, axes: Sequence[Axis], settle: Duration) -> list[bool]:
        """Let ``axes`` learn their drives' clocks; of which a reading came. ``settle``: what one may take.

        Raises PeerFault if the SYNCs are not as they must be.
        """
        raise NotImplementedError

    def begin(self, axes: Sequence[Axis]) -> Instant:
        """A run begins; its first tick."""
        raise NotImplementedError

    def next(self) -> Start:
        """Wait for the next tick; those for which it is too late come one by one, before it."""
        raise NotImplementedError

    def sync(self, sequence: int, due: Instant, probe: bool) -> Instant:
        """Send the SYNC of a cycle, a quarter of a period late if ``probe`` wants it, which needs
        :attr:`can_probe`; when it was handed over. By whole periods too late, it is that of a later cycle.
        """
        raise NotImplementedError

    def _wake(self) -> Instant:
        """The host's instant, after what keeps it."""
        now = self._now()
        if self._stall is not None:
            stalled = self._stall(now)
            if stalled > 0:
                self._sleep_until(Instant(now + stalled))
                now = self._now()
        return now


class OwnSync(Pace):
    """Ticks of this process.

    A tick for which the host comes more than half a period too late, or whose SYNC would be handed over while
    the last one has not come to the bus, goes without SYNC.
    """

    can_probe = True

    def __init__(
        self,
        network: Master,
        clock: Clock,
        period: Duration,
        syncs: Sequence[SyncLog],
        stall: Stall | None = None,
        watermark: Duration = Duration(0),  # noqa: B008 - an int
    ) -> None:
        """``syncs``: of each segment. ``watermark``: by up to so much each SYNC is late of its tick, drawn by
        a seed of its own: SYNCs at equal distances look alike when shifted by whole periods."""
        super().__init__(network, clock, period, stall)
        self._syncs = tuple(syncs)
        self._watermark = watermark
        self._draw = Random(WATERMARK_SEED)
        self._due = self._woke_at = Instant(0)

    def calibrate(self, axes: Sequence[Axis], settle: Duration) -> list[bool]:
        """With SYNCs so far apart that each reading answers the last one; with more of them where something
        stood still meanwhile. Each is late by a part of a period, drawn by a seed: the stamps of SYNCs at
        equal distances do not show by what steps they advance. After a standstill of the host the distances
        begin anew: SYNCs made up for would come in one burst."""
        answered = [False] * len(axes)
        draw = Random(CALIBRATION_SEED)
        begins_at = self._now()
        for number in range(1, CALIBRATION_SYNCS_MAX + 1):
            self._network.pump(Instant(begins_at + round(draw.random() * self._period / CALIBRATION_LATE)))
            self._network.send_sync()
            self._note(SURPLUS)
            begins_at = Instant(begins_at + settle)
            self._network.pump(begins_at)
            now = self._now()
            if ticks_missed(begins_at, self._period, now):
                begins_at = now
            _learn(axes, answered, [axis.parts.syncs.marks[-1] for axis in axes])
            if (
                number >= CALIBRATION_SYNCS
                and min(len(axis.lessons) for axis in axes) >= CALIBRATION_SYNCS // 2
            ):
                break
        for axis in axes:
            if axis.lessons.drop_overdue(self._period):
                axis.learn_anew()
        for syncs in self._syncs:
            theirs = [axis for axis in axes if axis.parts.syncs is syncs]
            if any(axis.lessons.echoes_mislead for axis in theirs):
                syncs.rest_on_hand_over()
                for axis in theirs:
                    axis.learn_anew()
        return answered

    def begin(self, axes: Sequence[Axis]) -> Instant:  # noqa: ARG002
        self._woke_at = self._now()
        self._due = Instant(self._woke_at + self._period)
        return self._due

    def next(self) -> Start:
        due = self._due
        self._due = Instant(due + self._period)
        if due > self._woke_at:
            self._network.rest(due)
            self._woke_at = self._wake()
            if ticks_missed(due, self._period, self._woke_at):
                # what came meanwhile is not to be given up for lost along with the ticks
                self._network.pump(self._woke_at)
        if ticks_missed(due, self._period, self._woke_at):
            return Start(due, None, False)
        return Start(due, self._woke_at, self._may_hand_over(due))

    def sync(self, sequence: int, due: Instant, probe: bool) -> Instant:
        late = self._period // 4 if probe else 0
        if self._watermark:
            late += round(self._draw.random() * self._watermark)
        if late and self._now() < due + late:
            self._network.pump(Instant(due + late))
        at = self._network.send_sync()
        # the process may have been stopped just before
        skipped = ticks_passed(due, self._period, at)
        self._due = Instant(self._due + skipped * self._period)
        self._note(sequence + skipped)
        return at

    def _note(self, sequence: int) -> None:
        handed_at = self._network.sync_handed_at
        for segment, syncs in enumerate(self._syncs):
            syncs.handed(sequence, handed_at[segment])

    def _may_hand_over(self, due: Instant) -> bool:
        """Return whether the last SYNC is out, and half a period ago; waits for that, up to half a period."""
        half = self._period // 2
        now = self._now()
        earliest = now
        for syncs in self._syncs:
            if not syncs.may_hand_over(now):
                return False
            earliest = max(earliest, Instant(syncs.last_on_bus + half))
        if earliest > due + half:
            return False
        if earliest > now:
            self._network.pump(earliest)
        return True


class HeardSync(Pace):
    """SYNCs that somebody else makes, each with its end on the bus as the tick.

    A tick is missed if no SYNC is heard by half a period after it was due. Of SYNCs that piled up while the
    host was late, the newest is served; the ticks of the others are missed.
    """

    def __init__(
        self,
        network: Master,
        clock: Clock,
        period: Duration,
        syncs: SyncLog,
        stall: Stall | None = None,
    ) -> None:
        """``syncs``: of the only segment."""
        super().__init__(network, clock, period, stall)
        self._syncs = syncs
        self._running = False
        self._number = 0
        """The last tick that has been told, or lies before the first one."""
        self._at = Instant(0)
        self._heard: list[tuple[int, Instant]] = []
        """Ticks whose SYNC has been heard since, by number."""
        self._starts: list[Start] = []
        """Ticks to tell."""

    def hear(self, at: Instant) -> None:
        """A SYNC ended on the bus."""
        if not self._running:
            self._syncs.heard(SURPLUS, at)
            self._heard.append((SURPLUS, at))
            return
        number, last_at = self._heard[-1] if self._heard else (self._number, self._at)
        ticks = (at - last_at + self._period // 2) // self._period
        if ticks > 0:
            self._syncs.heard(number + ticks, at)
            self._heard.append((number + ticks, at))
        elif number > 0:
            self._syncs.stray(at)
        else:
            self._syncs.heard(SURPLUS, at)

    def calibrate(self, axes: Sequence[Axis], settle: Duration) -> list[bool]:  # noqa: ARG002
        """With readings that come before the next SYNC, which the drive's are as long as nothing disturbs it.

        Raises NoAnswer if no SYNC is heard, PeerFault if they come with another period.
        """
        self._running = False
        self._heard.clear()
        answered = [False] * len(axes)
        self._await_sync(axes, [])
        for axis in axes:
            axis.discard()
        period = self._period_heard(axes, answered, CALIBRATION_SPACINGS)
        if self._is_wrong(period) and period <= RANGE * self._period:
            period = self._period_heard(axes, answered, DOUBTED_SPACINGS)
        if self._is_wrong(period):
            raise PeerFault(
                f"SYNC comes every {period / NS_PER_US:.1f} us,"
                f" and loop.period_us is {self._period // NS_PER_US}",
                f"a line through {len(self._heard)} of them; {PERIOD_ERROR_MAX:.0%} are let pass",
                "set loop.period_us or the producer's 1006h to the other; only one node may produce SYNC",
            )
        for axis in axes:
            if axis.lessons.drop_overdue(self._period):
                axis.learn_anew()
        return answered

    def begin(self, axes: Sequence[Axis]) -> Instant:
        """The tick after the last SYNC heard."""
        now = self._now()
        self._network.pump(now)
        for axis in axes:
            axis.discard()
        last_at = self._syncs.last_on_bus
        ticks = max(0, now - last_at) // self._period
        self._number, self._at = 0, Instant(last_at + ticks * self._period)
        self._heard.clear()
        self._starts.clear()
        self._running = True
        return Instant(self._at + self._period)

    def next(self) -> Start:
        if not self._starts:
            self._gather()
        return self._starts.pop(0)

    def sync(self, sequence: int, due: Instant, probe: bool) -> Instant:  # noqa: ARG002
        """It has come."""
        return due

    def _gather(self) -> None:
        """Wait for the next SYNC, and take in all that have come by then."""
        network, half = self._network, self._period // 2
        limit = Instant(self._at + self._period + half)
        while not self._heard and network.pump_one(limit):
            pass
        if not self._heard:
            self._miss()
            return
        woke_at = self._wake()
        network.pump(woke_at)
        newest, _ = self._heard[-1]
        for number, at in self._heard:
            while self._number < number - 1:
                self._miss()
            self._number, self._at = number, at
            served = number == newest
            self._starts.append(Start(at, woke_at if served else None, served))
        self._heard.clear()

    def _miss(self) -> None:
        """The next tick goes without a SYNC that was heard."""
        self._number += 1
        self._at = Instant(self._at + self._period)
        self._starts.append(Start(self._at, None, False))

    def _await_sync(self, axes: Sequence[Axis], answered: list[bool]) -> None:
        """Until the next SYNC; ``axes`` learn from what came before it, where ``answered`` is kept."""
        before = len(self._heard)
        last = self._syncs.marks[-1] if self._syncs.marks else None
        limit = Instant(self._now() + SILENCE_MAX + 2 * self._period)
        while True:
            came = self._network.pump_one(limit)
            if len(self._heard) > before:
                break
            if not came:
                raise NoAnswer(
                    f"no SYNC was heard within {(SILENCE_MAX + 2 * self._period) / NS_PER_S:g} s",
                    f"after {before} of them" if before else "",
                    "check that its producer is running, and sends it with COB-ID 080h (1005h)",
                )
        if answered and last is not None:
            _learn(axes, answered, [last] * len(axes))

    def _period_heard(self, axes: Sequence[Axis], answered: list[bool], spacings: int) -> float:
        """The period, ns, of the SYNCs heard, so many more of which are awaited first; one that was lost does
        not matter."""
        for _ in range(spacings):
            self._await_sync(axes, answered)
        return period_of([at for _, at in self._heard], self._period)

    def _is_wrong(self, period: float) -> bool:
        return abs(period - self._period) > PERIOD_ERROR_MAX * self._period


def _learn(axes: Sequence[Axis], answered: list[bool], syncs: Sequence[SyncMark]) -> None:
    """Let each axis learn from what came since its SYNC of ``syncs``."""
    for number, (axis, mark) in enumerate(zip(axes, syncs, strict=True)):
        answered[number] |= axis.calibrate(mark)


def ticks_missed(due_at: Instant, period: Duration, now: Instant) -> int:
    """How many ticks, from the one at ``due_at`` on, are more than half a period over at ``now``.

    A cycle that wakes late by no more than half a period runs at once. Later than that its SYNC would come
    closer than half a period to the next one, and tell the drive a false time: the tick is missed. The grid
    is kept, and nothing is made up for.
    """
    late = now - due_at - period // 2
    return -(-late // period) if late > 0 else 0


def ticks_passed(due_at: Instant, period: Duration, handed_at: Instant) -> int:
    """How many ticks, from the one at ``due_at`` on, have whole periods behind them at ``handed_at``."""
    return max(0, handed_at - due_at) // period
