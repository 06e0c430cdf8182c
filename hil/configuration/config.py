"""Bench files: the bus with other nodes' frames, its drives and their controllers, the references, and the
limits for a pass.

A bench file is TOML; every key is checked, an unknown one is fatal, and all faults
of a file are reported together. Times are seconds or whole microseconds, the unit
is the last part of a key's name.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, PrivateAttr, create_model, model_validator

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.instruments.dynamometer import BAUD, Dialect, DynamometerSettings, dialect
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration
from servobench.drivers.wire.adapters import SIMULATED
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.config_files import F, Section, load_file, toml_text
from servobench.hil.configuration.network_file import stamp_resolutions_us
from servobench.hil.configuration.quantities import WHOLE, HeartbeatTimeout, Torque
from servobench.hil.configuration.references import Load, Reference
from servobench.hil.loop.scenario import Quantity
from servobench.hil.loop.syncs import HORIZON_MAX
from servobench.hil.rows.run_files import FAULTS_FILE
from servobench.hil.verdict.metrics import LIMITED, VerdictLimits
from servobench.virtual_bus.device.background import Stream
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.hosting.injection import Faults


class Background(Section):
    """The frames of one identifier."""

    can_id: int = Field(ge=0, lt=1 << 29, description="an identifier, e.g. 0x3A0")
    extended: bool = False
    """True: the identifier has 29 bits."""
    remote: bool = False
    bytes_max: int = Field(default=8, ge=0, le=8)
    bytes_min: int = Field(default_factory=lambda data: data.get("bytes_max", 8), ge=0, le=8)
    """Default: bytes_max."""
    period_us: int = Field(ge=1, le=3_600_000_000, description="from frame to frame, us")
    jitter_us: int = Field(default=0, ge=0)
    """Each frame comes up to this much later."""
    arrivals: Literal["periodic", "random"] = "periodic"
    """``random``: with the period as mean distance."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if not self.extended and self.can_id >= 1 << 11:
            raise ValueError("can_id: 11 bits, at most 0x7FF, or extended = true")
        if self.bytes_min > self.bytes_max:
            raise ValueError(f"bytes_min: at most bytes_max = {self.bytes_max}")
        if self.jitter_us > self.period_us:
            raise ValueError(f"jitter_us: at most period_us = {self.period_us}")
        if self.jitter_us and self.arrivals == "random":
            raise ValueError("jitter_us: none, as random arrivals have their own")
        return self

    @property
    def stream(self) -> Stream:
        """The stream for the simulated world."""
        return Stream(
            self.can_id,
            Duration(self.period_us * NS_PER_US),
            self.extended,
            self.remote,
            self.bytes_min,
            self.bytes_max,
            Duration(self.jitter_us * NS_PER_US),
            self.arrivals,
        )


BackgroundTables = Annotated[tuple[Background, ...], Field(strict=False)]


class BackgroundFile(Section):
    """A file of background traffic."""

    background: Annotated[tuple[Background, ...], Field(strict=False, min_length=1)] = Field(
        description="at least one table [[background]]"
    )


def load_background(path: Path, named_by: NamedBy | None = None) -> tuple[Stream, ...]:
    """Load the streams of the file at ``path``. Raises BadInput or BadInputs."""
    file = load_file(BackgroundFile, path, "file of background traffic", named_by)
    return tuple(entry.stream for entry in file.background)


