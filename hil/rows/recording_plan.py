"""What a recording needs to know before the first cycle; plain values that can be sent to another process."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.rows.records import DIGESTED
from servobench.hil.verdict.verdict import VerdictLimits

SETTLING = Duration(250_000_000)
"""Default of ``verdict.settling_ms``."""
SETTLING_BAND_PERCENT = 2.0
"""Default of ``verdict.settling_band_percent``: the usual one of step responses."""
SIMULATED_EPOCH = 1_000_000_000 * NS_PER_S
"""Where the first cycle of a simulated run lies in frames.log, ns since 1970: in September 2001, so that no
stamp is taken for a real one, and run times can be read off at sight."""


@dataclass(frozen=True, slots=True)
class CertifiedPlan:
    """For what an axis' controller is certified; None: its file does not say."""

    period_us: int
    delay_us: float | None = None
    """To actuation, at most."""
    losses_together: int | None = None
    """Readings and commands lost in a row, added, at most."""
    gain: float | None = None
    """From load torque to speed error, rad/s per N m, at most."""
    bandwidths_hz: tuple[float, float] | None = None
    """Of the drive's current loop, least and largest."""
    bandwidth_hz: float | None = None
    """That of the drive; None: not known."""
    torque_rms_nm_max: float | None = None
    """About its mean at steady reference and load; None: not asked for."""
    age_us: float | None = None
    """For which a sample acts, losses included, at most."""
    torque_step_max_nm: float | None = None
    """Limit of a command beside the one before it; None: there is none."""
    samples_alone: bool = False
    """Certified for lost samples, but neither for lost commands nor for a shorter delay."""
    left: tuple[str, ...] = ()
    """Premises that bench and drive do not keep, in words
    (:mod:`servobench.hil.reviewing.certificate_meter`)."""
    unknown: tuple[str, ...] = ()
    """Premises of which is not known whether they do."""


@dataclass(frozen=True, slots=True)
class AxisPlan:
    """One axis, as the review sees it."""

    name: str
    acceleration_max_rad_s2: float
    """What its torque limit and inertia allow; a reference that changes faster opens a settling window."""
    rated_torque_nm: float | None = None
    """Of the motor; None: how much its torque swings is not judged."""
    certified: CertifiedPlan | None = None
    """None: its controller has no certificate."""
    torque_max_nm: float | None = None
    """Limit of its commands, drawn beside them."""
    speed_max_rad_s: float | None = None
    """Beyond it the bench stops the drive; drawn beside its speed."""
    quantity: str = "speed"
    """Of its reference, by :class:`servobench.hil.loop.scenario.Quantity`."""
    mode: str = "cst"
    """Of its drive, as in the bench file."""


@dataclass(frozen=True, slots=True)
class ReviewPlan:
    """What the figures and the verdict depend on, beside the records."""

    axes: tuple[AxisPlan, ...]
    """By axis number of the records."""
    limits: VerdictLimits = field(default_factory=VerdictLimits)
    settling: Duration = SETTLING
    """How long after a reference step speed and position errors are not counted."""
    band_percent: float = SETTLING_BAND_PERCENT
    """Of a step: within it the speed has settled."""
    period: Duration = Duration(NS_PER_MS)  # noqa: RUF009 - an int
    """Of the loop."""
    digested: tuple[int, ...] = DIGESTED
    """Places of the columns that the digest covers."""


class ObservedSignal(NamedTuple):
    """An object that a drive tells for the recording alone."""

    object: tuple[int, int]
    """Index and sub-index."""
    code: str
    """``struct`` character."""
    name: str
    unit: str
    factor: float
    """By which its number is multiplied."""

    @property
    def path(self) -> str:
        """Of its series, below the axis."""
        index, sub = self.object
        return f"observed/{index:04X}h_{sub}"

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


class ObservedDrive(NamedTuple):
    """Who tells them."""

    node: int
    segment: int
    """Its number; 0: the first one."""
    signals: tuple[ObservedSignal, ...]


class PlannedSetPoint(NamedTuple):
    """A reference or a load that an axis is to be asked for."""

    after: Duration
    """The first cycle."""
    axis: int
    text: str
    """It, in words."""


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """One run's recording."""

    folder: Path | None
    """Made by the recorder; holds everything of the run. None: there are to be figures, and no files."""
    name: str
    """Of the bench, for titles."""
    seed: int
    bus: str
    """Bus spec; its last part is the interface name of frames.log."""
    real_time: bool
    """True: a full ring loses rows and counts them. False: a full ring makes the writer wait."""
    deadline: Duration
    """Age at which a reading counts as late; drawn beside the delay."""
    review: ReviewPlan
    bench_toml: str
    """The resolved bench file."""
    started_at: Instant = Instant(0)  # noqa: RUF009 - an int
    """When the recording began; the time zero of a run that comes to no cycle."""
    wall_offset: Duration | None = None
    """Wall clock minus bench clock, for frames.log; None in simulated time."""
    frames: bool = True
    """Whether frames.log is kept."""
    segments: tuple[str, ...] = ()
    """Names of the bus's further segments, in frames.log in the place of the interface."""
    set_points: tuple[PlannedSetPoint, ...] = ()
    """What the axes are to be asked for; told as it is acted upon."""
    faults: bool = False
    """Whether faults.jsonl is kept: what was injected."""
    view: bool = False
    """Whether a Rerun viewer shows the run while it goes on."""
    period_us: int = 0
    """Of the loop, for network.toml; 0: none is written."""
    channels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """By axis, the names of what its controller tells of its own."""
    observed: Mapping[str, ObservedDrive] = field(default_factory=dict)
    """By axis; of those that observe nothing there is none."""
    sources: str = "{}"
    """Which code of the user's own ran, by axis and key: object and digest of its file, JSON."""
    notes: Mapping[str, str] = field(default_factory=dict)
    """Shown beside the verdict, e.g. {"controller": "pid"}."""

    def stamp_offset(self, zero: Instant) -> Duration:
        """Epoch stamp minus bench clock, ns; ``zero``: the first cycle on the bench clock."""
        return Duration(SIMULATED_EPOCH - zero) if self.wall_offset is None else self.wall_offset

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        plain = asdict(self)
        plain["folder"] = None if self.folder is None else str(self.folder)
        return plain
