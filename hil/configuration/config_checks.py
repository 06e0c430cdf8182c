"""Checks of a bench file that no single key can make: values that do not go together."""

import math
from collections.abc import Iterator, Sequence

from servobench.drivers.canopen.cob_ids import BROADCASTS, EMERGENCY, NODE_BITS, SYNC
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.canopen.pdo_budget import budget_of
from servobench.drivers.cia402.drive_setup import NUMBERS, with_observed
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import Features, PlanWish
from servobench.drivers.cia402.profile import BENCH_MODES
from servobench.drivers.errors import MISSING, BadInput
from servobench.drivers.key_advice import nearest
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, US_PER_S, Duration, duration_s
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.configuration.config import BenchConfig, Bus, BusSegment, Host
from servobench.hil.configuration.config_axis import DriveConfig, observed_faults
from servobench.hil.configuration.controller_kinds import StampCompensator
from servobench.hil.configuration.mode_checks import Fault, mode_faults, reference_faults
from servobench.hil.configuration.references import Load, LoadStep, SignalFile, SineReference
from servobench.hil.loop.scenario import Quantity
from servobench.virtual_bus.drive.mechanism import NO_FIELD, speed_without_load_rad_s
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.kinds.chopper_off import ChopperOff
from servobench.virtual_bus.faults.kinds.loose_coupling import LooseCoupling

LOAD_DELAY_MAX_S = (1 << 32) * NS_PER_US // NS_PER_S
"""Range of 2100h:5, 32 bits of microseconds."""
TOLERANCE = 1.0 + 1e-9
"""So that a limit written as the rounded decimal of the motor's own is accepted."""


def cross_faults(config: BenchConfig, source: str) -> list[BadInput]:
    """Return every value that does not agree with another one; empty for a bench that can be run."""
    errors = [
        BadInput(source, key, value, expected, remedy)
        for check in _CHECKS
        for key, value, expected, remedy in check(config)
    ]
    try:
        parse_bus_spec(config.bus.spec, source, "bus.spec")
    except BadInput as error:
        errors.append(error)
    return errors


def idle_faults(config: BenchConfig) -> Iterator[str]:
    """Yield a note on each table of the fault plan that never acts on this bench."""
    if not isinstance(config.faults, FaultPlan):
        return
    nodes = {config.host.node, *(drive.node for drive in config.drive.values())}
    nodes |= {
        entry.can_id & NODE_BITS for _, _, segment in _every_segment(config) for entry in segment.background
    }
    duration = duration_s(config.bench.duration_s)
    parts = {drive.node: set(_parts(drive)) for drive in config.drive.values()}
    yield from (f"faults.{place}: {why}" for place, why in config.faults.idle(nodes, duration, parts))


def _parts(drive: DriveConfig) -> Iterator[str]:
    """Yield the parts of a simulated drive that a fault can strike and others lack."""
    like, turning = drive.simulation.like, drive.simulation.motor or drive.motor
    if like is not None and like.supply is not None and like.supply.chopper is not None:
        yield ChopperOff.needs_part
    mechanism = turning.parameters.mechanism
    if mechanism is not None and mechanism.coupling is not None:
        yield LooseCoupling.needs_part


def _nodes(config: BenchConfig) -> Iterator[Fault]:
    taken = {config.host.node: "host.node"}
    for axis in config.axes:
        key, node = f"drive.{axis}.node", config.drive[axis].node
        if node in taken:
            yield key, node, f"a node id of its own; {taken[node]} is {node} too", ""
        taken.setdefault(node, key)


def _segments(config: BenchConfig) -> Iterator[Fault]:
    names = [segment.name for segment in config.bus.segment]
    for index, name in enumerate(names):
        if name in names[:index]:
            yield f"bus.segment[{index}].name", name, "a name of its own", ""
    if names and not config.simulated:
        expected = "no further segments: they are made on the bus 'simulated' only"
        yield "bus.segment", f"{len(names)} on {config.bus.spec}", expected, "a bench has one real bus"
    if names and config.loop.sync != "own":
        expected = "no further segments: SYNCs are heard on one segment"
        yield (
            "bus.segment",
            f'{len(names)}, with loop.sync = "{config.loop.sync}"',
            expected,
            'loop.sync = "own"',
        )
    for axis in config.axes:
        segment = config.drive[axis].segment
        if segment is not None and segment not in names:
            expected = f"one of the bus.segment: {', '.join(names) or 'there is none'}"
            yield f"drive.{axis}.segment", segment, expected, "leave it out for the first segment"