BitRate = Annotated[
    Literal[10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000], WHOLE
]
"""The bit rates of CiA 301 5.1, and 100 kbit/s, which is common."""
Rule = Literal["tell", "stop"]
"""Reaction of the bus guard."""
Foreign = Literal[
    "nmt", "sync", "heartbeat", "sdo_read", "sdo_write", "sdo_answer", "rpdo", "tpdo"
]  # fmt: skip
"""Kinds of frames that another node may send as the bench or one of its drives, or to them."""
AxisName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class LoadMachineConfig(Section):
    """``[load_machine]``: a serial dynamometer controller."""

    kind: Literal["magtrol_dsp7000", "magtrol_dsp6001"] = Field(
        description="'magtrol_dsp7000' or 'magtrol_dsp6001'; a DSP7000 in its 6001 mode is the latter"
    )
    port: str = Field(
        min_length=1, description="its serial port, or 'simulated' for one on the simulated drive's shaft"
    )
    torque_max_nm: Torque = Field(description="the largest torque that its brake may be asked for, N m")
    axis: str | None = None
    """The axis with the machine on its shaft; default: the only axis."""
    baud: int = Field(default=BAUD, ge=300, le=921_600)
    channel: Annotated[Literal[1, 2], WHOLE] = 1
    """Channel of a DSP7000 with two."""
    torque_unit: Literal["N.m", "N.cm", "N.mm", "kg.cm", "g.cm", "oz.in", "oz.ft", "lb.in", "lb.ft"] = "N.m"
    """Unit of its display."""
    clockwise_is_positive: bool = True
    """True: positive speed of the drive is R on its display."""
    answer_timeout_ms: int = Field(default=1000, ge=10, le=10_000)
    """The manuals require at least a second; three in a row end the run."""
    reading_every_ms: int = Field(default=20, ge=1, le=10_000)

    @property
    def dialect(self) -> Dialect:
        """The commands of the instrument."""
        return dialect(self.kind, self.channel, self.torque_unit, self.clockwise_is_positive)

    @property
    def settings(self) -> DynamometerSettings:
        """Timing of its driver."""
        return DynamometerSettings(
            self.baud,
            Duration(self.answer_timeout_ms * NS_PER_MS),
            Duration(self.reading_every_ms * NS_PER_MS),
        )


class BenchSection(Section):
    """``[bench]``"""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="a name of letters, digits, . _ -")
    duration_s: float = Field(gt=0, le=86_400, description="how long the loop runs, s")
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Seed of every random stream of the run."""


class BusSegment(Section):
    """``[[bus.segment]]``: one more segment of the bus ``simulated``, with a port of the host on it."""

    name: AxisName = Field(description="a name by which drives say that they are on it")
    bitrate_bit_s: BitRate = 1_000_000
    background: BackgroundTables = ()
    """Other nodes' traffic on this segment."""


class Bus(Section):
    """``[bus]``"""

    spec: str = Field(default=SIMULATED, min_length=1)
    """``simulated``, ``hub:NAME``, ``socketcan:can0``, or INTERFACE:CHANNEL of python-can."""
    bitrate_bit_s: BitRate = 1_000_000
    background: BackgroundTables = ()
    """Other nodes' traffic, on the bus ``simulated``, which the bench makes itself."""
    segment: Annotated[tuple[BusSegment, ...], Field(strict=False)] = ()
    """Further segments in addition to the one described by these keys."""


class Host(Section):
    """``[host]``: the bench's CANopen master."""

    node: int = Field(default=127, ge=1, le=127)
    heartbeat_ms: int = Field(default=50, ge=1, le=65_535)
    heartbeat_timeout_ms: HeartbeatTimeout = 150
    """A drive that does not hear the host for this long stops by itself (CiA 301, 0x1016)."""

    connect_timeout_s: float = Field(default=3.0, gt=0, le=600)
    """Time for a drive's first answer."""


