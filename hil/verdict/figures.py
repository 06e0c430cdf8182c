"""Figures of a run, from its cycle records alone (see :mod:`servobench.hil.reviewing.review`)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class WorstPlace:
    """Origin of a value of a run."""

    axis: str = ""
    """Empty: no single axis."""
    at_ns: int | None = None
    """When its cycle was due, run time; None: no single instant."""


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Percentiles of a time, us; None if nothing was measured. The resolution is 0.1 %, ``max`` is exact."""

    p50: float | None
    p99: float | None
    max: float | None


NO_TIMES = Percentiles(None, None, None)


@dataclass(frozen=True, slots=True)
class DropoutCounts:
    """Cycles without a usable reading, over all axes, by cause."""

    lost: int
    late: int
    stale: int
    missed: int
    """Cycles without SYNC."""

    @property
    def total(self) -> int:
        return self.lost + self.late + self.stale + self.missed


@dataclass(frozen=True, slots=True)
class SpeedError:
    """Reference minus measured speed, worst axis; None: no cycle counts.

    Which cycles count: :mod:`servobench.hil.reviewing.tracking_error`.
    """

    peak_rad_s: float | None
    peak_percent: float | None
    rms_rad_s: float | None
    after_load_percent: float | None


@dataclass(frozen=True, slots=True)
class StepResponse:
    """Worst step and axis (:mod:`servobench.hil.reviewing.review`); None: no step, or one that did not
    settle."""

    settling_time_ms: float | None = None
    overshoot_percent: float | None = None
    recovery_time_ms: float | None = None
    """Recovery after a step of the load."""


NO_STEPS = StepResponse()


@dataclass(frozen=True, slots=True)
class PositionError:
    """Position errors of the worst axis; None: not measured. Definitions:
    :mod:`servobench.hil.reviewing.tracking_error`."""

    peak_rad: float | None
    rms_rad: float | None
    following_peak_rad: float | None
    """Following error of a drive in csp."""


NO_POSITIONS = PositionError(None, None, None)


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures from the records alone."""

    cycles: int
    """Control cycles: the rows of the axis with most."""
    rows: int
    """Records over all axes; the base of shares such as that of dropouts."""
    dense: int
    """Cycles up to the first missing or double one in an axis."""
    dropouts: DropoutCounts
    reading_delay_us: Percentiles
    """Sampled to received, for every reading received, late ones included."""
    action_delay_us: Percentiles
    """Sampled to the first actuation that can depend on it: upper limit."""
    action_delay_least_us: Percentiles
    """The same: lower limit."""
    speed_error: SpeedError
    lateness_us: Percentiles
    """Woke minus due, for every cycle."""
    compute_us: Percentiles
    """Computing time of compensator and controller in a cycle, by the host's clock, over all axes."""
    digest: str
    """BLAKE2b, 128 bit, hex, over the packed rows in order of recording
    (:mod:`servobench.hil.loop.cycle_record`)."""
    torque_rms_nm: float | None = None
    """About its mean at steady reference and load, worst axis and block
    (:mod:`servobench.hil.reviewing.torque_swing`); None: there was no such block."""
    position_error: PositionError = NO_POSITIONS
    certificates: Mapping[str, Any] = field(default_factory=dict)
    """By axis with a certified controller: certified and seen
    (:mod:`servobench.hil.reviewing.certificate_meter`)."""
    step_response: StepResponse = NO_STEPS
    reading_losses_in_a_row: int = 0
    """Cycles in a row without a usable reading, worst axis."""
    command_losses_in_a_row: int | None = None
    """Consecutive commands lost or passed over, worst axis; None: no fate is known."""
    command_losses_in_a_row_least: int | None = None
    """The same: certain losses."""
    worst: Mapping[str, WorstPlace] = field(default_factory=dict)
    """Place of the worst value, by the names of the limits, if it has one."""