def _times(config: BenchConfig) -> Iterator[Fault]:
    loop = config.loop
    horizon_us = loop.horizon_periods * loop.period_us
    if loop.decide_after_us >= loop.period_us:
        yield "loop.decide_after_us", loop.decide_after_us, f"less than loop.period_us = {loop.period_us}", ""
    if loop.deadline_us > horizon_us:
        expected = f"at most horizon_periods * period_us = {horizon_us}"
        yield "loop.deadline_us", loop.deadline_us, expected, "a reading is given up before it could be late"
    nodes: dict[str, Host | DriveConfig] = {"host": config.host}
    nodes |= {f"drive.{axis}": config.drive[axis] for axis in config.axes}
    for key, node in nodes.items():
        if node.heartbeat_timeout_ms <= node.heartbeat_ms:
            expected = f"more than {key}.heartbeat_ms = {node.heartbeat_ms}"
            remedy = f"{3 * node.heartbeat_ms} rides over two lost heartbeats"
            yield f"{key}.heartbeat_timeout_ms", node.heartbeat_timeout_ms, expected, remedy
    if config.bench.duration_s * 1e6 < loop.period_us:
        yield "bench.duration_s", config.bench.duration_s, "at least one loop.period_us", ""


def _postponed(config: BenchConfig) -> Iterator[Fault]:
    """Check the compensator: a command that acts on arrival acts on a sample of any age, and stamp needs
    fixed instants."""
    period_us = config.loop.period_us
    horizon_us = config.loop.horizon_periods * period_us
    for axis in config.axes:
        compensator = config.drive[axis].compensator
        if not isinstance(compensator, StampCompensator):
            continue
        key, delay_us = f"drive.{axis}.compensator", compensator.delay_us
        if config.loop.actuation == "on_arrival":
            expected = 'arrival while loop.actuation = "on_arrival": commands act at no fixed instants then'
            yield f"{key}.kind", compensator.kind, expected, 'loop.actuation = "on_sync"'
        if delay_us > horizon_us:
            expected = f"at most horizon_periods * period_us = {horizon_us}"
            yield f"{key}.delay_us", delay_us, expected, ""
        if delay_us % period_us:
            expected = f"a whole number of periods of {period_us} us: drives sample and act at SYNCs"
            whole_us = delay_us // period_us * period_us
            nearest_us = f"{whole_us} or {whole_us + period_us}" if whole_us else f"{period_us}"
            yield f"{key}.delay_us", delay_us, expected, nearest_us


def _bus(config: BenchConfig) -> Iterator[Fault]:
    """Check that the frames of a cycle fit into it whatever their data are; other traffic is extra."""
    for key, name, segment in _every_segment(config):
        axes = [axis for axis in config.axes if config.drive[axis].segment == name]
        yield from _cycle_fits(config, axes, f"{key}.bitrate_bit_s", segment.bitrate_bit_s)


def _every_segment(config: BenchConfig) -> Iterator[tuple[str, str | None, Bus | BusSegment]]:
    """Yield key, name and tables of each segment; the first one is the bus itself, without a name."""
    yield "bus", None, config.bus
    for index, segment in enumerate(config.bus.segment):
        yield f"bus.segment[{index}]", segment.name, segment


def _cycle_fits(config: BenchConfig, axes: Sequence[str], key: str, bitrate_bit_s: int) -> Iterator[Fault]:
    plans = [standard_plan(config, axis) for axis in axes]
    least_us = config.loop.period_us
    while (needed_us := _time_of_frames_us(plans, least_us, bitrate_bit_s)) > least_us:
        least_us = needed_us  # in which a statusword may be told once more
    if config.loop.period_us < least_us:
        expected = f"at least {least_us}, which {len(plans)} drive(s) may take at {bitrate_bit_s} bit/s"
        remedy = f"raise loop.period_us or {key}"
        if config.loop.position_every_cycles == 1:
            remedy += ", or set loop.position_every_cycles = 10"
        yield "loop.period_us", config.loop.period_us, expected, remedy