class LoopConfig(Section):
    """``[loop]``: the cycle, and the conditions for a valid reading."""

    period_us: int = Field(default=1000, ge=100, le=1_000_000)
    decide_after_us: int = Field(default_factory=lambda data: 7 * data["period_us"] // 10, ge=0)
    """The command is computed no later than this after the tick."""
    deadline_us: int = Field(default=2000, gt=0)
    """A reading older than this when it arrives is LATE."""
    horizon_periods: int = Field(default=20, ge=1, le=HORIZON_MAX)
    """A reading missing after this many periods is LOST."""
    actuation: Literal["on_arrival", "on_sync"] = "on_arrival"
    """The drive applies a set-point on arrival, or at the next SYNC."""
    position_every_cycles: int = Field(default=1, ge=1, le=240)
    """Torque, position and torque demand come with every reading, or once in this many cycles, so that three
    drives fit a bus. In between the position is extrapolated by the speed."""
    command_readback: Literal["sync", "event"] = "sync"
    """How the drive reports the command it follows, 6074h: with the SYNCs, so that a command is known to act
    between two of them; or at every change, stamped, at the cost of one frame a cycle."""
    sync: Literal["own", "kernel", "foreign"] = "own"
    """Producer of the SYNC: this process at each tick, the bus's own cyclic sender on its behalf (SocketCAN's
    broadcast manager), or a drive or another master, whose SYNC the loop then follows."""
    sync_watermark_us: float = Field(default=0.0, ge=0, le=1000)
    """Each of this process's SYNCs is up to this much late of its tick, by its own seed, so that a shift by
    whole periods shows; at most a tenth of a period is used."""

    @property
    def sync_watermark(self) -> Duration:
        """Greatest lateness of a SYNC from its tick, ns."""
        return Duration(min(round(self.sync_watermark_us * NS_PER_US), self.period // 10))

    @property
    def period(self) -> Duration:
        """One cycle, ns."""
        return Duration(self.period_us * NS_PER_US)

    @property
    def decide_after(self) -> Duration:
        """From the tick to the latest moment of decision, ns."""
        return Duration(self.decide_after_us * NS_PER_US)

    @property
    def deadline(self) -> Duration:
        """Greatest age of a usable reading on arrival, ns."""
        return Duration(self.deadline_us * NS_PER_US)

    @property
    def horizon(self) -> Duration:
        """After this a missing reading is lost, ns."""
        return Duration(self.horizon_periods * self.period)


def _with_limits(section: type[F]) -> type[F]:
    """Return the section with a key for each limit of the verdict."""
    keys: dict[str, Any] = {
        name: (float | None, Field(default=None, description=each.meaning, **each.bounds))
        for name, each in LIMITED.items()
    }
    return create_model(
        section.__name__, __base__=section, __module__=__name__, __doc__=section.__doc__, **keys
    )


@_with_limits
class VerdictConfig(Section):
    """``[verdict]``: limits for a pass; an absent limit is not judged."""

    settling_ms: int = Field(default=250, ge=0, le=3_600_000)
    """Time after a reference step in which speed and position errors are not counted."""
    settling_band_percent: float = Field(default=2.0, gt=0, le=100)
    """Band in which the speed has settled: share of a step, and after a load step of the reference."""

    @property
    def settling(self) -> Duration:
        """``settling_ms`` in ns."""
        return Duration(self.settling_ms * NS_PER_MS)

    @property
    def limits(self) -> VerdictLimits:
        """The limits alone."""
        return VerdictLimits(**{name: getattr(self, name) for name in LIMITED})


class RecordingConfig(Section):
    """``[recording]``"""

    frames: bool = True
    """True: frames.arrow holds every frame."""
    on_failure: Literal["stop", "continue"] = "stop"
    """Reaction to a failed recording: end the run in order, or continue; it has not passed either way."""


class Guard(Section):
    """``[guard]``: unsolicited actions of a drive or another node are reported; ``stop`` ends the run as
    well.

    A run disturbed by others has not passed, unless ``allow`` names everything they did.
    """

    on_mode: Rule = "stop"
    """A drive does not follow its commands: it leaves its mode (6061h), or reports that it ignores its target
    (bit 12 of 6041h)."""
    on_foreign: Rule = "tell"
    """Another node sends, as the bench or one of its drives or to them, frames not named by ``allow``."""
    allow: Annotated[tuple[Foreign, ...], Field(strict=False)] = ("sdo_read",)
    """Frames that another node may send: they are reported and counted, but neither disturb a run nor end it.
    A read changes nothing in a drive."""
    on_boot: Rule = "tell"
    """A node starts in mid-run: a boot-up message."""
    on_bus_errors: Rule = "tell"
    """Error frames become frequent, 16 within a second."""


class BenchConfig(Section):
    """A complete bench file, checked; paths are resolved and their files loaded."""

    bench: BenchSection = Field(description="the table [bench] with name and duration_s")
    bus: Bus = Bus()
    host: Host = Host()
    loop: LoopConfig = LoopConfig()
    drive: dict[AxisName, DriveConfig] = Field(min_length=1, description="at least one table [drive.NAME]")
    reference: dict[str, Annotated[tuple[Reference, ...], Field(strict=False)]] = Field(default_factory=dict)
    load: dict[str, Annotated[tuple[Load, ...], Field(strict=False)]] = Field(default_factory=dict)
    load_machine: LoadMachineConfig | None = None
    """The instrument that loads its axis; without it a simulated drive uses its own load object."""
    faults: Faults | None = None
    """Faults of the frames at the bench's own bus connection, of the simulated drives, and of the host."""
    verdict: VerdictConfig = VerdictConfig()
    recording: RecordingConfig = RecordingConfig()
    guard: Guard = Guard()
    _source: str = PrivateAttr(default="")

    def named(self, source: str) -> "BenchConfig":
        """Return this bench with the file that it was read from."""
        copy = self.model_copy()
        copy._source = source
        return copy

    @property
    def source(self) -> str:
        """Path of its file: the ``source`` of later errors."""
        return self._source

    @property
    def simulated(self) -> bool:
        """True if the bench makes its bus and its drives itself."""
        return self.bus.spec == SIMULATED

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes, in the order in which the loop serves them."""
        return tuple(sorted(self.drive))

    @property
    def load_machine_axis(self) -> str | None:
        """The axis with the load machine on its shaft; None: there is none."""
        return None if self.load_machine is None else self.load_machine.axis or self.axes[0]

    def coherent(self, axis: str) -> bool:
        """Return True if the position travels before the speed of the same SYNC: where positions are
        commanded or controlled, if it comes with every SYNC."""
        return self.drive[axis].mode != "cst" and self.loop.position_every_cycles == 1

    def quantity(self, axis: str) -> Quantity:
        """Return the quantity of an axis' reference; without a reference its controller's
        usual one."""
        entries = self.reference.get(axis, ())
        if entries and entries[0].told:
            return entries[0].quantity
        return self.drive[axis].follows[0]

    def counted(self, axis: str) -> bool:
        """Return True if position and speed of one SYNC are to travel in one TPDO."""
        drive = self.drive[axis]
        return drive.controller.needs_count if drive.count_with_speed is None else drive.count_with_speed

    def bitrate_of(self, axis: str) -> int:
        """Return the bit rate of the segment of the drive of ``axis``, bit/s."""
        return self.bitrate_on(self.drive[axis].segment)

    def bitrate_on(self, segment: str | None) -> int:
        """Return the bit rate of a segment, bit/s; None: the first one."""
        return next(
            (each.bitrate_bit_s for each in self.bus.segment if each.name == segment), self.bus.bitrate_bit_s
        )

    def as_run(self, bus_spec: str, seed: int | None, network: Path | None = None) -> "BenchConfig":
        """Return this bench as it is run: on that bus, and with that seed if given.

        ``network``: file of an earlier measurement; a drive without a stamp resolution in the bench gets the
        measured one. Raises BadInput or BadInputs for the file.
        """
        bench = self.bench if seed is None else self.bench.model_copy(update={"seed": seed})
        resolutions_us = {} if network is None else stamp_resolutions_us(network)
        drives = dict(self.drive)
        for axis, drive in drives.items():
            found_us = resolutions_us.get(f"node{drive.node}", resolutions_us.get(axis))
            if drive.stamp_resolution_us is None and found_us is not None:
                drives[axis] = drive.model_copy(update={"stamp_resolution_us": found_us})
        bus = self.bus.model_copy(update={"spec": bus_spec})
        return self.model_copy(update={"bus": bus, "bench": bench, "drive": drives})

    def resolved_text(self) -> str:
        """Return this bench as one TOML file: every default written out, motor and fault plan inline."""
        tables = self.model_dump(mode="json", exclude_none=True, exclude={"faults"})
        if isinstance(self.faults, FaultPlan):
            tables["faults"] = self.faults.as_tables()
        elif self.faults is not None:
            tables["faults"] = {"plan": FAULTS_FILE}  # beside it, in the recording
        return toml_text(tables)
