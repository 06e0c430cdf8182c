"""What a run came to: the figures, the limits they were held against, and the verdict.

The figures rest on the cycle records alone (see :mod:`hil.figures.review`), never on the telemetry.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

_METRICS = {
    "speed_error_peak_percent_max": "speed error, peak [%]",
    "after_load_percent_max": "speed error after load step [%]",
    "speed_error_rms_rad_s_max": "speed error, RMS [rad/s]",
    "dropouts_percent_max": "dropouts [%]",
    "delay_p99_us_max": "delay p99 [us]",
    "bus_load_percent_max": "bus load [%]",
    "missed_percent_max": "cycles without SYNC [%]",
    "lateness_us_max": "lateness, largest [us]",
}


@dataclass(frozen=True, slots=True)
class VerdictLimits:
    """Upper limits that a run must keep; None: not asked for. The names are those of the bench file."""

    speed_error_peak_percent_max: float | None = None
    after_load_percent_max: float | None = None
    speed_error_rms_rad_s_max: float | None = None
    dropouts_percent_max: float | None = None
    delay_p99_us_max: float | None = None
    bus_load_percent_max: float | None = None
    missed_percent_max: float | None = None
    lateness_us_max: float | None = None


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Of a time, us; None where nothing was measured. The resolution is 0.1 %, ``max`` is exact."""

    p50: float | None
    p99: float | None
    max: float | None


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
    """Reference minus measured speed, worst axis; None: no cycle counts (:mod:`hil.figures.speed_error`)."""

    peak_rad_s: float | None
    peak_percent: float | None
    rms_rad_s: float | None
    after_load_percent: float | None


@dataclass(frozen=True, slots=True)
class Figures:
    """What the records alone tell."""

    cycles: int
    """Control cycles: the rows of the axis that has most."""
    rows: int
    """Records over all axes; the base of ``dropouts_percent``."""
    dropouts: DropoutCounts
    delay_us: Percentiles
    """Sampled to received, of every reading that came, late ones included."""
    speed_error: SpeedError
    lateness_us: Percentiles
    """Woke minus due, of every cycle."""
    digest: str
    """BLAKE2b, 128 bit, hex, over the packed rows in order of recording (:mod:`hil.recording.records`)."""

    @property
    def dropouts_percent(self) -> float | None:
        return 100.0 * self.dropouts.total / self.rows if self.rows else None

    @property
    def missed_percent(self) -> float | None:
        return 100.0 * self.dropouts.missed / self.rows if self.rows else None


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """What the records cannot tell; handed over when the run ends."""

    bus_load_percent: float | None
    """None: not measured."""
    realtime_factor: float | None
    """Bench time over wall time; None: not measured."""
    completed: bool = True
    """False if the run was cut short; such a run never passes."""
    reason: str = ""
    """Why it was cut short."""
    network_notes: Sequence[str] = ()
    """In what the network was worse than a controller was made for; only where the run was to go on."""
    load_machine: Mapping[str, Any] | None = None
    """What the instrument that made the load came to, if there was one."""
    timing: Mapping[str, Any] | None = None
    """What the timing rests on (:mod:`hil.timing_report`)."""
    distrust: Sequence[str] = ()
    """Why what the run says of its timing is not to be trusted; such a run never passes."""


@dataclass(frozen=True, slots=True)
class Check:
    """One limit and what was found. A value that was not measured fails."""

    metric: str
    value: float | None
    limit: float
    passed: bool


@dataclass(frozen=True, slots=True)
class Verdict:
    """Passed if the run was completed and every limit kept."""

    passed: bool
    completed: bool
    reason: str
    limits: tuple[Check, ...]
    distrust: tuple[str, ...] = ()
    """Why the timing is not to be trusted."""


