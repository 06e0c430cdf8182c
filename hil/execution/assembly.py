"""Builds the parts of a run from a checked bench file; controllers and compensators before anything moves,
with the files of user code.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from servobench.drivers.canopen.cob_ids import SYNC
from servobench.drivers.cia402.pdo_plans import STATUS, TARGETS
from servobench.drivers.cia402.profile import BENCH_MODES
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.controller_kinds import ArrivalCompensator, OwnCode
from servobench.hil.control.own_code import source_of
from servobench.hil.control.setup import Setup
from servobench.hil.loop.axis import Axis, AxisParts
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.loop import Actuation, LoopTiming
from servobench.hil.loop.protocol import Compensator, Controller, LoadMachine
from servobench.hil.loop.safety import Limits, PositionLimits, SafetyGuard, SpeedLimits, TorqueLimits
from servobench.hil.loop.scenario import QUANTITY_BY_MODE, Quantity, ReferenceProfile
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.recording.run_recorder import RunRecorder
from servobench.hil.rows.events import QUIET
from servobench.virtual_bus.bus.frame_image import INTERMISSION_BITS, bits_duration, frame_bits
from servobench.virtual_bus.frame import Frame

if TYPE_CHECKING:
    from servobench.virtual_bus.drive.servo import SimulatedServo

PATIENCE_SIMULATED_S = 10.0
"""Limit of a user code call in simulated time, s: more than a solver takes for a step. On a bus in real time
a drive stops by itself when it misses the host, which is the limit then."""


@dataclass(frozen=True, slots=True)
class AxisCode:
    """The code of one axis."""

    controller: Controller
    compensator: Compensator
    own: Mapping[str, "KeptSource"] = field(default_factory=dict)
    """User classes by their key in the bench file: controller, compensator."""


@dataclass(frozen=True, slots=True)
class KeptSource:
    """The file of a user class."""

    name: str
    """Name of the class, as in the bench file."""
    file: Path
    digest: str
    """BLAKE2b, 128 bit, hex."""


def check_axes(config: BenchConfig, controllers: Mapping[str, Controller]) -> None:
    """Raise BadInput for a controller of a missing axis: the bench's own would run instead."""
    for name in controllers:
        if name not in config.axes:
            expected = f"one of the bench's axes: {', '.join(config.axes)}"
            raise BadInput(config.source, "controllers", name, expected)


def axis_code(
    config: BenchConfig, given: Mapping[str, Controller], *, real_time: bool
) -> dict[str, AxisCode]:
    """Make the code of every axis; ``given``: by axis, a controller in place of the bench's.

    It runs user code, if the bench names any. Raises BadInput.
    """
    return {axis: _of_axis(config, axis, given.get(axis), real_time) for axis in config.axes}


def _of_axis(config: BenchConfig, axis: str, given: Controller | None, real_time: bool) -> AxisCode:
    drive = config.drive[axis]
    patience_s = config.host.heartbeat_timeout_ms / 1e3 if real_time else PATIENCE_SIMULATED_S
    setup = Setup(
        axis,
        config.loop.period,
        drive.motor.parameters,
        drive.limits.torque_max_nm,
        drive.limits.speed_max_rad_s,
        patience_s,
        config.source,
        QUANTITY_BY_MODE[drive.mode],
        config.quantity(axis),
    )
    own = {}
    for key in ("compensator",) if given else ("controller", "compensator"):
        if isinstance(section := getattr(drive, key), OwnCode):
            own[key] = _source_of(section, config.source, f"drive.{axis}.{key}.object")
    controller = given or drive.controller.build(setup)
    observer = controller.observer()
    if observer is None:
        return AxisCode(controller, drive.compensator.build(setup), own)
    if not isinstance(drive.compensator, ArrivalCompensator):
        expected = "none, as the controller has its own"
        raise BadInput(config.source, f"drive.{axis}.compensator", drive.compensator.kind, expected)
    return AxisCode(controller, observer, own)


def _source_of(section: OwnCode, source: str, key: str) -> KeptSource:
    try:
        file, digest = source_of(section.object)
    except ValueError as error:
        expected = "MODULE:NAME of an installed module, or FILE.py:NAME of a file beside the bench file"
        raise BadInput(source, key, section.object, expected, str(error)) from error
    return KeptSource(section.object, file, digest)


