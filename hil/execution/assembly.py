"""From a checked bench file to the parts of a run."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path

from drivers.canopen.cob_ids import SYNC
from drivers.cia402.bench_modes import BENCH_MODES
from drivers.exchange import Drive
from drivers.rotation import RAD_S_PER_RPM
from drivers.timebase import NS_PER_S, Duration, duration_s
from drivers.wire.adapters import BusSpec
from hil.configuration.config import BenchConfig
from hil.configuration.config_axis import DriveConfig
from hil.configuration.mode_checks import GIVEN, quantity_of
from hil.configuration.references import SignalFile
from hil.control.setup import Setup
from hil.execution.kept_signals import with_kept_signals
from hil.execution.world import SegmentPlan, World, WorldPlan
from hil.loop.axis import Axis, AxisParts
from hil.loop.axis_roles import Compensator, Controller, LoadMachine
from hil.loop.loop import Actuation, LoopTiming
from hil.loop.safety import Limits, PositionLimits, SafetyGuard, SpeedLimits, TorqueLimits
from hil.loop.samples import CycleRecord
from hil.loop.scenario import Quantity, ReferenceProfile
from hil.loop.syncs import SyncLog
from hil.rows.recording_plan import (
    AxisPlan,
    CertifiedPlan,
    ObservedDrive,
    ObservedSignal,
    PlannedSetPoint,
    RecordingPlan,
    ReviewPlan,
)
from hil.verdict.verdict import VerdictLimits
from virtual_bus.bus.bit_length import INTERMISSION_BITS, bits_duration, frame_bits
from virtual_bus.faults.fault_log import FaultLog
from virtual_bus.frame import Frame

FRAME_BITS_BARE = 44
"""Of a data frame with an 11-bit identifier, beside its data and stuff bits, from start to end of frame."""
PATIENCE_SIMULATED_S = 10.0
"""How long a call of one's own code may take in simulated time, s: more than a solver takes for a step. On a
bus in real time a drive stops by itself when it misses the host, which is then the limit."""
COMMAND_FRAMES = {mode: Frame(0x201, bytes(4 if mode == "cst" else 6)) for mode in BENCH_MODES}
"""By mode; as long as a command can be told to be before its data are known: 6071h has 16 bits, 60FFh and
607Ah have 32."""


def loop_timing(config: BenchConfig) -> LoopTiming:
    """The loop's times; the latencies are those of the first segment while it is idle."""
    return timing_at(config, config.bus.bitrate_bit_s)


def timing_at(config: BenchConfig, bitrate: int) -> LoopTiming:
    """The loop's times with the latencies of an idle segment of that bit rate, bit/s."""
    return LoopTiming(
        period=config.loop.period,
        decide_after=config.loop.decide_after,
        settle=Duration(config.loop.deadline + config.loop.period),
        actuation=Actuation(config.loop.actuation),
        sync_latency=sync_latency(bitrate) if config.loop.sync == "own" else Duration(0),
        command_latency=command_latency(bitrate),
    )


def sync_latency(bitrate: int) -> Duration:
    """From handing a SYNC over until its end on an idle segment of that bit rate, bit/s."""
    return bits_duration(frame_bits(Frame(SYNC)), bitrate)


def command_latency(bitrate: int, mode: str = "cst") -> Duration:
    """From handing a command in a mode over until its end on an idle segment of that bit rate, bit/s."""
    return bits_duration(frame_bits(COMMAND_FRAMES[mode]), bitrate)


def shortest_transit(data_bytes: int, bitrate: int) -> Duration:
    """The least time that a frame takes on the wire: one without a stuff bit (ISO 11898-1)."""
    return bits_duration(FRAME_BITS_BARE + 8 * data_bytes, bitrate)


def command_duration(bitrate: int, mode: str) -> Duration:
    """How long a command in a mode keeps an idle segment of that bit rate, with the intermission after it."""
    return bits_duration(frame_bits(COMMAND_FRAMES[mode]) + INTERMISSION_BITS, bitrate)


def world_plan(config: BenchConfig, spec: BusSpec, paced: bool, seed: int, log: FaultLog | None) -> WorldPlan:
    """What the bench runs in; ``paced``: simulated time goes with the wall clock."""
    return WorldPlan(
        spec,
        config.bus.bitrate_bit_s,
        paced,
        config.fault_plan,
        seed,
        fault_log=log,
        background=tuple(entry.stream for entry in config.bus.background),
        segments=_segment_plans(config),
    )


