"""What a run did to the loop of a certified controller, beside what its certificate allows.

The certificate is of the gain from load torque to speed error. The energy of the error up to any instant is
then at most gain^2 times that of the load: for a load step in a steady run, the rms of the error since the
step, over the torque of the step, is at most the gain at every instant. That is what is seen of it here:

    load       ___________/~~~~~~~~~~~~~~~~~~~~~
    error      |  mean  ||  rms about that mean, of ever longer times: the largest counts

The noise of the speed is in it too, so a gain that is seen is a little high. What the error did about its
mean before the step it goes on doing, whatever the load does to it; so the rms may be larger by the largest
of that, and not by more. A gain *at least* is what is left of the rms when so much is taken off.
"""

import math
from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.reviewing.premises import PremisesMeter
from hil.rows.recording_plan import AxisPlan
from hil.rows.records import FATE_SAMPLE, Rows

_STEP_MIN: Final = 0.01
"""Of the rated torque: below it, as where a load from a file sets in, the noise of the speed is larger than
the answer, and their ratio says nothing of the gain."""
_BEFORE: Final = 20
"""Readings of a steady run of which the mean before a load step is taken, at least: it is the speed error
that friction or the load of before leaves to a controller that does not integrate."""


class CertificateState(StrEnum):
    """What a run says of a certificate. Of several axes the first of this list is told."""

    EXCEEDED = "exceeded"
    """A counter-example: all premises were kept, and the certified figure was not."""
    LEFT = "premise left"
    NOT_KNOWN = "premises not known"
    NOT_MEASURED = "not measured"
    """No certified figure, or no load step in a steady run."""
    KEPT = "kept"