def standard_plan(config: BenchConfig, axis: str) -> PdoPlan:
    """Return the PDOs of a drive without a data sheet, with the observed objects if they fit."""
    drive = config.drive[axis]
    wish = PlanWish(
        BENCH_MODES[drive.mode],
        position_every_cycles=config.loop.position_every_cycles,
        features=Features(counted=config.counted(axis)),
        coherent=config.coherent(axis),
        mode_apart=not drive.observed.entries,
    )
    plan = mode_plan(drive.node, wish, demand_changes=config.loop.command_readback == "event")
    return with_observed(plan, drive.node, drive.observed) or plan


def _observed(config: BenchConfig) -> Iterator[Fault]:
    for axis in config.axes:
        drive, key = config.drive[axis], f"drive.{axis}.observe"
        faults = list(observed_faults(key, drive.observe))
        yield from faults
        if not drive.observe or faults:
            continue
        if not config.recording.frames:
            expected = "true: what a drive tells beside the loop is read from its frames"
            yield "recording.frames", False, expected, f"or leave {key} out"
        plan = standard_plan(config, axis)
        if drive.eds is None and not plan.observed:
            left = len(NUMBERS) - len(plan.tpdos)
            bits = sum(entry.bits for entry in drive.observed.entries)
            expected = (
                f"what the TPDOs that the loop leaves can carry, {left} of {len(NUMBERS)}, 8 bytes each"
            )
            remedy = 'loop.command_readback = "sync" leaves one more' if not left else ""
            yield key, f"{len(drive.observe)} objects of {bits // 8} bytes", expected, remedy


def _time_of_frames_us(plans: Sequence[PdoPlan], period_us: int, bitrate_bit_s: int) -> int:
    """Return the time of a cycle's frames, with the most stuff bits."""
    return math.ceil(budget_of(plans, Duration(period_us * NS_PER_US), bitrate_bit_s).busy_ns / NS_PER_US)


def _background(config: BenchConfig) -> Iterator[Fault]:
    """Check that other nodes' frames cannot be taken for those of the bench and its drives."""
    nodes = {config.host.node, *(drive.node for drive in config.drive.values())}
    for key, _, segment in _every_segment(config):
        for index, entry in enumerate(segment.background):
            place = f"{key}.background[{index}]"
            if entry.can_id == SYNC and not entry.extended and config.loop.sync == "foreign":
                if entry.bytes_max or entry.remote:
                    yield f"{place}.bytes_max", entry.bytes_max, "0: a SYNC without counter", ""
                continue
            of_node = entry.can_id > EMERGENCY and entry.can_id & NODE_BITS in nodes
            if (of_node or entry.can_id in BROADCASTS) and not entry.extended:
                expected = (
                    "an identifier that CiA 301 gives neither to the whole network nor to a node of the bench"
                )
                yield f"{place}.can_id", f"0x{entry.can_id:X}", expected, ""


def _limits(config: BenchConfig) -> Iterator[Fault]:
    for axis in config.axes:
        drive = config.drive[axis]
        motor = drive.motor.parameters
        key = f"drive.{axis}.limits"
        if drive.limits.torque_max_nm > motor.torque_max_nm * TOLERANCE:
            gives = f"the motor {motor.name} gives at {motor.current_max_a:g} A"
            expected = f"at most {motor.torque_max_nm:.4g} N m, what {gives}"
            yield f"{key}.torque_max_nm", drive.limits.torque_max_nm, expected, ""
        simulation = drive.simulation
        bandwidth_hz, fastest_hz = simulation.current_bandwidth_hz, simulation.inner_rate_hz / 8
        if bandwidth_hz is not None and bandwidth_hz > fastest_hz:
            expected = f"at most {fastest_hz:g}, an eighth of inner_rate_hz"
            yield f"drive.{axis}.simulation.current_bandwidth_hz", bandwidth_hz, expected, ""
        field = NO_FIELD if simulation.like is None else simulation.like.field.parameters
        weakens = config.simulated and field.voltage_share > 0.0
        speed = speed_without_load_rad_s(motor, field if weakens else NO_FIELD) / RAD_S_PER_RPM
        if drive.limits.speed_max_rpm > speed * TOLERANCE:
            ends = f"where {motor.name}'s back-EMF takes {motor.dc_bus_voltage_v:g} V"
            if weakens:
                ends = f"as far as {motor.name}'s field is weakened"
            expected = f"at most {speed:.0f} r/min, {ends}"
            yield f"{key}.speed_max_rpm", drive.limits.speed_max_rpm, expected, ""


