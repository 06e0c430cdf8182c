"""Fate of each SYNC's reading, and how long it took.

    SYNC        1      2      3      4      5
    reading     |--1   |------:---2  |--4   |--5
    fate        used   late   lost   used   used       ':' is the deadline

A sequence keeps its place until its reading has come or the horizon has passed;
fates are handed out in order of sequence. A cycle without SYNC has its fate at once.

One cycle of an axis while it is in the making: its tick, what is asked for, what was done.
"""

from collections.abc import Sequence
from typing import Final

from mypy_extensions import mypyc_attr

from servobench.drivers.exchange import Command, SentCommand
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.samples import Dropout, DropoutCause, Observation, Sample, StateEstimate
from servobench.hil.loop.syncs import SyncMark

UNHEARD_MAX: Final = 100
"""Cycles beyond the horizon for which a fate waits while nothing is heard of the bus: five times the longest
standstill of a process that was seen on a shared machine."""
DOUBTED_FOR: Final = 256
"""Cycles for which a doubt is remembered: more than those for which a row waits."""
MEDIAN_STEP: Final = 20.0
"""The running median moves by this part of itself: it follows a change within some twenty readings, and one
outlier hardly moves it."""


@mypyc_attr(acyclic=True, free_list_len=1)
class Fate:
    """The end of one sequence."""

    def __init__(
        self,
        sequence: int,
        observation: Observation,
        delay: Duration | None,
        received_at: Instant | None = None,
    ) -> None:
        """``delay``: sampled to received; None if it never came, as ``received_at``."""
        self.sequence = sequence
        self.observation = observation
        self.delay = delay
        self.received_at = received_at


@mypyc_attr(acyclic=True, free_list_len=1)
class _Outstanding:
    """A SYNC whose reading is still awaited, or has come but waits for earlier ones."""

    def __init__(self, sequence: int, due_at: Instant, heard_ns: int) -> None:
        self.sequence = sequence
        self.due_at = due_at
        self.heard_ns = heard_ns
        self.fate: Fate | None = None
        self.doubtful = False
        """True if the fate rests on a reading of uncertain place."""
        self.following: _Outstanding | None = None
        """That of the next sequence."""


class _Doubt:
    """Cycles whose readings were of uncertain place."""

    def __init__(self, first: int, last: int) -> None:
        self.first = first
        self.last = last