def _segment_plans(config: BenchConfig) -> tuple[SegmentPlan, ...]:
    """The further segments of the simulated bus."""
    return tuple(
        SegmentPlan(
            each.name,
            each.bitrate_bit_s,
            frozenset(config.drive[axis].node for axis in config.axes_on(each.name)),
            tuple(entry.stream for entry in each.background),
        )
        for each in config.bus.segment
    )


def reference_profile(config: BenchConfig, axis: str) -> ReferenceProfile:
    """The reference of one axis, in SI units."""
    entries = config.reference.get(axis, ())
    return ReferenceProfile([entry.segment() for entry in entries], quantity_of(config, axis))


def _guard(config: BenchConfig, axis: str, period_s: float) -> SafetyGuard:
    """The host limits of one axis, of the quantity that its drive is given."""
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
        kind = SpeedLimits if drive.mode == "csv" else PositionLimits
        guarded = kind(
            limits.set_speed_rpm * RAD_S_PER_RPM,
            limits.speed_max_rad_s,
            limits.set_acceleration_max_rad_s2,
            limits.dropouts_consecutive_max,
        )
    return SafetyGuard(guarded, period_s)


def setup_of(config: BenchConfig, name: str, *, real_time: bool) -> Setup:
    """What controller and compensator of an axis are told of it."""
    drive = config.drive[name]
    patience_s = config.host.heartbeat_timeout_ms / 1e3 if real_time else PATIENCE_SIMULATED_S
    return Setup(
        name,
        config.loop.period,
        drive.motor.parameters,
        drive.limits.torque_max_nm,
        drive.limits.speed_max_rad_s,
        patience_s,
        config.source or "bench",
        GIVEN[drive.mode],
    )


def axis(
    config: BenchConfig,
    number: int,
    drive: Drive,
    reading_bytes: int,
    load_machine: LoadMachine | None,
    timing: LoopTiming,
    syncs: SyncLog,
    record: Callable[[CycleRecord], None],
    tell: Callable[[str], None],
    controller: Controller,
    compensator: Compensator,
) -> Axis:
    """The ``number``-th axis of the bench, on ``drive``.

    ``reading_bytes``: length of the frame that carries the speed. ``syncs``: of its segment. ``tell``: takes
    what is to be said of the drive's clock.
    """
    name = config.axes[number]
    wanted = config.drive[name]
    period_s = timing.period / NS_PER_S
    own = timing_at(config, config.bitrate_of(name))
    later = own.sync_latency - timing.sync_latency
    if timing.actuation is Actuation.ON_ARRIVAL:
        # The commands of a cycle go out one after the other, in the order of the axes.
        earlier = [other for other in config.axes[:number] if config.drive[other].segment == wanted.segment]
        bitrate = config.bitrate_of(name)
        later = command_latency(bitrate, wanted.mode) - timing.command_latency
        later += sum(command_duration(bitrate, config.drive[other].mode) for other in earlier)
    parts = AxisParts(
        name=name,
        drive=drive,
        controller=controller,
        compensator=compensator,
        guard=_guard(config, name, period_s),
        reference=reference_profile(config, name),
        load=ReferenceProfile([entry.segment() for entry in config.load.get(name, ())], Quantity.TORQUE),
        load_machine=load_machine,
        syncs=syncs,
        transit=shortest_transit(reading_bytes, config.bitrate_of(name)),
        deadline=config.loop.deadline,
        horizon=config.loop.horizon_periods,
        tell=tell,
        settles=timing.period if timing.actuation is Actuation.ON_SYNC else Duration(0),
        acts_later=Duration(later),
    )
    return Axis(number, parts, timing.period, record)


def review_plan(config: BenchConfig, certified: Mapping[str, CertifiedPlan], real_time: bool) -> ReviewPlan:
    """What figures and verdict of a run of the bench depend on.

    ``certified``: of the axes whose controllers have certificates.
    """
    axes = tuple(
        AxisPlan(
            name,
            drive.limits.torque_max_nm / drive.motor.parameters.inertia_kg_m2,
            drive.motor.parameters.rated_torque_nm,
            certified.get(name),
            drive.limits.torque_max_nm,
            drive.limits.speed_max_rpm * RAD_S_PER_RPM,
            quantity_of(config, name).value,
            drive.mode,
        )
        for name, drive in sorted(config.drive.items())
    )
    return ReviewPlan(
        axes,
        _limits(config, certified.values(), real_time),
        config.verdict.settling,
        config.verdict.settling_band_percent,
        config.loop.period,
    )