def judge(figures: Figures, outcome: RunOutcome, limits: VerdictLimits) -> Verdict:
    """Hold the figures against the limits of the bench file."""
    values = {
        "speed_error_peak_percent_max": figures.speed_error.peak_percent,
        "after_load_percent_max": figures.speed_error.after_load_percent,
        "speed_error_rms_rad_s_max": figures.speed_error.rms_rad_s,
        "dropouts_percent_max": figures.dropouts_percent,
        "delay_p99_us_max": figures.delay_us.p99,
        "bus_load_percent_max": outcome.bus_load_percent,
        "missed_percent_max": figures.missed_percent,
        "lateness_us_max": figures.lateness_us.max,
    }
    checks = tuple(
        Check(key, value, limit, value is not None and value <= limit)
        for key, value in values.items()
        if (limit := getattr(limits, key)) is not None
    )
    distrust = tuple(outcome.distrust)
    passed = outcome.completed and not distrust and all(check.passed for check in checks)
    reason = outcome.reason
    if distrust and not reason:
        reason = f"not trustworthy: {'; '.join(distrust)}"
    return Verdict(passed, outcome.completed, reason, checks, distrust)


def metric_title(key: str) -> str:
    """A limit's key in the words of a reader, with its unit."""
    return _METRICS[key]


@dataclass(frozen=True, slots=True)
class Summary:
    """The whole of a run; ``as_json`` is what ``hil run --json`` prints."""

    cycles: int
    dropouts: DropoutCounts
    delay_us: Percentiles
    speed_error: SpeedError
    bus_load_percent: float | None
    realtime_factor: float | None
    lateness_us: Percentiles
    verdict: Verdict
    recording: str
    """The folder of the run; empty if nothing was kept."""
    seed: int
    digest: str
    recording_faults: tuple[str, ...] = ()
    """What the recording lacks, e.g. rows that found the ring full or a file on a full disk."""
    network_notes: tuple[str, ...] = ()
    """In what the network was worse than a controller was made for."""
    load_machine: Mapping[str, Any] | None = None
    """Identity, tally, and for each load step the torque asked for and measured (:mod:`hil.instrument`)."""
    timing: Mapping[str, Any] | None = None
    """What the timing rests on (:mod:`hil.timing_report`)."""

    def as_json(self) -> dict[str, Any]:
        """Plain dicts, lists, numbers, strings and None; what there is none of at the end is left out."""
        found = asdict(self)
        for name in ("recording_faults", "network_notes", "load_machine", "timing"):
            if not found[name]:
                del found[name]
        return found

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> "Summary":
        """Inverse of :meth:`as_json`."""
        values = dict(found)
        values["dropouts"] = DropoutCounts(**values["dropouts"])
        values["delay_us"] = Percentiles(**values["delay_us"])
        values["lateness_us"] = Percentiles(**values["lateness_us"])
        values["speed_error"] = SpeedError(**values["speed_error"])
        verdict = dict(values["verdict"])
        verdict["limits"] = tuple(Check(**check) for check in verdict["limits"])
        verdict["distrust"] = tuple(verdict.get("distrust", ()))
        values["verdict"] = Verdict(**verdict)
        for name in ("recording_faults", "network_notes"):
            values[name] = tuple(values.get(name, ()))
        return cls(**values)


def summarise(
    figures: Figures,
    outcome: RunOutcome,
    limits: VerdictLimits,
    recording: str,
    seed: int,
    recording_faults: tuple[str, ...] = (),
) -> Summary:
    """Figures, outcome and verdict in one. What was not recorded has not passed."""
    verdict = judge(figures, outcome, limits)
    if recording_faults:
        reason = verdict.reason or f"not recorded: {'; '.join(recording_faults)}"
        verdict = replace(verdict, passed=False, reason=reason)
    shared = {field.name for field in fields(Figures)} & {field.name for field in fields(Summary)}
    return Summary(
        **{name: getattr(figures, name) for name in shared},
        bus_load_percent=outcome.bus_load_percent,
        realtime_factor=outcome.realtime_factor,
        verdict=verdict,
        recording=recording,
        seed=seed,
        recording_faults=recording_faults,
        network_notes=tuple(outcome.network_notes),
        load_machine=outcome.load_machine,
        timing=outcome.timing,
    )
