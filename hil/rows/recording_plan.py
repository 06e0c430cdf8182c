"""The data that a recording needs before the first cycle; plain values that can be sent to another
process.

References and loads as they take effect, by the rows of the cycles.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import quote

import numpy as np

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.loop.cycle_record import NOTHING
from servobench.hil.rows.records import DIGESTED, Rows
from servobench.hil.rows.side_rows import TextEvent
from servobench.hil.verdict.metrics import VerdictLimits

SETTLING = Duration(250_000_000)
"""Default of ``verdict.settling_ms``."""
SETTLING_BAND_PERCENT = 2.0
"""Default of ``verdict.settling_band_percent``: the usual one of step responses."""
SIMULATED_EPOCH = 1_000_000_000 * NS_PER_S
"""Time of a simulated run's first cycle in stamps of frames, ns since 1970: in September 2001, so that none
is mistaken for a real one, and run times can be read directly."""


@dataclass(frozen=True, slots=True)
class CertifiedPlan:
    """The certificate of an axis' controller; None: its file does not say."""

    period_us: int
    delay_us: float | None = None
    """To actuation, at most."""
    losses_together: int | None = None
    """Readings and commands lost in a row, added, at most."""
    gain: float | None = None
    """From load torque to speed error, rad/s per N m, at most."""
    bandwidths_hz: tuple[float, float] | None = None
    """Range of the drive's current loop."""
    bandwidth_hz: float | None = None
    """Bandwidth of the drive; None: unknown."""
    torque_rms_nm_max: float | None = None
    """About its mean at steady reference and load; None: no limit."""
    age_us: float | None = None
    """Longest action of a sample, losses included."""
    torque_step_max_nm: float | None = None
    """Limit of a command's change from the previous one; None: there is none."""
    sync_within_us: float = 0.0
    """Largest departure of the distance of two SYNCs from the period; 0: the period is constant."""
    samples_alone: bool = False
    """Certified for lost samples, but neither for lost commands nor for a shorter delay."""
    left: tuple[str, ...] = ()
    """Premises that bench and drive do not keep, in words
    (:mod:`servobench.hil.reviewing.certificate_meter`)."""
    unknown: tuple[str, ...] = ()
    """Premises for which that is unknown."""


@dataclass(frozen=True, slots=True)
class AxisPlan:
    """One axis, as the review sees it."""

    name: str
    acceleration_max_rad_s2: float
    """Largest acceleration by its torque limit and inertia; a reference that changes faster opens a settling
    window."""
    rated_torque_nm: float | None = None
    """Rated torque of the motor; None: its torque swing is not judged."""
    certified: CertifiedPlan | None = None
    """None: its controller has no certificate."""
    torque_max_nm: float | None = None
    """Limit of its commands, drawn with them."""
    speed_max_rad_s: float | None = None
    """Speed at which the bench stops the drive; drawn with its speed."""
    quantity: str = "speed"
    """Quantity of its reference, by :class:`servobench.hil.loop.scenario.Quantity`."""
    mode: str = "cst"
    """Mode of its drive, as in the bench file."""


@dataclass(frozen=True, slots=True)
class ReviewPlan:
    """Data for the figures and the verdict, besides the records."""

    axes: tuple[AxisPlan, ...]
    """By axis number of the records."""
    limits: VerdictLimits = field(default_factory=VerdictLimits)
    settling: Duration = SETTLING
    """Time after a reference step in which speed and position errors are not counted."""
    band_percent: float = SETTLING_BAND_PERCENT
    """Settling band, as a share of a step."""
    period: Duration = Duration(NS_PER_MS)  # noqa: RUF009 - an int
    """Period of the loop."""
    digested: tuple[int, ...] = DIGESTED
    """Places of the columns that the digest covers."""


class ObservedSignal(NamedTuple):
    """An object that a drive sends for the recording alone."""

    object: tuple[int, int]
    """Index and sub-index."""
    code: str
    """``struct`` character."""
    name: str
    unit: str
    factor: float
    """Factor of its number."""

    @property
    def path(self) -> str:
        """Path of its series, below the axis."""
        index, sub = self.object
        return f"observed/{index:04X}h_{sub}"

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


class ObservedDrive(NamedTuple):
    """The drive that sends them."""

    node: int
    segment: int
    """Its number; 0: the first one."""
    signals: tuple[ObservedSignal, ...]
    every_ns: int = 0
    """Time from one frame of a TPDO to the next; 0: not known."""


