"""What the network did to the readings of a run, from its records."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.timebase import NS_PER_US
from hil.configuration.network_file import (
    ClockHealth,
    DelayFigures,
    DelayHistogram,
    Network,
)
from hil.loop.samples import CommandFate, DropoutCause
from hil.reviewing.histogram import TimeHistogram
from hil.rows.records import CAUSES, COMMAND_FATES, FATE_SAMPLE, NOTHING, Rows
from hil.verdict.summary import Summary

_BARS = 100
"""The largest delay is told to a percent, in bars of whole us."""
ACTING, LOST, _NOT_IDENTIFIABLE = (
    COMMAND_FATES.index(fate) for fate in (CommandFate.ACTING, CommandFate.LOST, CommandFate.NOT_IDENTIFIABLE)
)
_RUN_MAX = 1000
"""Losses in a row that are counted apart; more count as so many."""


class LossRuns:
    """How often so many in a row were lost, over all axes."""

    def __init__(self, axes: int) -> None:
        self._ended = np.zeros(_RUN_MAX + 1, np.int64)
        self._open = [0] * axes
        """Losses in a row that have not ended yet, by axis."""

    def add(self, axis: int, lost: NDArray[np.bool_]) -> None:
        """Take in which of the next ones of an axis were lost, (n,)."""
        kept = np.flatnonzero(~lost)
        if not kept.size:
            self._open[axis] += lost.size
            return
        lengths = np.diff(kept, prepend=-1) - 1
        lengths[0] += self._open[axis]
        self._ended += np.bincount(np.minimum(lengths[lengths > 0], _RUN_MAX), minlength=_RUN_MAX + 1)
        self._open[axis] = int(lost.size - 1 - kept[-1])

    def counts(self) -> tuple[int, ...]:
        """Of runs of 1, 2, ... to the longest, with those that have not ended."""
        counts = self._ended.copy()
        for length in filter(None, self._open):
            counts[min(length, _RUN_MAX)] += 1
        return tuple(np.trim_zeros(counts[1:], "b").tolist())


class NetworkMeter:
    """Feed it rows in the order of recording; any division into chunks gives the same network."""

    def __init__(self, period_us: int, axes: int) -> None:
        self._period_us = period_us
        self._reading, self._command = TimeHistogram(), TimeHistogram()
        self._action_least, self._action = TimeHistogram(), TimeHistogram()
        self._stamped_least, self._stamped = TimeHistogram(), TimeHistogram()
        """The same of the commands whose acting the drive has stamped."""
        self._unstamped = np.zeros(axes, np.int64)
        """Acting commands without such a stamp less those with one, by axis."""
        self._command_fates = np.zeros(len(COMMAND_FATES), np.int64)
        self._command_runs, self._command_runs_least = LossRuns(axes), LossRuns(axes)
        """Of commands that were lost or passed over; of those that were lost for certain."""
        self._passed = 0
        self._uncertain = 0
        self._fates = np.zeros(len(CAUSES) + 1, np.int64)
        self._runs = LossRuns(axes)

    def add(self, rows: Rows) -> None:
        """Take in ``rows``: (n,) of ROW_DTYPE, each axis in order of sequence."""
        if not rows.size:
            return
        self._fates += np.bincount(rows["fate"], minlength=self._fates.size)
        self._uncertain += int(np.count_nonzero(rows["certain"] == 0))
        came = rows[rows["fate"] == FATE_SAMPLE]
        self._reading.add(came["received_at"] - came["sampled_at"])
        on_bus = rows[rows["command_on_bus_at"] != NOTHING]
        self._command.add(on_bus["command_on_bus_at"] - on_bus["command_handed_at"])
        acting = came[came["command_fate"] == ACTING]
        least, most = action_delays_ns(acting, self._period_us * NS_PER_US)
        self._action_least.add(least)
        self._action.add(most)
        stamped = _stamped(acting)
        self._stamped_least.add(least[stamped])
        self._stamped.add(most[stamped])
        np.add.at(self._unstamped, acting["axis"], np.where(stamped, -1, 1))
        fates = rows["command_fate"]
        self._command_fates += np.bincount(fates[fates != NOTHING], minlength=len(COMMAND_FATES))
        self._passed += int(np.count_nonzero(passed_over(rows)))
        for axis in range(self._unstamped.size):
            mine = rows[rows["axis"] == axis]
            self._runs.add(axis, mine["fate"] != FATE_SAMPLE)
            told = mine["command_fate"]
            passed = passed_over(mine)
            known = (told == ACTING) | (told == LOST) | passed
            self._command_runs.add(axis, (told != ACTING)[known])
            self._command_runs_least.add(axis, (told == LOST)[known])

    @property
    def command_losses_least(self) -> int:
        """Most commands that were lost in a row for certain."""
        return len(self._command_runs_least.counts())

    def network(self) -> Network | None:
        """The network so far; None before the first reading."""
        reading = delays_of(self._reading)
        if reading is None:
            return None
        runs = self._runs.counts()
        stamped = bool((self._unstamped <= 0).all())
        action = delays_of(self._stamped if stamped else self._action)
        acting, lost = (int(self._command_fates[place]) for place in (ACTING, LOST))
        told = acting + lost + self._passed
        count = {cause: int(self._fates[place]) for place, cause in enumerate(CAUSES, start=1)}
        total = int(self._fates.sum())
        return Network(
            period_us=self._period_us,
            losses_in_a_row_max=len(runs),
            delay_max_us=math.ceil(reading.max if action is None else action.max),
            commands="not measured" if action is None else "measured",
            command_losses_in_a_row_max=len(self._command_runs.counts()),
            cycles=total,
            lost=count[DropoutCause.LOST],
            late=count[DropoutCause.LATE],
            stale=count[DropoutCause.STALE],
            missed=count[DropoutCause.MISSED],
            uncertain_percent=100.0 * self._uncertain / total,
            loss_percent=100.0 * sum(count.values()) / total,
            losses_in_a_row=runs,
            reading_delay_us=reading,
            action_delay_us=action,
            action_delay_least_us=delays_of(self._stamped_least if stamped else self._action_least),
            command_delay_us=delays_of(self._command),
            commands_acting=acting,
            commands_lost=lost,
            commands_passed_over=self._passed,
            commands_not_identifiable=int(self._command_fates[_NOT_IDENTIFIABLE]),
            command_loss_percent=100.0 * (lost + self._passed) / told if told else None,
            command_loss_least_percent=100.0 * lost / told if told else None,
            histogram=histogram_of(self._reading),
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
    acting = came[came["command_fate"] == ACTING]
    late = acting["received_at"] - acting["command_handed_at"]
    behind = np.where(late > 0, -(-late // period_ns), 0) * period_ns - acting["sampled_at"]
    least: NDArray[np.int64] = acting["command_acts_after"] + behind
    most: NDArray[np.int64] = acting["command_acts_by"] + behind
    return least, most


def clocks_of(summary: Summary) -> dict[str, ClockHealth]:
    """Of each axis, from what the timing of the run rests on."""
    clocks = {}
    for name, told in (summary.timing or {}).get("axes", {}).items():
        clock = told.get("clock", {})
        clocks[name] = ClockHealth(
            drift_ppm=clock.get("drift_ppm"),
            drift_error_ppm=clock.get("drift_error_ppm"),
            error_us=told["error_us_max"],
            steps=told["clock_steps"],
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
