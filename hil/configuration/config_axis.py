"""``[drive.NAME]`` of a bench file: a drive, its mode, its limits, and its controller."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from servobench.drivers.canopen.pdo import SYNCHRONOUS_MAX
from servobench.drivers.cia402.observed import Observed
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.controller_kinds import (
    ArrivalCompensator,
    CompensatorSection,
    ControllerSection,
)
from servobench.hil.configuration.current_controller_file import CurrentControl
from servobench.hil.configuration.drive_file import DriveFile
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.configuration.observed_objects import Observe
from servobench.hil.configuration.quantities import (
    DropoutsInARow,
    HeartbeatTimeout,
    SlewRate,
    Speed,
    Torque,
)
from servobench.virtual_bus.device.device_options import STAMP_BITS, STAMP_LATE_MAX_NS, StampLatch
from servobench.virtual_bus.drive.current_bandwidth import current_bandwidth_hz
from servobench.virtual_bus.drive.lacks import PATTERN


def _lack(text: str) -> str:
    if re.match(PATTERN, text) is None:
        raise ValueError('an object ("6074"), a sub-index ("1400:5") or "tpdo events"')
    return text


Lack = Annotated[str, AfterValidator(_lack)]


class Simulation(Section):
    """``simulation``: the drive that the bench makes itself on the bus ``simulated``."""

    encoder_counts_per_revolution: int = Field(default=65536, ge=16, le=2**30)
    inner_rate_hz: int = Field(default=16000, ge=4000, le=64000)
    """Rate of the current loops."""
    clock_drift_ppm: float = Field(default=0.0, ge=-1000, le=1000)
    """Drift of the drive's clock: how much faster than the host's it runs."""
    stamp_unit_us: float = Field(default=1.0, ge=0.01, le=1000)
    """One count of the drive's stamp 1013h."""
    stamp_resolution_us: float = Field(default=1.0, ge=0.01, le=1000)
    """Step of the stamp."""
    stamp_bits: int = Field(default=32, ge=STAMP_BITS[0], le=STAMP_BITS[-1])
    """The stamp counts modulo 2^stamp_bits."""
    stamp_latched: StampLatch = "sampling"
    """At the instant of sampling, at the arrival of the SYNC, or at the next tick of the current loops."""
    stamp_late_us: float = Field(default=0.0, ge=0, le=STAMP_LATE_MAX_NS / NS_PER_US)
    """Delay of the latch after that instant."""
    stamp_runs: bool = True
    """False: 1013h holds a value written by a master."""
    sync_jitter_us: float = Field(default=0.0, ge=0, le=1000)
    """The drive acts on a SYNC, and samples, up to this much after its end; drawn evenly for each."""
    sync_phase_us: float | None = Field(default=None, ge=0, le=20_000)
    """Delay of its actions behind the SYNC as filtered by its phase-locked loop; absent: it has no such
    loop."""
    resistance_factor: float = Field(default=1.0, gt=0, le=10)
    """The simulated motor's resistance relative to the motor file's, for which its drive was set."""
    inductance_factor: float = Field(default=1.0, gt=0, le=10)
    """The same for both inductances."""
    current_bandwidth_hz: float | None = Field(default=None, gt=0)
    """Bandwidth of the PI current loops; default: a twentieth of the inner rate."""
    lacks: Annotated[tuple[Lack, ...], Field(strict=False)] = ()
    """Parts that the drive lacks: objects ("6074"), sub-indices ("1400:5"), "tpdo events"."""
    eds: str | None = None
    """Data sheet (EDS, DCF, XDD, XDC) of the simulated drive, relative to the bench file; absent:
    servobench's own drive."""
    motor: MotorFile | None = None
    """The motor on its shaft, as a motor file or its tables; default: ``drive.NAME.motor``."""
    rehearse: int | None = Field(default=None, ge=0)
    """Seed of `hil rehearse`, whose drive with its motor and encoder is simulated instead."""

    @property
    def current_loop_hz(self) -> float:
        """Bandwidth of the PI current loops, Hz."""
        return current_bandwidth_hz(self.current_bandwidth_hz, self.inner_rate_hz)


SET_SPEED_SHARE = 0.8
"""Share, for set-points, of the speed at which the bench stops a drive: a speed loop of phase margin 60
degrees overshoots a step by a tenth, and a load step adds to that."""