def _simulations(config: BenchConfig) -> Iterator[Fault]:
    """Check simulations: a seed draws everything in a data sheet and a motor file; a stamp advances by a
    count at least."""
    for axis in config.axes:
        simulation, key = config.drive[axis].simulation, f"drive.{axis}.simulation"
        beside = [name for name in ("eds", "motor", "believes") if getattr(simulation, name) is not None]
        if simulation.rehearse is not None and beside:
            yield f"{key}.rehearse", simulation.rehearse, f"no {key}.{beside[0]} beside it", ""
        turns, believes = (simulation.motor or config.drive[axis].motor).motor, simulation.believes
        for name in ("pole_pairs", "transform"):
            there = getattr(turns, name)
            known = there if believes is None else getattr(believes.motor, name)
            if known != there:
                expected = f"{there}, as of the motor on its shaft: without it no drive starts"
                yield f"{key}.believes.motor.{name}", known, expected, ""
        encoder = None if simulation.like is None else simulation.like.encoder
        period_us = US_PER_S / simulation.inner_rate_hz
        if encoder is not None and encoder.delay_us > period_us:
            expected = f"at most {period_us:g}, an inner period"
            yield f"{key}.like.encoder.delay_us", encoder.delay_us, expected, ""
        fastest_rad_s = 0.25 * simulation.inner_rate_hz
        if encoder is not None and encoder.speed.bandwidth_rad_s > fastest_rad_s:
            expected = f"at most {fastest_rad_s:g}, a quarter of inner_rate_hz"
            yield f"{key}.like.encoder.speed.bandwidth_rad_s", encoder.speed.bandwidth_rad_s, expected, ""
        set_point = None if simulation.like is None else simulation.like.set_point
        if set_point is not None and set_point.notch is not None:
            frequency_hz, most_hz = set_point.notch.frequency_hz, 0.4 * simulation.inner_rate_hz
            if frequency_hz >= most_hz:
                expected = f"below {most_hz:g}, two fifths of inner_rate_hz"
                yield f"{key}.like.set_point.notch.frequency_hz", frequency_hz, expected, ""
        unit_us, resolution_us = simulation.stamp_unit_us, simulation.stamp_resolution_us
        if resolution_us < unit_us:
            yield f"{key}.stamp_resolution_us", resolution_us, f"at least stamp_unit_us = {unit_us:g}", ""


def _profiles(config: BenchConfig) -> Iterator[Fault]:
    profiles = (("reference", config.reference), ("load", config.load))
    for table, profile in profiles:
        for axis, entries in profile.items():
            key = f"{table}.{axis}"
            if axis not in config.drive:
                yield _no_axis(key, axis, config)
                continue
            yield from _order(key, [entry.at_s for entry in entries], config.bench.duration_s)
    for axis in config.axes:
        yield from _demands(axis, config.drive[axis], config)


def _load_machine(config: BenchConfig) -> Iterator[Fault]:
    machine = config.load_machine
    if machine is None:
        return
    key = "load_machine"
    if machine.axis is None and len(config.axes) > 1:
        yield f"{key}.axis", MISSING, f"one of the axes: {', '.join(config.axes)}", ""
    elif machine.axis is not None and machine.axis not in config.drive:
        yield _no_axis(f"{key}.axis", machine.axis, config)
    if machine.kind == "magtrol_dsp6001" and machine.channel != 1:
        yield f"{key}.channel", machine.channel, "1, the only channel of a DSP6001", ""
    for index, entry in enumerate(config.load.get(config.load_machine_axis or "", ())):
        place, least_nm = _torque_of(f"load.{config.load_machine_axis}[{index}]", entry)
        if least_nm < 0.0:
            yield place, least_nm, "0 or more: a brake takes power and gives none", ""
        if abs(entry.level) > machine.torque_max_nm:
            yield place, entry.level, f"at most {key}.torque_max_nm = {machine.torque_max_nm:g}", ""


