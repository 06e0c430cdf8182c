"""The summary of a run: its figures, its verdict, and its basis.

The figures rest on the cycle records alone (see :mod:`servobench.hil.reviewing.review`), never on the
telemetry.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from servobench.hil.verdict.verdict import (
    CycleCount,
    Demand,
    DriveEnd,
    Finding,
    RunOutcome,
    RunVerdict,
    VerdictKind,
    VerdictLimits,
    WorstPlace,
    judge,
    not_run,
)


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

    Which cycles count: :mod:`servobench.hil.reviewing.speed_error`.
    """

    peak_rad_s: float | None
    peak_percent: float | None
    rms_rad_s: float | None
    after_load_percent: float | None


@dataclass(frozen=True, slots=True)
class StepResponse:
    """Worst step and axis (:mod:`servobench.hil.reviewing.step_response`); None: no step, or one that did not
    settle."""

    settling_time_ms: float | None = None
    overshoot_percent: float | None = None
    recovery_time_ms: float | None = None
    """Recovery after a step of the load."""


@dataclass(frozen=True, slots=True)
class PositionError:
    """Position errors of the worst axis; None: not measured. Definitions:
    :mod:`servobench.hil.reviewing.position_error`."""

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
    """Records over all axes; the base of ``dropouts_percent``."""
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
    (:mod:`servobench.hil.rows.records`)."""
    torque_rms_nm: float | None = None
    """About its mean at steady reference and load, worst axis and block
    (:mod:`servobench.hil.reviewing.torque_swing`); None: there was no such block."""
    position_error: PositionError = NO_POSITIONS
    certificates: Mapping[str, Any] = field(default_factory=dict)
    """By axis with a certified controller: certified and seen
    (:mod:`servobench.hil.reviewing.certificate_meter`)."""
    step_response: StepResponse = StepResponse()
    reading_losses_in_a_row: int = 0
    """Cycles in a row without a usable reading, worst axis."""
    command_losses_in_a_row: int | None = None
    """Consecutive commands lost or passed over, worst axis; None: no fate is known."""
    command_losses_in_a_row_least: int | None = None
    """The same: certain losses."""
    worst: Mapping[str, WorstPlace] = field(default_factory=dict)
    """Place of the worst value, by the names of :class:`VerdictLimits`, if it has one."""

    @property
    def dropouts_percent(self) -> float | None:
        return 100.0 * self.dropouts.total / self.rows if self.rows else None

    @property
    def missed_percent(self) -> float | None:
        return 100.0 * self.dropouts.missed / self.rows if self.rows else None


_LIMITED: dict[str, tuple[str, Callable[[Figures, RunOutcome], float | None]]] = {
    "speed_error_peak_percent_max": ("speed error, peak [%]", lambda run, _: run.speed_error.peak_percent),
    "after_load_percent_max": (
        "speed error after load step [%]",
        lambda run, _: run.speed_error.after_load_percent,
    ),
    "speed_error_rms_rad_s_max": ("speed error, RMS [rad/s]", lambda run, _: run.speed_error.rms_rad_s),
    "dropouts_percent_max": ("dropouts [%]", lambda run, _: run.dropouts_percent),
    "delay_p99_us_max": ("delay of readings, p99 [us]", lambda run, _: run.reading_delay_us.p99),
    "bus_load_percent_max": ("bus load [%]", lambda _, outcome: outcome.bus_load_percent),
    "missed_percent_max": ("cycles without SYNC [%]", lambda run, _: run.missed_percent),
    "lateness_us_max": ("lateness, largest [us]", lambda run, _: run.lateness_us.max),
    "compute_us_max": ("computing time, largest [us]", lambda run, _: run.compute_us.max),
    "torque_rms_nm_max": ("torque about its mean, rms [N m]", lambda run, _: run.torque_rms_nm),
    "settling_time_ms_max": ("settling after a step [ms]", lambda run, _: run.step_response.settling_time_ms),
    "overshoot_percent_max": ("overshoot of a step [%]", lambda run, _: run.step_response.overshoot_percent),
    "recovery_time_ms_max": (
        "recovery after a load step [ms]",
        lambda run, _: run.step_response.recovery_time_ms,
    ),
    "losses_in_a_row_max": (
        "readings lost in a row",
        lambda run, _: run.reading_losses_in_a_row if run.rows else None,
    ),
    "position_error_peak_rad_max": ("position error, peak [rad]", lambda run, _: run.position_error.peak_rad),
    "position_error_rms_rad_max": ("position error, RMS [rad]", lambda run, _: run.position_error.rms_rad),
    "following_error_peak_rad_max": (
        "following error, peak [rad]",
        lambda run, _: run.position_error.following_peak_rad,
    ),
}
"""By the names of the limits: title with unit, and the value to compare; None: not measured."""
_TITLES = {key: title for key, (title, _) in _LIMITED.items()} | {
    "certified_action_delay_us": "certified: delay to actuation [us]",
    "certified_losses_together": "certified: lost in a row, together",
    "certified_commands_at_a_limit": "certified: commands at a limit",
    "certified_gain_rad_s_nm": "certified: gain [rad/s per N m]",
}


def metric_title(key: str) -> str:
    """Return a limit's key in a reader's words, with its unit."""
    return _TITLES[key]


@dataclass(frozen=True, slots=True)
class Summary:
    """``as_json`` is the output of ``hil run --json``, at every exit."""

    cycles: int
    dropouts: DropoutCounts
    reading_delay_us: Percentiles
    speed_error: SpeedError
    bus_load_percent: float | None
    realtime_factor: float | None
    lateness_us: Percentiles
    compute_us: Percentiles
    verdict: RunVerdict
    recording: str
    """The folder of the run; empty if nothing was kept."""
    seed: int | None
    digest: str
    drives: tuple[DriveEnd, ...] = ()
    """State of each drive after the cycles."""
    torque_rms_nm: float | None = None
    step_response: StepResponse = StepResponse()
    action_delay_us: Percentiles = NO_TIMES
    action_delay_least_us: Percentiles = NO_TIMES
    reading_losses_in_a_row: int = 0
    command_losses_in_a_row: int | None = None
    command_losses_in_a_row_least: int | None = None
    position_error: PositionError = NO_POSITIONS
    certificates: Mapping[str, Any] = field(default_factory=dict)
    recording_faults: tuple[str, ...] = ()
    """Gaps in the recording, e.g. rows that found the ring full or a file on a full disk."""
    network_notes: tuple[str, ...] = ()
    """Aspects in which the network was worse than a controller was made for."""
    load_machine: Mapping[str, Any] | None = None
    """Identity, tally, requested and measured torque at each load step
    (:mod:`servobench.hil.load.load_machines`)."""
    timing: Mapping[str, Any] | None = None
    """Basis of the timing (:mod:`servobench.hil.execution.timing_report`)."""

    def also(self, finding: Finding) -> "Summary":
        """Return the summary with a later finding."""
        return replace(self, verdict=self.verdict.also(finding))

    def as_json(self) -> dict[str, Any]:
        """Return plain dicts, lists, numbers, strings and None; missing parts at the end are left out."""
        plain = asdict(self)
        for name in ("certificates", "recording_faults", "network_notes", "load_machine", "timing"):
            if not plain[name]:
                del plain[name]
        return plain


def summarise(
    figures: Figures,
    outcome: RunOutcome,
    limits: VerdictLimits,
    recording: str,
    seed: int,
    recording_faults: tuple[str, ...] = (),
    certified: Sequence[Demand] = (),
) -> Summary:
    """Join figures, outcome and verdict; ``certified``: demands besides the limits."""
    shared = {each.name for each in fields(Figures)} & {each.name for each in fields(Summary)}
    count = CycleCount(figures.dense, figures.rows, figures.dropouts.missed)
    values = {key: value(figures, outcome) for key, (_, value) in _LIMITED.items()}
    return Summary(
        **{name: getattr(figures, name) for name in shared},
        bus_load_percent=outcome.bus_load_percent,
        realtime_factor=outcome.realtime_factor,
        verdict=judge(outcome, count, values, limits, "; ".join(recording_faults), figures.worst, certified),
        recording=recording,
        seed=seed,
        drives=outcome.drives,
        recording_faults=recording_faults,
        network_notes=outcome.network_notes,
        load_machine=outcome.load_machine,
        timing=outcome.timing,
    )


def summary_without_run(outcome: VerdictKind, reason: str) -> Summary:
    """Return the summary of a run that ended before it began: no cycle, and nothing measured."""
    return Summary(
        cycles=0,
        dropouts=DropoutCounts(0, 0, 0, 0),
        reading_delay_us=NO_TIMES,
        speed_error=SpeedError(None, None, None, None),
        bus_load_percent=None,
        realtime_factor=None,
        lateness_us=NO_TIMES,
        compute_us=NO_TIMES,
        verdict=not_run(outcome, reason),
        recording="",
        seed=None,
        digest="",
    )