class Limits(Section):
    """``limits``: the host's limits for the drive, whatever the controller commands."""

    speed_max_rpm: Speed = Field(description="the speed at which the bench stops the drive, r/min")
    torque_max_nm: Torque = Field(description="the largest torque set-point, N m")
    torque_slew_max_nm_s: SlewRate | None = None
    """Slew rate of the set-points in ``mode = "cst"``."""
    set_speed_max_rpm: Speed | None = None
    """The largest speed set-point in csv and vl, and the largest rate of position set-points in csp and ip;
    default: 80 % of ``speed_max_rpm``, as the drive's own loop overshoots."""
    set_acceleration_max_rpm_s: SlewRate | None = None
    """Acceleration of the speed set-points in csv and vl, where the drive's own ramps (6048h, 6049h) are set
    to it, and along the position set-points in csp and ip."""
    dropouts_consecutive_max: DropoutsInARow = 100
    """With more consecutive cycles without a reading the bench stops the drive."""
    quick_stop_deceleration_rpm_s: SlewRate | None = None
    """Deceleration of the drive on a quick stop, or when it loses the host (0x6085); default: its own."""

    @property
    def speed_max_rad_s(self) -> float:
        """``speed_max_rpm`` in rad/s."""
        return self.speed_max_rpm * RAD_S_PER_RPM

    @property
    def set_speed_rpm(self) -> float:
        """``set_speed_max_rpm``, or its default."""
        limit = self.set_speed_max_rpm
        return SET_SPEED_SHARE * self.speed_max_rpm if limit is None else limit

    @property
    def set_acceleration_max_rad_s2(self) -> float | None:
        """``set_acceleration_max_rpm_s`` in rad/s^2."""
        limit = self.set_acceleration_max_rpm_s
        return None if limit is None else limit * RAD_S_PER_RPM

    @property
    def quick_stop_deceleration_rad_s2(self) -> float | None:
        """``quick_stop_deceleration_rpm_s`` in rad/s^2."""
        deceleration = self.quick_stop_deceleration_rpm_s
        return None if deceleration is None else deceleration * RAD_S_PER_RPM


DriveMode = Literal["cst", "csv", "csp", "ip", "vl"]


class DriveConfig(Section):
    """One axis: its drive, motor and controller."""

    node: int = Field(ge=1, le=127, description="the drive's CANopen node id, 1..127")
    segment: str | None = None
    """Name of the ``[[bus.segment]]`` of the drive; None: the first one."""
    mode: DriveMode = "cst"
    """Mode in which the drive is run: cyclic synchronous torque, velocity or position, interpolated position,
    or velocity mode. Its commands are torques, speeds or positions accordingly."""
    motor: MotorFile = Field(description="the path of a motor file, or its tables inline")
    eds: str | None = None
    """Data sheet (EDS, DCF, XDD, XDC) of the drive, relative to the bench file, used to plan its PDOs."""
    commissioned: DriveFile | None = None
    """Result of ``hil commission`` for the drive: the path of its drive.toml, or the tables inline."""
    unwatched: bool = False
    """Accept a drive without 1016h or 1017h: one side then does not notice that the other is gone."""
    heartbeat_ms: int = Field(default=50, ge=1, le=65_535)
    """Period of the drive's own heartbeat (0x1017)."""
    heartbeat_timeout_ms: HeartbeatTimeout = 150
    """A drive that is silent for this long counts as lost."""
    observe: Observe = ()
    """Objects that the drive sends by PDO for the recording alone; see docs/recording.md."""
    observe_every_cycles: int = Field(default=1, ge=1, le=SYNCHRONOUS_MAX)
    """They come with every n-th SYNC."""
    stamp_resolution_us: float | None = Field(default=None, ge=0.01, le=1000)
    """Step of the drive's stamp (1013h), as found by ``hil measure``; default: by its make, else 1 us."""
    simulation: Simulation = Simulation()
    current_control: CurrentControl = CurrentControl()
    limits: Limits = Field(description="a table with speed_max_rpm and torque_max_nm")
    compensator: CompensatorSection = ArrivalCompensator(kind="arrival")
    controller: ControllerSection = Field(description="a table with its kind, e.g. 'pid', or a path")

    @property
    def stamp_resolution(self) -> Duration | None:
        """``stamp_resolution_us`` in ns."""
        us = self.stamp_resolution_us
        return None if us is None else Duration(round(us * NS_PER_US))

    @property
    def observed(self) -> Observed:
        """``observe`` in the form for the drive."""
        return Observed(tuple(each.entry for each in self.observe if each.code), self.observe_every_cycles)