def _torque_of(key: str, entry: Load) -> tuple[str, float]:
    """Return the key of its torque, and the torque's least value, N m."""
    if isinstance(entry, LoadStep):
        return f"{key}.torque_nm", entry.torque_nm
    return f"{key}.path", entry.signal.least


def _load_files(axis: str, entries: Sequence[Load], config: BenchConfig) -> Iterator[Fault]:
    """Check loads over time: torques only, and alone; a simulated drive begins with the run's first SYNC."""
    for index, entry in enumerate(entries):
        if not isinstance(entry, SignalFile):
            continue
        key = f"load.{axis}[{index}]"
        if entry.quantity is not Quantity.TORQUE:
            yield f"{key}.path", entry.path, "a file with torque_nm: a load is a torque", ""
        if entry.repeats:
            yield f"{key}.repeats", True, "absent: a load from a file comes once", ""
        if len(entries) > 1:
            yield key, f"{len(entries)} entries", "one entry: a load from a file is alone on its axis", ""
        if entry.at_s > LOAD_DELAY_MAX_S:
            yield f"{key}.at_s", entry.at_s, f"at most {LOAD_DELAY_MAX_S}, which 2100h:5 can say", ""
        if config.loop.sync != "own" and config.load_machine_axis != axis:
            expected = 'loop.sync = "own": the drive begins the load with the run\'s first SYNC'
            yield "loop.sync", config.loop.sync, expected, ""


def _no_axis(key: str, name: str, config: BenchConfig) -> Fault:
    near = nearest(name, config.axes)
    return key, name, f"one of the axes: {', '.join(config.axes)}", f"did you mean {near}?" if near else ""


def _order(key: str, times_s: list[float], duration_s: float) -> Iterator[Fault]:
    for index, at_s in enumerate(times_s):
        place = f"{key}[{index}].at_s"
        if at_s >= duration_s:
            yield place, at_s, f"less than bench.duration_s = {duration_s}", ""
        if index and at_s <= times_s[index - 1]:
            yield place, at_s, f"more than the entry before it, {times_s[index - 1]}", ""


def _demands(axis: str, drive: DriveConfig, config: BenchConfig) -> Iterator[Fault]:
    yield from reference_faults(axis, drive, config)
    fastest_hz = NS_PER_S / (2 * config.loop.period)
    for index, segment in enumerate(config.reference.get(axis, ())):
        if isinstance(segment, SineReference) and segment.frequency_hz > fastest_hz:
            expected = f"at most {fastest_hz:g}, half the rate of the loop"
            yield f"reference.{axis}[{index}].frequency_hz", segment.frequency_hz, expected, ""
        if isinstance(segment, SignalFile) and segment.repeats and segment.signal.last_s <= 0.0:
            expected = f"absent: the last row of {segment.path} comes at {segment.signal.last_s:g} s"
            yield f"reference.{axis}[{index}].repeats", True, expected, "a cycle lasts until the last row"
    loads = config.load.get(axis, ())
    yield from _load_files(axis, loads, config)
    for index, entry in enumerate(loads):
        if abs(entry.level) > drive.limits.torque_max_nm:
            expected = (
                f"at most drive.{axis}.limits.torque_max_nm = {drive.limits.torque_max_nm:g} in magnitude"
            )
            place, _ = _torque_of(f"load.{axis}[{index}]", entry)
            yield place, entry.level, expected, "no command could hold it"


_CHECKS = (
    _nodes,
    _segments,
    _times,
    _postponed,
    _bus,
    _observed,
    _background,
    _limits,
    _simulations,
    _profiles,
    _load_machine,
    mode_faults,
)
