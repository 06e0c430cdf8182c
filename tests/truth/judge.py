"""What a run told of its cycles, held against the truth.

A row that is marked certain must be right in everything that it says. A row that is marked uncertain is
counted, with how far it is from the last thing that could have made it so.
"""

from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from tests.truth.rows import LATE, LOST, MISSED, NO_INSTANT, STALE, USED, Told, each_row
from tests.truth.taps import Heard, stamp_us
from tests.truth.truth import SPEED, STAMP, AxisTruth, SyncTruth

AGE_TOLERANCE: Final = Duration(5 * NS_PER_US)
"""A reading nearer than this to the deadline may be told late or not: delays are asked to 2 us."""
NO_TIME: Final = Duration(0)
RELEARNING_CYCLES: Final = 50
"""After a step of a drive's clock so many cycles may be uncertain."""
VELOCITY_UNIT_RAD_S: Final = 2.0 * np.pi / 60.0 * 1e-3
"""606Ch of the simulated drive counts 0.001 r/min."""
EXAMPLES_MAX: Final = 10
_STAMPS: Final = 1 << 32
_FALSE_LOSS: Final = "lost, and came"


@dataclass(frozen=True, slots=True)
class Timing:
    """What the bench file says of the loop."""

    period: Duration
    deadline: Duration
    horizon: int
    syncs_heard: bool = False
    """Cycles start at SYNCs that the loop does not make, and their grid follows those."""
    stamp_error: Duration | None = NO_TIME
    """The largest error of what stamps the frames for the loop; None: it hears of no frame of its own."""
    lateness_unseen: Duration = NO_TIME
    """By how much a reading may seem older than it is where nothing could tell: it may then be told late."""


@dataclass(slots=True)
class Judgement:
    """Of one axis, or of several added up."""

    rows: int = 0
    misjudged: Counter[str] = field(default_factory=Counter)
    """Certain rows that are wrong, by what is wrong."""
    examples: list[str] = field(default_factory=list)
    """The first wrong rows, in words."""
    fates: Counter[int] = field(default_factory=Counter)
    uncertain: int = 0
    uncertain_far: int = 0
    """Of them, those with neither a clock step nor the begin of the run in the cycles before, and not lost
    within the horizon of its end."""
    uncertain_last: int = 0
    """Of them, how many cycles after a step, or after the begin, the last one came."""
    uncertain_wrong: int = 0
    """Of them, those that would have been misjudged."""
    false_losses: int = 0
    """Rows, certain or not, that tell a reading lost which came in time."""
    unaccounted: int = 0
    """Planned cycles without a row, and SYNCs handed over that no row knows."""
    echo_wrong: int = 0
    """Instants of SYNCs on the bus that are told and wrong."""
    bound_broken: int = 0
    """Certain rows whose ``sampled_at`` is further off than they say."""
    delay_errors_ns: list[int] = field(default_factory=list)
    """Of certain used rows, outside of re-learning."""

    def add(self, other: "Judgement") -> None:
        """Take ``other`` in."""
        self.examples = (self.examples + other.examples)[:EXAMPLES_MAX]
        self.uncertain_last = max(self.uncertain_last, other.uncertain_last)
        self.misjudged += other.misjudged
        self.fates += other.fates
        self.delay_errors_ns += other.delay_errors_ns
        for name in (
            "rows",
            "uncertain",
            "uncertain_far",
            "uncertain_wrong",
            "false_losses",
            "unaccounted",
            "echo_wrong",
            "bound_broken",
        ):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def wrong(self) -> int:
        """How many certain rows are wrong."""
        return self.misjudged.total()

    def delay_error_us(self, percentile: float) -> float:
        """Of the magnitude; NaN if no reading was used."""
        errors: NDArray[np.int64] = np.abs(np.array(self.delay_errors_ns, np.int64))
        return float(np.percentile(errors, percentile)) / NS_PER_US if errors.size else float("nan")


def judge_axis(told: Told, truth: AxisTruth, timing: Timing) -> Judgement:
    """Every row of one axis."""
    result = Judgement()
    if not told.size:
        return result
    _Judge(told, truth, timing, result).judge()
    return result


