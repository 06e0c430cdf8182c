"""Effects of the network on a run's readings and commands, from its records."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_US
from servobench.hil.configuration.network_file import (
    ClockHealth,
    DelayFigures,
    DelayHistogram,
    Network,
)
from servobench.hil.loop.cycle_record import CAUSES, COMMAND_FATES, FATE_SAMPLE, NOTHING
from servobench.hil.loop.samples import CommandFate, DropoutCause
from servobench.hil.reviewing.histogram import TimeHistogram, merged
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.summary import Summary

_BARS = 100
"""The largest delay is told to a percent, in bars of whole us."""
ACTING, LOST, _NOT_IDENTIFIABLE, _NOT_SENT = (
    COMMAND_FATES.index(fate)
    for fate in (CommandFate.ACTING, CommandFate.LOST, CommandFate.NOT_IDENTIFIABLE, CommandFate.NOT_SENT)
)
_RUN_MAX = 1000
"""Losses in a row that are counted apart; more count as so many."""


class LossRuns:
    """How often so many of an axis were lost in a row."""

    def __init__(self) -> None:
        self._ended = np.zeros(_RUN_MAX + 1, np.int64)
        self._open = 0
        """Losses in a row that have not ended yet."""
        self.most = 0
        self.at: int | None = None
        """When the last of the most was due, ns."""

    def add(self, lost: NDArray[np.bool_], due_at: NDArray[np.int64]) -> None:
        """Take in which of the next ones were lost, and when each was due: (n,) each."""
        if not lost.size:
            return
        numbers = np.arange(lost.size)
        lengths = numbers - np.maximum.accumulate(np.where(lost, -1 - self._open, numbers))
        place = int(lengths.argmax())
        if lengths[place] > self.most:
            self.most, self.at = int(lengths[place]), int(due_at[place])
        before = np.concatenate(([self._open], lengths[:-1]))
        ended = before[~lost & (before > 0)]
        self._ended += np.bincount(np.minimum(ended, _RUN_MAX), minlength=_RUN_MAX + 1)
        self._open = int(lengths[-1])

    def counts(self) -> NDArray[np.int64]:
        """Return the counts of runs of 0, 1, 2, ... 1000, with the one that has not ended; there are none of
        0."""
        counts = self._ended.copy()
        if self._open:
            counts[min(self._open, _RUN_MAX)] += 1
        return counts


class AxisNetworkMeter:
    """Meter of the network's effects on one axis: the one count of its delays and losses.

    Summary, network.toml, certificate, comparison and warnings take theirs from here (docs/timing.md, "Delay
    and losses"). Feed it rows of the axis in order of sequence; any division into chunks gives the same.
    """

    def __init__(self, period_us: int) -> None:
        self._period_ns = period_us * NS_PER_US
        self.reading = TimeHistogram()
        """Delay of the readings, of every one that came."""
        self.command = TimeHistogram()
        """Handed over to on the bus, of the commands."""
        self.fates = np.zeros(len(CAUSES) + 1, np.int64)
        """Cycles by the fate of their reading."""
        self.command_fates = np.zeros(len(COMMAND_FATES), np.int64)
        self.passed = 0
        """Commands that were passed over."""
        self.uncertain = 0
        self.readings_lost = LossRuns()
        self.commands_lost = LossRuns()
        """Losses among the commands with known fate: lost or passed over."""
        self.commands_lost_least = LossRuns()
        """Losses among the same commands: lost for certain."""
        self._action_least, self._action = TimeHistogram(), TimeHistogram()
        self._stamped_least, self._stamped = TimeHistogram(), TimeHistogram()
        """The same of the commands whose acting the drive has stamped."""
        self._unstamped = 0
        """Acting commands without such a stamp less those with one."""

    def add(self, rows: Rows) -> None:
        """Take in ``rows``: (n,) of ROW_DTYPE."""
        if not rows.size:
            return
        self.fates += np.bincount(rows["fate"], minlength=self.fates.size)
        self.uncertain += int(np.count_nonzero(rows["certain"] == 0))
        self.reading.add(rows["delay_ns"][rows["delay_ns"] != NOTHING])
        on_bus = rows.compress(rows["command_on_bus_at"] != NOTHING)
        self.command.add(on_bus["command_on_bus_at"] - on_bus["command_handed_at"])
        self._add_actions(rows.compress((rows["fate"] == FATE_SAMPLE) & (rows["command_fate"] == ACTING)))
        self.readings_lost.add(rows["fate"] != FATE_SAMPLE, rows["due_at"])
        told, passed = rows["command_fate"], passed_over(rows)
        self.command_fates += np.bincount(told[told != NOTHING], minlength=len(COMMAND_FATES))
        self.passed += int(np.count_nonzero(passed))
        lost = (told == LOST) | (told == _NOT_SENT)
        known = (told == ACTING) | lost | passed
        due_at = rows["due_at"][known]
        self.commands_lost.add((told != ACTING)[known], due_at)
        self.commands_lost_least.add(lost[known], due_at)

    def _add_actions(self, acting: Rows) -> None:
        least, most = action_delays_ns(acting, self._period_ns)
        self._action_least.add(least)
        self._action.add(most)
        stamped = _stamped(acting)
        self._stamped_least.add(least[stamped])
        self._stamped.add(most[stamped])
        self._unstamped += int(acting.size - 2 * np.count_nonzero(stamped))

    @property
    def commands_known(self) -> bool:
        """True if the fate of any command is known."""
        return self.passed + int(self.command_fates[[ACTING, LOST, _NOT_SENT]].sum()) > 0

    @property
    def losses_together(self) -> tuple[int, int]:
        """Readings and commands lost in a row, added, D of [Ling2012] (2.13): at least, and at most."""
        readings = self.readings_lost.most
        return readings + self.commands_lost_least.most, readings + self.commands_lost.most

    def stamped(self) -> bool:
        """Return True if the drive has stamped the acting of most commands."""
        return self._unstamped <= 0

    def actions(self, stamped: bool) -> tuple[TimeHistogram, TimeHistogram]:
        """Delay to actuation: the least and the most that it may be; ``stamped``: of stamped ones alone."""
        return (self._stamped_least, self._stamped) if stamped else (self._action_least, self._action)


class NetworkMeter:
    """All axes of a run; feed it rows in the order of recording, in any division into chunks."""

    def __init__(self, period_us: int, axes: int) -> None:
        self._period_us = period_us
        self.axes = [AxisNetworkMeter(period_us) for _ in range(axes)]

    def add(self, rows: Rows) -> None:
        """Take in ``rows``: (n,) of ROW_DTYPE, each axis in order of sequence."""
        for number, axis in enumerate(self.axes):
            axis.add(rows if len(self.axes) == 1 else rows.compress(rows["axis"] == number))

    def action_delays(self) -> tuple[TimeHistogram, TimeHistogram]:
        """Delay to actuation over all axes: the least and the most that it may be."""
        stamped = all(axis.stamped() for axis in self.axes)
        least, most = zip(*(axis.actions(stamped) for axis in self.axes), strict=True)
        return merged(least), merged(most)

    def network(self) -> Network | None:
        """The network so far; None before the first reading."""
        reading_times = merged(axis.reading for axis in self.axes)
        reading = delays_of(reading_times)
        if reading is None:
            return None
        runs = np.sum([axis.readings_lost.counts() for axis in self.axes], axis=0)[1:]
        action_least, action = map(delays_of, self.action_delays())
        fates = np.sum([axis.fates for axis in self.axes], axis=0)
        command_fates = np.sum([axis.command_fates for axis in self.axes], axis=0)
        not_sent = int(command_fates[_NOT_SENT])
        acting, lost = int(command_fates[ACTING]), int(command_fates[LOST]) + not_sent
        passed = sum(axis.passed for axis in self.axes)
        told = acting + lost + passed
        count = {cause: int(fates[place]) for place, cause in enumerate(CAUSES, start=1)}
        total = int(fates.sum())
        return Network(
            period_us=self._period_us,
            losses_in_a_row_max=min(_RUN_MAX, max(axis.readings_lost.most for axis in self.axes)),
            delay_max_us=math.ceil(reading.max if action is None else action.max),
            commands="not measured" if action is None else "measured",
            command_losses_in_a_row_max=min(_RUN_MAX, max(axis.commands_lost.most for axis in self.axes)),
            cycles=total,
            lost=count[DropoutCause.LOST],
            late=count[DropoutCause.LATE],
            stale=count[DropoutCause.STALE],
            missed=count[DropoutCause.MISSED],
            uncertain_percent=100.0 * sum(axis.uncertain for axis in self.axes) / total,
            loss_percent=100.0 * sum(count.values()) / total,
            losses_in_a_row=tuple(np.trim_zeros(runs, "b").tolist()),
            reading_delay_us=reading,
            action_delay_us=action,
            action_delay_least_us=action_least,
            command_delay_us=delays_of(merged(axis.command for axis in self.axes)),
            commands_acting=acting,
            commands_lost=lost,
            commands_not_sent=not_sent,
            commands_passed_over=passed,
            commands_not_identifiable=int(command_fates[_NOT_IDENTIFIABLE]),
            command_loss_percent=100.0 * (lost + passed) / told if told else None,
            command_loss_least_percent=100.0 * lost / told if told else None,
            histogram=histogram_of(reading_times),
        )


def passed_over(rows: Rows) -> NDArray[np.bool_]:
    """Which commands, (n,), were lost or followed between two SYNCs only: they were there at a SYNC, not
    followed then, and replaced."""
    passed: NDArray[np.bool_] = (rows["command_fate"] == _NOT_IDENTIFIABLE) & (
        rows["command_acts_after"] != NOTHING
    )
    return passed


def runs_of(lost: NDArray[np.bool_]) -> tuple[int, ...]:
    """How often exactly 1, 2, ... were lost in a row."""
    edges = np.diff(lost.astype(np.int8), prepend=0, append=0)
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    return tuple(np.bincount(lengths)[1:].tolist()) if lengths.size else ()


STAMPED_WITHIN: Final = 4
"""Errors of the drive's clock: the interval in which a stamped command began to act is two of them long, and
the error may have halved until the row was written."""


def _stamped(acting: Rows) -> NDArray[np.bool_]:
    """Which commands are known to act from then on because the drive has stamped it, (n,).

    Of the others it is known between which SYNCs: that bounds a delay by a period, however short it was.
    Where most were stamped, the others are those whose frame was lost: of their delay that tells nothing, and
    they are left out.
    """
    error_ns = np.maximum(acting["clock_error_ns"], 0)
    fine: NDArray[np.bool_] = (
        acting["command_acts_by"] - acting["command_acts_after"] <= STAMPED_WITHIN * error_ns
    )
    return fine


def action_delays_ns(came: Rows, period_ns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """From the sample to the actuation that can first rest on it: the least and the most that it may be.

    That actuation is by the command of the sample's own cycle, or of a later one if the reading came after
    it. A drive that tells its torque demand tells it at SYNCs: the command acts after one and by the next.
    ``came``: (n,) of ROW_DTYPE with usable readings only; (m,) ns each, of the commands known to act.
    """
    acting = came.compress(came["command_fate"] == ACTING)
    late = acting["received_at"] - acting["command_handed_at"]
    behind = np.where(late > 0, -(-late // period_ns), 0) * period_ns - acting["sampled_at"]
    least: NDArray[np.int64] = acting["command_acts_after"] + behind
    most: NDArray[np.int64] = acting["command_acts_by"] + behind
    return least, most


def clocks_of(summary: Summary) -> dict[str, ClockHealth]:
    """Return the clock of each axis, from what the timing of the run rests on."""
    clocks = {}
    for name, told in (summary.timing or {}).get("axes", {}).items():
        clock = told.get("clock", {})
        clocks[name] = ClockHealth(
            drift_ppm=clock.get("drift_ppm"),
            drift_error_ppm=clock.get("drift_error_ppm"),
            error_us=told["error_us_max"],
            steps=told["clock_steps"],
            readbacks_unordered=told.get("readbacks_unordered", 0),
        )
    return clocks


def delays_of(times: TimeHistogram) -> DelayFigures | None:
    """Quantiles, us; None of no times."""
    quantiles = [times.quantile_ns(share) for share in (0.5, 0.99, 0.999)]
    p50, p99, p999 = (None if value is None else value / NS_PER_US for value in quantiles)
    largest = times.largest_ns
    if p50 is None or p99 is None or p999 is None or largest is None:
        return None
    return DelayFigures(p50=p50, p99=p99, p999=p999, max=largest / NS_PER_US)


def histogram_of(times: TimeHistogram) -> DelayHistogram | None:
    """A hundred bars from 0 up, without empty ones at the ends; None of no times."""
    largest = times.largest_ns
    if largest is None:
        return None
    width_us = max(1, math.ceil(largest / NS_PER_US / _BARS))
    counts = times.bars(width_us * NS_PER_US, _BARS)
    filled = np.flatnonzero(counts)
    first, last = int(filled[0]), int(filled[-1])
    edges = tuple(float(width_us * place) for place in range(first, last + 2))
    return DelayHistogram(edges_us=edges, counts=tuple(counts[first : last + 1].tolist()))