def recording_plan(
    config: BenchConfig,
    world: World,
    folder: Path | None,
    seed: int,
    bus: str,
    view: bool,
    certified: Mapping[str, CertifiedPlan],
) -> RecordingPlan:
    """What a recording of the bench has to know; ``bus``, ``seed``, ``view``: of this run.

    ``folder``: None if no files are to be kept. ``certified``: of the axes whose controllers have
    certificates.
    """
    return RecordingPlan(
        folder=folder,
        name=config.bench.name,
        seed=seed,
        bus=bus,
        real_time=world.real_time,
        deadline=config.loop.deadline,
        review=review_plan(config, certified, world.real_time),
        bench_toml=(with_kept_signals(config) if folder else config).resolved_text(bus_spec=bus, seed=seed),
        started_at=world.clock.now(),
        wall_offset=world.wall_offset,
        frames=config.recording.frames,
        segments=tuple(segment.name for segment in config.bus.segment),
        faults=config.faults is not None,
        period_us=config.loop.period_us,
        view=view,
        set_points=_set_points(config),
        observed=observed_drives(config),
        notes=recording_notes(config, bus),
    )


def observed_drives(config: BenchConfig) -> dict[str, ObservedDrive]:
    """What drives tell for the recording alone."""
    segments = [None, *(segment.name for segment in config.bus.segment)]
    return {
        axis: ObservedDrive(
            drive.node,
            segments.index(drive.segment),
            tuple(
                ObservedSignal(each.key, each.entry.code, each.title, each.told_unit, each.factor)
                for each in drive.observe
            ),
        )
        for axis, drive in sorted(config.drive.items())
        if drive.observe
    }


def recording_notes(config: BenchConfig, bus: str) -> dict[str, str]:
    """What is shown beside the verdict; ``bus``: of the run. What differs by axis is told of each."""
    drives = {axis: config.drive[axis] for axis in config.axes}
    notes: dict[str, dict[str, str]] = {
        "motor": {axis: drive.motor.motor.name for axis, drive in drives.items()},
        "controller": {axis: drive.controller.kind for axis, drive in drives.items()},
        "compensator": {axis: drive.compensator.kind for axis, drive in drives.items()},
        "current loops": {axis: _current_loops(drive) for axis, drive in drives.items()},
    }
    return {"bus": bus, **{key: _by_axis(told) for key, told in notes.items() if any(told.values())}}


def _current_loops(drive: DriveConfig) -> str:
    """Of a simulated drive, where they are not its PI loops."""
    loops = drive.current_control
    own = {"q": loops.controller, "d": loops.controller_d}
    return ", ".join(f"{axis} {each.kind}" for axis, each in own.items() if each is not None)


def _by_axis(told: Mapping[str, str]) -> str:
    if len(set(told.values())) == 1:
        return next(iter(told.values()))
    return ", ".join(f"{axis} {text or '-'}" for axis, text in told.items())


def _limits(config: BenchConfig, certified: Collection[CertifiedPlan], real_time: bool) -> VerdictLimits:
    """The bench file's, with what the controllers' files ask of the torque; of several the smallest.

    What the controllers take of the host is judged where the drives wait for it.
    """
    asked = [config.verdict.torque_rms_nm_max, *(plan.torque_rms_nm_max for plan in certified)]
    return replace(
        config.verdict.limits if real_time else replace(config.verdict.limits, compute_us_max=None),
        torque_rms_nm_max=min((each for each in asked if each is not None), default=None),
    )


def _set_points(config: BenchConfig) -> tuple[PlannedSetPoint, ...]:
    """What the bench file plans for each axis, in words."""
    planned: list[PlannedSetPoint] = []
    for number, axis in enumerate(config.axes):
        profiles = (("reference", config.reference.get(axis, ())), ("load", config.load.get(axis, ())))
        for what, entries in profiles:
            for entry in entries:
                text = f"{axis}: {what} {entry.describe()}"
                planned.append(PlannedSetPoint(duration_s(entry.at_s), number, text))
                if isinstance(entry, SignalFile):
                    text = f"{axis}: {what} of {Path(entry.path).name} ends"
                    planned.append(PlannedSetPoint(duration_s(entry.ends_s), number, text))
    return tuple(sorted(planned))