class CertificateMeter:
    """Feed it rows of its axis in order of sequence; any division into chunks gives the same figures."""

    def __init__(self, axis: AxisPlan, settling_ns: int) -> None:
        """``axis``: one with a certified controller."""
        assert axis.certified is not None
        self._certified = axis.certified
        self._premises = PremisesMeter(axis, axis.certified)
        self._settling_ns = settling_ns
        self._step_min_nm = _STEP_MIN * (axis.rated_torque_nm or 0.0)
        self._reference = self._load = 0.0
        self._changed_at: int | None = None
        self._before_sum, self._before = 0.0, 0
        self._before_low, self._before_high = math.inf, -math.inf
        self._step_nm = self._mean = self._noise = 0.0
        self._square_sum, self._since = 0.0, 0
        self.gain_seen: float | None = None
        """rad/s per N m; None: no load has changed in a steady run."""
        self.gain_least: float | None = None
        """The same, less what noise may make of it."""
        self._told = False
        self._exceeded: tuple[int, str] | None = None

    def add(self, rows: Rows) -> None:
        """Take in rows: (n,) of ROW_DTYPE."""
        if not rows.size:
            return
        self._premises.add(rows)
        for part in _stretches(rows):
            self._enter(float(part["reference_rad_s"][0]), float(part["load_torque_nm"][0]), part)
            self._take(part)

    def figures(self) -> dict[str, Any]:
        """For JSON: certified and seen, by what is certified."""
        certified, premises = self._certified, self._premises
        premises.look()
        left, unknown = list(premises.left()), list(premises.unknown())
        return {
            "delay_us": {
                # by SYNC read-backs a command is known to act between two SYNCs only
                **_pair(certified.delay_us, premises.delay_least_us),
                "seen_at_most": premises.delay_most_us,
            },
            "losses_in_a_row": _pair(certified.losses_in_a_row, premises.losses),
            "gain_rad_s_nm": {**_pair(certified.gain, self.gain_seen), "seen_at_least": self.gain_least},
            "current_bandwidth_hz": {
                "certified": None if certified.bandwidths_hz is None else list(certified.bandwidths_hz),
                "drive": certified.bandwidth_hz,
            },
            "commands_at_a_limit": premises.saturated,
            "premises_left": left,
            "premises_unknown": unknown,
            "state": self._state(left, unknown).value,
        }

    def _state(self, left: list[str], unknown: list[str]) -> CertificateState:
        if left:
            return CertificateState.LEFT
        if unknown:
            return CertificateState.NOT_KNOWN
        if self._certified.gain is None or self.gain_least is None:
            return CertificateState.NOT_MEASURED
        exceeded = self.gain_least > self._certified.gain
        return CertificateState.EXCEEDED if exceeded else CertificateState.KEPT

    def _enter(self, reference: float, load: float, part: Rows) -> None:
        """A stretch begins, or goes on from the last chunk."""
        if self._changed_at is not None and (reference, load) == (self._reference, self._load):
            return
        steady = reference == self._reference and self._before >= _BEFORE
        step_nm = load - self._load
        self._step_nm = step_nm if steady and abs(step_nm) >= self._step_min_nm else 0.0
        self._mean = self._before_sum / self._before if self._before else 0.0
        self._noise = max(self._mean - self._before_low, self._before_high - self._mean, 0.0)
        self._square_sum, self._since = 0.0, 0
        self._before_sum, self._before = 0.0, 0
        self._before_low, self._before_high = math.inf, -math.inf
        self._reference, self._load, self._changed_at = reference, load, int(part["due_at"][0])

    def _take(self, part: Rows) -> None:
        assert self._changed_at is not None
        self._premises.count_limited(part, self._step_nm != 0.0)
        came = part[part["fate"] == FATE_SAMPLE]
        if not came.size:
            return
        error = self._reference - came["velocity_rad_s"]
        settled = error[came["due_at"] - self._changed_at >= self._settling_ns]
        self._before_sum = _added(self._before_sum, settled)
        self._before += settled.size
        self._before_low = min(self._before_low, float(settled.min(initial=math.inf)))
        self._before_high = max(self._before_high, float(settled.max(initial=-math.inf)))
        if self._step_nm == 0.0:
            return
        squares = np.cumsum(np.concatenate(([self._square_sum], (error - self._mean) ** 2)))[1:]
        rms = np.sqrt(squares / np.arange(self._since + 1, self._since + 1 + squares.size))
        seen = float(rms.max()) / abs(self._step_nm)
        self.gain_seen = max(seen, self.gain_seen or 0.0)
        least = max(0.0, float(rms.max()) - self._noise) / abs(self._step_nm)
        self.gain_least = max(least, self.gain_least or 0.0)
        self._hold_against(rms, came["due_at"])
        self._square_sum, self._since = float(squares[-1]), self._since + squares.size

    def take_exceeded(self) -> tuple[int, str] | None:
        """When the gain was first above the certified one, noise apart, ns, and in words; told once."""
        exceeded, self._exceeded = self._exceeded, None
        return exceeded

    def _hold_against(self, rms: NDArray[np.float64], due_at: NDArray[np.int64]) -> None:
        gain = self._certified.gain
        if self._told or gain is None:
            return
        above = np.flatnonzero(rms - self._noise > gain * abs(self._step_nm))
        if above.size:
            self._told = True
            seen = float(rms[above[0]]) / abs(self._step_nm)
            text = f"the gain from load to speed error is {seen:.4g} rad/s per N m, certified {gain:.4g}"
            self._exceeded = int(due_at[above[0]]), text


def _stretches(rows: Rows) -> Iterator[Rows]:
    """The rows, divided where reference or load change."""
    changed = (np.diff(rows["reference_rad_s"]) != 0.0) | (np.diff(rows["load_torque_nm"]) != 0.0)
    yield from np.split(rows, np.flatnonzero(changed) + 1)


def _added(total: float, values: NDArray[np.float64]) -> float:
    """From left to right, so that the sum does not depend on the chunk."""
    return float(np.cumsum(np.concatenate(([total], values)))[-1])


def _pair(certified: float | None, seen: float | None) -> Mapping[str, float | None]:
    return {"certified": certified, "seen": seen}