class PlannedSetPoint(NamedTuple):
    """A planned reference or load of an axis."""

    after: Duration
    """Delay after the first cycle."""
    axis: int
    text: str
    """Its description."""


LOOPBACK: Final = "127.0.0.1"
"""Nothing of a run is served to other machines."""


class ServedPorts(NamedTuple):
    """Ports of the loopback at which a recording, or a run that goes on, is served."""

    stream: int
    """For viewers, by gRPC."""
    page: int
    """For browsers, by HTTP: the viewer itself, which then reads the stream."""

    @property
    def stream_uri(self) -> str:
        """URI for ``rerun --connect``."""
        return f"rerun+http://{LOOPBACK}:{self.stream}/proxy"

    @property
    def page_url(self) -> str:
        """URL for a browser."""
        return f"http://{LOOPBACK}:{self.page}?url={quote(self.stream_uri, safe='')}"


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """One run's recording."""

    folder: Path | None
    """Made by the recorder; holds everything of the run. None: there are to be figures, and no files."""
    name: str
    """Name of the bench, for titles."""
    seed: int
    bus: str
    """Bus spec; its last part is the interface name of the frames."""
    real_time: bool
    """True: a full ring loses rows and counts them. False: a full ring makes the writer wait."""
    deadline: Duration
    """Age at which a reading counts as late; drawn with the delay."""
    review: ReviewPlan
    bench_toml: str
    """The resolved bench file."""
    started_at: Instant = Instant(0)  # noqa: RUF009 - an int
    """When the recording began; the time zero of a run that comes to no cycle."""
    wall_offset: Duration | None = None
    """Wall clock minus bench clock, for the stamps of frames; None in simulated time."""
    frames: bool = True
    """True if frames are kept."""
    segments: tuple[str, ...] = ()
    """Names of the bus's further segments, used as interface names of frames."""
    set_points: tuple[PlannedSetPoint, ...] = ()
    """Planned set-points of the axes; reported when they act."""
    faults: bool = False
    """True if the injected faults are kept."""
    view: bool = False
    """True if a Rerun viewer shows the run live."""
    served: ServedPorts | None = None
    """Where the run is served while it goes on; None: nowhere."""
    period_us: int = 0
    """Period of the loop, for network.toml; 0: none is written."""
    channels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of each controller's own channels, by axis."""
    observed: Mapping[str, ObservedDrive] = field(default_factory=dict)
    """By axis; none for axes that observe nothing."""
    sources: str = "{}"
    """User code of the run, by axis and key: object and digest of its file, JSON."""
    notes: Mapping[str, str] = field(default_factory=dict)
    """Shown with the verdict, e.g. {"controller": "pid"}."""

    @property
    def interfaces(self) -> tuple[str, ...]:
        """Names of the interfaces of the frames, by segment."""
        return self.bus.rpartition(":")[2], *self.segments

    def stamp_offset(self, zero: Instant) -> Duration:
        """Return epoch stamp minus bench clock, ns; ``zero``: the first cycle on the bench clock."""
        return Duration(SIMULATED_EPOCH - zero) if self.wall_offset is None else self.wall_offset

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        plain = asdict(self)
        plain["folder"] = None if self.folder is None else str(self.folder)
        return plain


class SetPointTeller:
    """Reports a set-point with the first command sent at its time or later.

    A run that ended before never reports it.
    """

    def __init__(self, planned: tuple[PlannedSetPoint, ...]) -> None:
        """``planned``: in order of time."""
        self._planned = planned

    def take(self, rows: Rows, zero: Instant) -> list[TextEvent]:
        """Return the set-points that ``rows``, (n,) of ROW_DTYPE, acted upon; ``zero``: the first cycle."""
        if not self._planned or not rows.size:
            return []
        sent = rows.compress(rows["command_handed_at"] != NOTHING)
        told: list[tuple[int, int, TextEvent]] = []
        waiting: list[PlannedSetPoint] = []
        for each in self._planned:
            acted = np.flatnonzero((sent["axis"] == each.axis) & (sent["due_at"] >= zero + each.after))
            if acted.size:
                at = Instant(int(sent["command_handed_at"][acted[0]]))
                told.append((at, each.axis, TextEvent(at, "INFO", each.text)))
            else:
                waiting.append(each)
        self._planned = tuple(waiting)
        # Of one instant by axis, as the rows come: also where those of one cycle are taken in two parts.
        return [event for _, _, event in sorted(told, key=lambda entry: entry[:2])]