FRAME_BITS_BARE = 44
"""Bits of a data frame with an 11-bit identifier without its data and stuff bits, from start to end of
frame."""
_CONTROLWORD_BYTES = 2
COMMAND_FRAMES = {
    key: Frame(0x201, bytes(_CONTROLWORD_BYTES + TARGETS[mode].bits // 8))
    for key, mode in BENCH_MODES.items()
}
"""Command frames by mode; as long as a command can be before its data are known: 6071h and 6042h have 16
bits, 60FFh, 607Ah and 60C1h:1 have 32."""


def simulated(config: BenchConfig) -> "Sequence[SimulatedServo]":
    """Return the drives of the bench, if its bus is simulated."""
    if not config.simulated:
        return ()
    # A host of other drives does without it.
    from servobench.hil.execution.simulated_drives import simulated_drives

    return simulated_drives(config)


def tell_changes(config: BenchConfig, servos: "Sequence[SimulatedServo]", recorder: RunRecorder) -> None:
    """Let the recording have what changes inside the drives that the bench simulates."""
    if not servos:
        return
    from servobench.virtual_bus.drive.parts_watch import PartChange, PartsWatch

    def note(axis: str, change: PartChange) -> None:
        recorder.state(change.at, f"{axis} {change.part}", change.state or QUIET)
        if change.text:
            recorder.event(change.at, "WARN" if change.limits else "INFO", f"{axis}: {change.text}")

    # drives beyond the axes are company on the bus
    for axis, servo in zip(config.axes, servos, strict=False):
        PartsWatch(servo.drive, partial(note, axis))


def loop_timing(config: BenchConfig) -> LoopTiming:
    """Return the loop's times; the latencies are those of the idle first segment."""
    bitrate = config.bus.bitrate_bit_s
    return LoopTiming(
        period=config.loop.period,
        decide_after=config.loop.decide_after,
        settle=Duration(config.loop.deadline + config.loop.period),
        actuation=Actuation(config.loop.actuation),
        sync_latency=sync_latency(bitrate) if config.loop.sync == "own" else Duration(0),
        command_latency=command_latency(bitrate),
    )


def sync_latency(bitrate: int) -> Duration:
    """Return the time from handing a SYNC over to its end on an idle segment of that bit rate, bit/s."""
    return bits_duration(frame_bits(Frame(SYNC)), bitrate)


def command_latency(bitrate: int, mode: str = "cst") -> Duration:
    """Return the time from handing a command over to its end on an idle segment of that bit rate, bit/s."""
    return bits_duration(frame_bits(COMMAND_FRAMES[mode]), bitrate)


def shortest_transit(data_bytes: int, bitrate: int) -> Duration:
    """Return the least time of a frame on the wire: one without a stuff bit (ISO 11898-1)."""
    return bits_duration(FRAME_BITS_BARE + 8 * data_bytes, bitrate)


def command_duration(bitrate: int, mode: str) -> Duration:
    """Return how long a command in a mode occupies an idle segment of that bit rate, with the intermission
    after it."""
    return bits_duration(frame_bits(COMMAND_FRAMES[mode]) + INTERMISSION_BITS, bitrate)


def reference_profile(config: BenchConfig, axis: str) -> ReferenceProfile:
    """Return the reference of one axis, in SI units."""
    entries = config.reference.get(axis, ())
    return ReferenceProfile([entry.segment() for entry in entries], config.quantity(axis))


def _guard(config: BenchConfig, axis: str) -> SafetyGuard:
    """Return the host limits of one axis, for its drive's quantity."""
    drive = config.drive[axis]
    limits = drive.limits
    guarded: Limits
    if drive.mode == "cst":
        guarded = TorqueLimits(
            torque_max_nm=limits.torque_max_nm,
            speed_max_rad_s=limits.speed_max_rad_s,
            torque_slew_max_nm_s=limits.torque_slew_max_nm_s,
            dropouts_consecutive_max=limits.dropouts_consecutive_max,
        )
    else:
        kind = SpeedLimits if QUANTITY_BY_MODE[drive.mode] is Quantity.SPEED else PositionLimits
        guarded = kind(
            limits.set_speed_rpm * RAD_S_PER_RPM,
            limits.speed_max_rad_s,
            limits.set_acceleration_max_rad_s2,
            limits.dropouts_consecutive_max,
        )
    return SafetyGuard(guarded, config.loop.period / NS_PER_S)


def axis(
    config: BenchConfig,
    number: int,
    drive: ServoDrive,
    code: AxisCode,
    load_machine: LoadMachine | None,
    timing: LoopTiming,
    syncs: SyncLog,
    record: Callable[[CycleRecord], None],
    tell: Callable[[str], None],
) -> Axis:
    """Build the ``number``-th axis of the bench, on ``drive``, which is configured.

    ``syncs``: of its segment. ``tell``: takes messages about the drive's clock.
    """
    assert drive.plan is not None
    name = config.axes[number]
    mode, segment, bitrate = config.drive[name].mode, config.drive[name].segment, config.bitrate_of(name)
    later = sync_latency(bitrate) - sync_latency(config.bus.bitrate_bit_s)
    if timing.actuation is Actuation.ON_ARRIVAL:
        # The commands of a cycle go out one after the other, in the order of the axes.
        earlier = [config.drive[other] for other in config.axes[:number]]
        later = command_latency(bitrate, mode) - timing.command_latency
        later += sum(command_duration(bitrate, each.mode) for each in earlier if each.segment == segment)
    parts = AxisParts(
        name=name,
        drive=drive,
        controller=code.controller,
        compensator=code.compensator,
        guard=_guard(config, name),
        reference=reference_profile(config, name),
        load=ReferenceProfile([entry.segment() for entry in config.load.get(name, ())], Quantity.TORQUE),
        load_machine=load_machine,
        syncs=syncs,
        transit=shortest_transit(drive.reading_bytes, bitrate),
        deadline=config.loop.deadline,
        horizon=config.loop.horizon_periods,
        tell=tell,
        status_timer=drive.plan.timer_of(*STATUS),
        stamp_resolution=config.drive[name].stamp_resolution or drive.assembler.stamp.resolution_at(bitrate),
        stamped_at_arrival=not drive.assembler.stamp.of_events,
        acts_at_syncs=timing.actuation is Actuation.ON_SYNC,
        acts_later=Duration(later),
    )
    return Axis(number, parts, timing.period, record)
