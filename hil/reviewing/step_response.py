"""How an axis answers to a step of its reference, and how it comes back after a step of its load.

    reference  ____/~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
    speed         .'``'-.__-------.   .----------
    load       ___________________/~`'~~~~~~~~~~~
                   |settling| 2 % of the step
                                  |recovery| 2 % of the reference

A step counts until reference or load change again. What counts as a step of the reference is what opens a
settling window (:mod:`servobench.hil.reviewing.tracking_error`). One that was not within its band when it
ended has no time: then none is told, for a time that is not known is not the largest of those that are.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.timebase import NS_PER_MS
from servobench.hil.loop.cycle_record import FATE_SAMPLE
from servobench.hil.reviewing.envelope import Largest
from servobench.hil.reviewing.tracking_error import AskedChanges, worst
from servobench.hil.rows.recording_plan import AxisPlan
from servobench.hil.rows.records import Rows
from servobench.hil.verdict.figures import StepResponse


class _Step(NamedTuple):
    at: int
    of_load: bool
    target: float
    size: float
    """Size of the reference's step, with its sign; for a load that of the reference."""


class StepMeter:
    """Feed it rows of its axis in order of sequence; any division into chunks gives the same figures."""

    def __init__(self, axis: AxisPlan, band_percent: float) -> None:
        """``band_percent``: of the step, or of the reference: within it the speed has settled."""
        self._band = band_percent / 100.0
        self._asked = AskedChanges(axis.acceleration_max_rad_s2)
        self._open: _Step | None = None
        self._outside_at = self._seen_at = 0
        self._overshoot_rad_s = 0.0
        self._lasted = 0
        """Cycles since the step that is open."""
        self._settling, self._recovery, self._over = Largest(), Largest(), Largest()
        self._unsettled = [False, False]
        """A step of the reference, or of the load, did not come into its band."""

    def add(self, rows: Rows) -> None:
        """Take in rows: (n,) of ROW_DTYPE."""
        if not rows.size:
            return
        reference, due_at = rows["reference_rad_s"], rows["due_at"]
        step, load_step, stepped = self._asked.take(rows)
        loaded = (step == 0.0) & (load_step != 0.0) & (reference != 0.0)
        changes = np.append(np.flatnonzero((step != 0.0) | (load_step != 0.0)), rows.size)
        self._take(rows[: changes[0]])
        if changes.size > 1:
            self._close()
        # of a ramp every cycle is a change, and none is looked at; the last one may go on in the next rows
        stays = np.diff(changes) > 1
        stays[-1:] = True
        for place in np.flatnonzero(stepped[changes[:-1]] | (loaded[changes[:-1]] & stays)):
            start, end = int(changes[place]), int(changes[place + 1])
            of_load = bool(loaded[start])
            target = float(reference[start])
            self._open = _Step(int(due_at[start]), of_load, target, target if of_load else float(step[start]))
            self._outside_at, self._seen_at = self._open.at, -1
            self._overshoot_rad_s, self._lasted = 0.0, 0
            self._take(rows[start:end])
            if end < rows.size:
                self._close()

    def figures(self) -> StepResponse:
        """Return the figures of all steps so far, with the one that goes on."""
        if self._open is not None:
            self._look(self._open)
        return StepResponse(
            settling_time_ms=None if self.unsettled[False] else self._settling.value,
            overshoot_percent=self._over.value,
            recovery_time_ms=None if self.unsettled[True] else self._recovery.value,
        )

    @property
    def unsettled(self) -> list[bool]:
        """Tell whether a step of the reference, and one of the load, did not come into its band."""
        counts = list(self._unsettled)
        if self._open is not None:
            counts[self._open.of_load] |= self._outside_at == self._seen_at
        return counts

    @property
    def instants(self) -> tuple[int | None, int | None, int | None]:
        """When the steps were that the figures come from, ns, in their order."""
        return self._settling.at, self._over.at, self._recovery.at

    def _take(self, rows: Rows) -> None:
        step = self._open
        self._lasted += rows.size
        came = rows[rows["fate"] == FATE_SAMPLE]
        if step is None or not came.size:
            return
        beyond: NDArray[np.float64] = (came["velocity_rad_s"] - step.target) * math.copysign(1.0, step.size)
        outside = np.flatnonzero(np.abs(beyond) > self._band * abs(step.size))
        if outside.size:
            self._outside_at = int(came["due_at"][outside[-1]])
        self._seen_at = int(came["due_at"][-1])
        self._overshoot_rad_s = max(self._overshoot_rad_s, float(beyond.max()))

    def _close(self) -> None:
        if self._open is not None and not (self._open.of_load and self._lasted == 1):
            self._look(self._open)
            if self._outside_at == self._seen_at:
                self._unsettled[self._open.of_load] = True
        self._open = None  # a load that changes from cycle to cycle makes no steps

    def _look(self, step: _Step) -> None:
        time_ms = (self._outside_at - step.at) / NS_PER_MS
        (self._recovery if step.of_load else self._settling).note(step.at, time_ms)
        if not step.of_load:
            self._over.note(step.at, 100.0 * self._overshoot_rad_s / abs(step.size))


def worst_steps(meters: Sequence[StepMeter]) -> StepResponse:
    """The largest of each figure over the axes; None where a step of any axis did not settle."""
    settled, recovered = (not any(meter.unsettled[of_load] for meter in meters) for of_load in (False, True))
    response = worst(StepResponse, [meter.figures() for meter in meters])
    return replace(
        response,
        settling_time_ms=response.settling_time_ms if settled else None,
        recovery_time_ms=response.recovery_time_ms if recovered else None,
    )
