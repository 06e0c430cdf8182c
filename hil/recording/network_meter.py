"""What the network did to the readings of a run, from its records: ``network.toml`` in the run's folder."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.timebase import NS_PER_US
from hil.configuration.network_file import (
    NETWORK_FILE,
    DelayHistogram,
    Delays,
    Network,
    network_text,
)
from hil.figures.histogram import TimeHistogram
from hil.figures.summary import Summary
from hil.recording.records import CAUSES, FATE_SAMPLE, Rows
from hil.recording.side_rows import RunEvent
from hil.samples import DropoutCause

_BARS = 100
_RUN_MAX = 1000
"""Losses in a row that are counted apart; more count as so many."""


class NetworkMeter:
    """Feed it rows in the order of recording; any division into chunks gives the same network."""

    def __init__(self, period_us: int, axes: int) -> None:
        self._period_us = period_us
        self._reading, self._action = TimeHistogram(), TimeHistogram()
        self._fates = np.zeros(len(CAUSES) + 1, np.int64)
        self._runs = np.zeros(_RUN_MAX + 1, np.int64)
        self._open = [0] * axes
        """Losses in a row that have not ended yet, by axis."""

    def add(self, rows: Rows) -> None:
        """Take in ``rows``: (n,) of ROW_DTYPE, each axis in order of sequence."""
        if not rows.size:
            return
        self._fates += np.bincount(rows["fate"], minlength=self._fates.size)
        came = rows[rows["fate"] == FATE_SAMPLE]
        self._reading.add(came["received_at"] - came["observation_at"])
        self._action.add(action_delay_ns(came, self._period_us * NS_PER_US))
        for axis in range(len(self._open)):
            self._count_runs(axis, rows["fate"][rows["axis"] == axis] != FATE_SAMPLE)

    def network(self) -> Network | None:
        """The network so far; None before the first reading."""
        runs = self._runs.copy()
        for still_open in self._open:
            runs[min(still_open, _RUN_MAX)] += 1 if still_open else 0
        longest = int(np.flatnonzero(runs)[-1]) if runs.any() else 0
        reading, action = _delays(self._reading), _delays(self._action)
        if reading is None or action is None:
            return None
        count = {cause: int(self._fates[place]) for place, cause in enumerate(CAUSES, start=1)}
        total = int(self._fates.sum())
        return Network(
            period_us=self._period_us,
            losses_in_a_row_max=longest,
            delay_max_us=math.ceil(action.max),
            cycles=total,
            lost=count[DropoutCause.LOST],
            late=count[DropoutCause.LATE],
            stale=count[DropoutCause.STALE],
            loss_percent=100.0 * sum(count.values()) / total,
            losses_in_a_row=tuple(runs[1 : longest + 1].tolist()),
            reading_delay_us=reading,
            action_delay_us=action,
            histogram=_histogram(self._reading),
        )

    def _count_runs(self, axis: int, missing: NDArray[np.bool_]) -> None:
        if not missing.size:
            return
        present = np.flatnonzero(~missing)
        if not present.size:
            self._open[axis] += missing.size
            return
        lengths = np.diff(np.concatenate([[-1], present])) - 1
        lengths[0] += self._open[axis]
        self._runs += np.bincount(np.minimum(lengths[lengths > 0], _RUN_MAX), minlength=_RUN_MAX + 1)
        self._open[axis] = int(missing.size - 1 - present[-1])


def action_delay_ns(came: Rows, period_ns: int) -> NDArray[np.int64]:
    """From the sample to the first actuation that can rest on it: that of its own cycle, or a later one's.

    ``came``: (n,) of ROW_DTYPE with usable readings only.
    """
    late = came["received_at"] - came["command_sent_at"]
    behind = np.where((late > 0) & (came["command_sent_at"] >= 0), -(-late // period_ns), 0)
    found: NDArray[np.int64] = came["command_effective_at"] + behind * period_ns - came["observation_at"]
    return found


class NetworkKeeper:
    """network.toml."""

    name = NETWORK_FILE

    def __init__(self, folder: Path, period_us: int, axes: int) -> None:
        self._path = folder / NETWORK_FILE
        self._meter = NetworkMeter(period_us, axes)

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:  # noqa: ARG002
        self._meter.add(rows)

    def flush(self) -> None:
        """Written at the end."""

    def finish(self, summary: Summary) -> None:  # noqa: ARG002
        found = self._meter.network()
        if found is not None:
            self._path.write_text(network_text(found), encoding="utf-8")


def _delays(times: TimeHistogram) -> Delays | None:
    quantiles = [times.quantile_ns(share) for share in (0.5, 0.99, 0.999)]
    p50, p99, p999 = (None if value is None else value / NS_PER_US for value in quantiles)
    largest = times.largest_ns
    if p50 is None or p99 is None or p999 is None or largest is None:
        return None
    return Delays(p50=p50, p99=p99, p999=p999, max=largest / NS_PER_US)


def _histogram(times: TimeHistogram) -> DelayHistogram | None:
    largest = times.largest_ns
    if largest is None:
        return None
    width_us = max(1, math.ceil(largest / NS_PER_US / _BARS))
    counts = times.bars(width_us * NS_PER_US, _BARS)
    filled = np.flatnonzero(counts)
    first, last = int(filled[0]), int(filled[-1])
    edges = tuple(float(width_us * place) for place in range(first, last + 2))
    return DelayHistogram(edges_us=edges, counts=tuple(counts[first : last + 1].tolist()))