class _Judge:
    def __init__(self, told: Told, truth: AxisTruth, timing: Timing, result: Judgement) -> None:
        self._told = told
        self._truth = truth
        self._timing = timing
        self._result = result
        self._first_due = int(told["due_at"][0]) - (int(told["sequence"][0]) - 1) * timing.period
        self._last_due = int(told["due_at"][-1])
        self._used = set(told["sync_handed_at"][told["fate"] == USED].tolist())
        self._steps = [self._cycle_at(at) for at in truth.steps_at if at >= self._first_due]
        self._has_stamp = STAMP in truth.layout.sent and (
            truth.layout.sent[STAMP].can_id in truth.layout.each_sync
        )

    def judge(self) -> None:
        result, told = self._result, self._told
        result.rows = told.size
        result.unaccounted = self._unaccounted()
        for row in each_row(told):
            fate = int(row["fate"])
            result.fates[fate] += 1
            wrong = self._wrong(row, fate)
            result.false_losses += wrong == _FALSE_LOSS
            if not row["certain"]:
                self._count_uncertain(int(row["sequence"]), fate, bool(wrong))
                continue
            if wrong:
                result.misjudged[wrong] += 1
                self._keep_example(row, wrong)
            elif fate == USED:
                self._measure(row)
            self._check_echo(row)

    def _unaccounted(self) -> int:
        """Cycles of the grid without a row, and hand-overs without one."""
        period = self._timing.period
        if self._timing.syncs_heard:
            return self._unaccounted_heard()
        planned = 1 + (self._last_due - self._first_due) // period
        handed = self._truth.handed_between(self._first_due, self._last_due + period)
        known = set(self._told["sync_handed_at"].tolist())
        unknown = sum(sync.handed_at not in known for sync in handed)
        return abs(planned - np.unique(self._told["sequence"]).size) + unknown

    def _unaccounted_heard(self) -> int:
        """Numbers without a row, and SYNCs that the loop was given without one, neither surplus nor too late
        for a cycle that was missed for them."""
        told, half = self._told, self._timing.period // 2
        known = set(told["sync_handed_at"].tolist())
        missed = told["due_at"][told["fate"] == MISSED]
        syncs = self._truth.handed_between(int(told["due_at"][0]), self._last_due + 1)
        unknown = sum(
            sync.handed_at not in known
            and sync.handed_at - last.handed_at >= half
            and not (np.abs(missed - sync.handed_at) <= half).any()
            for last, sync in pairwise(syncs)
        )
        return int(told["sequence"].max()) - np.unique(told["sequence"]).size + unknown

    def _wrong(self, row: Any, fate: int) -> str:
        """What is wrong with the fate that a row tells; empty if nothing is."""
        due, handed_at = int(row["due_at"]), int(row["sync_handed_at"])
        period = self._timing.period
        if self._timing.syncs_heard:
            if fate != MISSED and due != handed_at:
                return "its due is not the end of its SYNC"
        elif due != self._first_due + (int(row["sequence"]) - 1) * period:
            return "its due is not on the grid"
        if fate == MISSED:
            if self._timing.syncs_heard:
                return ""  # late hosts and frames lost on the way to them are not known here
            return "missed, and its SYNC went out" if self._truth.handed_between(due, due + period) else ""
        place = self._truth.place_of.get(handed_at)
        if place is None:
            return "no SYNC was handed over then"
        if not due <= handed_at < due + period:
            return "its SYNC is of another cycle"
        sync = self._truth.syncs[place]
        if fate == LOST:
            return self._wrongly_lost(sync, due)
        if sync.reading is None:
            return "came, and never did"
        if fate == USED:
            return self._wrongly_used(row, place)
        age = sync.reading.received_at - sync.reading.heard.at
        if fate == LATE:
            least = self._timing.deadline - AGE_TOLERANCE - self._timing.lateness_unseen
            return "late, and was in time" if age < least else ""
        assert fate == STALE, f"fate {fate}"
        return "" if sync.overtaken else "stale, and was the newest"

    def _wrongly_lost(self, sync: SyncTruth, due: int) -> str:
        """It may be given up in the cycle in which the horizon ends, and when the run ends."""
        if sync.reading is None:
            return ""
        horizon = due + (self._timing.horizon - 1) * self._timing.period
        end = self._last_due + self._timing.deadline
        return "" if sync.reading.received_at > min(horizon, end) else _FALSE_LOSS

    def _wrongly_used(self, row: Any, place: int) -> str:
        sync = self._truth.syncs[place]
        heard = self._heard(row, place)
        if heard is None:
            return "used, and answers another SYNC"
        if not self._is_whole(row, heard):
            return "used, and mixes two readings"
        age_most = self._timing.deadline + AGE_TOLERANCE + int(row["sampled_at_error_ns"])
        if int(row["received_at"]) - heard.at > age_most:
            return "used, and was late"
        if sync.overtaken and self._newer_was_used(place):
            return "used, and was stale"
        return ""

    def _heard(self, row: Any, place: int) -> Heard | None:
        """The sampling that the used reading comes from, if it answers the SYNC at ``place``."""
        for answered, heard in self._truth.answered_at.get(int(row["received_at"]), ()):
            if answered == place:
                return heard
        return None

    def _is_whole(self, row: Any, heard: Heard) -> bool:
        """Whether speed and stamp of the row are those of one sampling."""
        layout = self._truth.layout
        speeds = [
            layout.sent[SPEED].of(frame, signed=True)
            for frame in heard.answers
            if frame.can_id == layout.sent[SPEED].can_id
        ]
        if abs(speeds[0] * VELOCITY_UNIT_RAD_S - float(row["velocity_rad_s"])) > 0.5 * VELOCITY_UNIT_RAD_S:
            return False
        stamp = int(row["device_time_ns"])
        if not self._has_stamp or stamp == NO_INSTANT:
            return True
        return stamp_us(heard, layout.sent[STAMP]) == stamp // NS_PER_US % _STAMPS

    def _newer_was_used(self, place: int) -> bool:
        """Whether the bench used the answer to a later SYNC before this one came."""
        syncs = self._truth.syncs
        reading = syncs[place].reading
        assert reading is not None
        for newer in syncs[place + 1 : place + 1 + self._timing.horizon]:
            came_before = newer.reading is not None and newer.reading.order < reading.order
            if came_before and newer.handed_at in self._used:
                return True
        return False

    def _measure(self, row: Any) -> None:
        """Delay and instant of sampling of a reading that is used and certain."""
        result = self._result
        heard = self._heard(row, self._truth.place_of[int(row["sync_handed_at"])])
        assert heard is not None
        if abs(int(row["sampled_at"]) - heard.at) > int(row["sampled_at_error_ns"]):
            result.bound_broken += 1
        if not _is_near(int(row["sequence"]), self._steps, before=0):
            result.delay_errors_ns.append(int(row["delay_ns"]) - (int(row["received_at"]) - heard.at))

    def _check_echo(self, row: Any) -> None:
        told = int(row["sync_on_bus_at"])
        error = self._timing.stamp_error
        if told == NO_INSTANT or error is None:
            return
        place = self._truth.place_of.get(int(row["sync_handed_at"]))
        on_bus_at = None if place is None else self._truth.syncs[place].on_bus_at
        if on_bus_at is None or abs(told - on_bus_at) > error:
            self._result.echo_wrong += 1

    def _count_uncertain(self, cycle: int, fate: int, wrong: bool) -> None:
        """A step may also put readings in doubt that were on their way when it came; so may the begin. What
        has not come when the run ends may have been on its way too."""
        result = self._result
        result.uncertain += 1
        result.uncertain_wrong += wrong
        if fate == LOST and cycle > int(self._told["sequence"][-1]) - self._timing.horizon:
            return
        begin_and_steps = [1, *self._steps]
        if _is_near(cycle, begin_and_steps, before=self._timing.horizon):
            since = cycle - max(step for step in begin_and_steps if step <= cycle)
            result.uncertain_last = max(result.uncertain_last, since if since <= RELEARNING_CYCLES else 0)
        else:
            result.uncertain_far += 1

    def _keep_example(self, row: Any, wrong: str) -> None:
        place = self._truth.place_of.get(int(row["sync_handed_at"]))
        sync = None if place is None else self._truth.syncs[place]
        reading = None if sync is None else sync.reading
        told = f"axis {row['axis']}, cycle {row['sequence']}: {wrong}"
        if sync is not None:
            told += f"; handed over {sync.handed_at}, on the bus {sync.on_bus_at}"
        if reading is not None:
            told += f", sampled {reading.heard.at}, came {reading.received_at}"
        if row["fate"] == USED:
            told += f"; told sampled {row['sampled_at']}, came {row['received_at']}"
        self._result.examples = [*self._result.examples, told][:EXAMPLES_MAX]

    def _cycle_at(self, at: Instant) -> int:
        return 1 + (at - self._first_due) // self._timing.period


def _is_near(cycle: int, steps: list[int], before: int) -> bool:
    """Whether one of ``steps`` is in the cycles of re-learning before ``cycle``, or so many after it."""
    first = bisect_left(steps, cycle - RELEARNING_CYCLES)
    return first < len(steps) and steps[first] <= cycle + before