class DelayMeter:
    """Follows the readings of one axis from SYNC to fate."""

    def __init__(self, deadline: Duration, horizon: int) -> None:
        """``deadline``: oldest usable age on arrival; ``horizon``: SYNCs after which one is lost."""
        self._deadline = deadline
        self._horizon = horizon
        self._first: _Outstanding | None = None
        """Outstanding ones, a chain: for a list to give its first away takes ten times as long."""
        self._last: _Outstanding | None = None
        self._count = 0
        self._newest = 0
        self._newest_certain = 0
        """Like ``newest``, for readings whose place was certain: only to them another is certainly stale."""
        self._typical_ns = 0.0
        self._doubts: list[_Doubt] = []
        """The oldest first."""
        self._kept = 0
        """So many of them are from before the question that is open."""
        self.unmatched = 0
        """Readings whose cycle had its fate already: later than the horizon, or the second of their SYNC."""

    @property
    def typical_delay(self) -> Duration:
        """Running median of the delay, ns; 0 before the first reading."""
        return Duration(int(self._typical_ns))

    @property
    def newest(self) -> int:
        """Largest sequence of which a reading has come; 0 before the first."""
        return self._newest

    def sync_sent(self, sequence: int, due_at: Instant, heard_ns: int) -> None:
        """A SYNC has gone out; sequences must rise. ``heard_ns``: for how long the bus had been heard of."""
        self._append(_Outstanding(sequence, due_at, heard_ns))

    def missed(self, sequence: int, due_at: Instant) -> None:
        """A cycle goes without SYNC."""
        place = _Outstanding(sequence, due_at, 1 << 62)
        place.fate = Fate(sequence, Dropout(sequence, due_at, DropoutCause.MISSED, True), None)
        self._append(place)

    def _append(self, place: _Outstanding) -> None:
        if self._last is None:
            self._first = place
        else:
            self._last.following = place
        self._last = place
        self._count += 1

    def arrived(self, sample: Sample) -> bool:
        """A reading has come; whether the loop may use it."""
        sequence, certain = sample.sequence, sample.certain
        place = self._find(sequence)
        if place is None or (place.fate is not None and not (certain and place.doubtful)):
            self.unmatched += 1
            return False
        place.doubtful = not certain
        if not certain:
            self.doubt(sequence, sequence)
        delay = Duration(sample.reading.received_at - sample.sampled_at)
        if certain:
            self.learn(delay)
        cause = None
        if delay > self._deadline:
            cause = DropoutCause.LATE
        elif sequence < self._newest:
            cause = DropoutCause.STALE
        observation: Observation = sample
        if cause is not None:
            overtaken_for_sure = sequence < self._newest_certain
            sure = certain and (cause is DropoutCause.LATE or overtaken_for_sure)
            observation = Dropout(sequence, place.due_at, cause, sure)
        self._newest = max(self._newest, sequence)
        if certain:
            self._newest_certain = max(self._newest_certain, sequence)
        place.fate = Fate(sequence, observation, delay, sample.reading.received_at)
        return cause is None

    def settle(self, heard_ns: int) -> list[Fate]:
        """The fates that have become final since the last call, in order of sequence.

        ``heard_ns``: for how long the bus has been heard of. A reading may lie on its way in a hub or an
        adapter that stands still, with its stamp: it is lost for certain when the bus has been heard of for
        as long as the horizon.
        """
        fates: list[Fate] = []
        while (first := self._first) is not None:
            fate = first.fate
            if fate is None:
                behind = self._count - 1 - self._horizon
                if behind < 0:
                    break
                last = first
                for _ in range(self._horizon):
                    assert last.following is not None
                    last = last.following
                heard = heard_ns - first.heard_ns >= last.due_at - first.due_at
                if not heard and behind < UNHEARD_MAX:
                    break
                fate = self._lost(first, heard)
            fates.append(fate)
            self._first = first.following
            self._count -= 1
            if self._first is None:
                self._last = None
        return fates

    def settle_all(self, heard_ns: int) -> list[Fate]:
        """End of the run: what has not come by now is lost. For certain, if the bus was heard of since the
        SYNC after its own, and a later reading has come: a drive that stands still may be about to answer."""
        fates: list[Fate] = []
        after = 1 << 62
        for place in reversed(self._outstanding()):
            certain = heard_ns > after and place.sequence < self._newest_certain
            fates.append(place.fate or self._lost(place, certain))
            after = min(after, place.heard_ns)
        self._first = self._last = None
        self._count = 0
        fates.reverse()
        return fates

    def _outstanding(self) -> list[_Outstanding]:
        places: list[_Outstanding] = []
        place = self._first
        while place is not None:
            places.append(place)
            place = place.following
        return places

    def _find(self, sequence: int) -> _Outstanding | None:
        place = self._first
        while place is not None and place.sequence < sequence:
            place = place.following
        return None if place is None or place.sequence != sequence else place

    def _lost(self, place: _Outstanding, certain: bool) -> Fate:
        return Fate(place.sequence, Dropout(place.sequence, place.due_at, DropoutCause.LOST, certain), None)

    def doubt(self, first: int, last: int) -> None:
        """It is open which of these cycles the last readings answer."""
        doubts = self._doubts
        if len(doubts) > self._kept and first <= doubts[-1].last + self._horizon:
            doubts[-1].first = min(doubts[-1].first, first)
            doubts[-1].last = max(doubts[-1].last, last)
        else:
            doubts.append(_Doubt(first, last))

    def keep_doubts(self) -> None:
        """A question begins; what was in doubt before it stays so, whatever its answer."""
        self._doubts = [doubt for doubt in self._doubts if doubt.last >= self._newest - DOUBTED_FOR]
        self._kept = len(self._doubts)

    def forget_doubts(self) -> None:
        """The question is answered: its readings were where they had been placed."""
        del self._doubts[self._kept :]

    def doubts(self, sequence: int) -> bool:
        """Return whether a reading of uncertain place may have been that of cycle ``sequence``."""
        near = self._horizon
        return any(doubt.first - near <= sequence <= doubt.last + near for doubt in self._doubts)

    def learn(self, delay: Duration) -> None:
        """Take a delay into :attr:`typical_delay`.

        Median by stochastic approximation: a step up or down of a fixed part of the value.
        """
        if self._typical_ns == 0.0:
            self._typical_ns = float(delay)
            return
        step = abs(self._typical_ns) / MEDIAN_STEP
        difference = delay - self._typical_ns
        self._typical_ns += min(max(difference, -step), step)


@mypyc_attr(acyclic=True, free_list_len=1)
class Tick:
    """Data that all axes of a cycle share."""

    def __init__(self, sequence: int, due_at: Instant, woke_at: Instant | None, time_s: float) -> None:
        """``woke_at``: None for a tick for which the host was not there; ``time_s``: since the run began."""
        self.sequence = sequence
        self.due_at = due_at
        self.woke_at = woke_at
        self.time_s = time_s


@mypyc_attr(free_list_len=1)
class Decision:
    """Acts of one cycle, while the fates of its reading and of its command may still be open."""

    def __init__(self, tick: Tick, reference_rad_s: float, load_torque_nm: float) -> None:
        self.tick = tick
        self.reference_rad_s = reference_rad_s
        self.reference_rad: float | None = None
        self.reference_nm: float | None = None
        self.load_torque_nm = load_torque_nm
        self.mark: SyncMark | None = None
        self.estimate: StateEstimate | None = None
        self.command: Command | None = None
        self.sent: SentCommand | None = None
        self.fate: Fate | None = None
        self.follows = True
        """The drive followed its commands."""
        self.compute_ns: int | None = None
        self.channels: Sequence[float] = ()
        self.following: Decision | None = None
        """The next one of the same :class:`Decisions`."""


class Decisions:
    """Decisions in their order. A chain: for a list to give its first away takes ten times as long."""

    def __init__(self) -> None:
        self.first: Decision | None = None
        self._last: Decision | None = None

    def newest(self) -> Decision:
        assert self._last is not None
        return self._last

    def append(self, decision: Decision) -> None:
        if self._last is None:
            self.first = decision
        else:
            self._last.following = decision
        self._last = decision

    def take_first(self) -> Decision:
        decision = self.first
        assert decision is not None
        self.first, decision.following = decision.following, None
        if self.first is None:
            self._last = None
        return decision
