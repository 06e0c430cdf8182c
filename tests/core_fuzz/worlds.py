"""What the core is given: by a seed, frames, drives with what befalls them, and arguments that are none."""

import gc
import math
import os
import random
import weakref
from collections.abc import Callable
from dataclasses import replace
from struct import Struct, pack
from typing import Any, Final

import can
import numpy as np

from servobench.design.core import native
from servobench.design.iron import Iron
from servobench.design.motor import PmsmParameters
from servobench.design.statespace import StateSpace
from servobench.drivers.core.native import Link, Pump, WireFrame
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.core.native import FrameSink, RegularStream, Ring, frame_row
from servobench.hil.recording.ring import RingReader, RingWriter
from servobench.hil.rows.side_rows import FRAME
from servobench.virtual_bus.bus.host_port import HostPort
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.bus.port import TRANSMIT_QUEUE_MAX, Listener
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.core.native import (
    BusLoad,
    CyclicDevice,
    CyclicDrive,
    CyclicRpdo,
    CyclicTpdo,
    DeviceClock,
    DeviceSeat,
    EntryBlock,
    Fates,
    HeldFrames,
    Hold,
    HostPlace,
    InnerLoops,
    PdoCodec,
    Port,
    Queue,
    Route,
    Segment,
    SimulatedClock,
    Strike,
    SyncTaker,
    Timeline,
    Timer,
    UniformNumbers,
    clipped,
    sine_cosine,
    user_position,
    wire_bits,
)
from servobench.virtual_bus.drive.encoder import SpeedMethod, SpeedSensing
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.load_object import LoadTable
from servobench.virtual_bus.drive.mechanism import FieldOptions
from servobench.virtual_bus.drive.power_stage import Inverter
from servobench.virtual_bus.frame import Frame
from tests.core_fuzz.devices import devices
from tests.core_fuzz.fates import ODD, Refused, drawn_judge, odd_number
from tests.core_fuzz.hub_ends import hub_ends
from tests.core_fuzz.links import links
from tests.core_fuzz.machines import drawn_encoder, drawn_mechanism, drawn_path, drawn_sensors
from tests.core_fuzz.pdos import pdos
from tests.core_fuzz.receptions import receptions
from tests.core_fuzz.set_points import set_points
from tests.core_fuzz.streams import streams
from tests.motors import AZAIZ, LING

AWRY: Final[tuple[object, ...]] = (
    None,
    "",
    "1",
    b"",
    b"1234567",
    object(),
    1 << 80,
    -(1 << 80),
    1j,
    [],
    math.nan,
    ...,
)
ACTIONS: Final = 40
CALLED: Final[tuple[Callable[..., Any], ...]] = (
    *(clipped, sine_cosine, user_position, wire_bits, native.random_runs, frame_row, RegularStream, Ring),
    *(BusLoad, HeldFrames, HostPlace, Port, Segment, SimulatedClock, Timeline, PdoCodec, UniformNumbers),
    *(CyclicDevice, CyclicDrive, CyclicRpdo, CyclicTpdo, DeviceClock, DeviceSeat, SyncTaker, Timer),
    *(Strike, Hold, Queue, Route, EntryBlock, Fates, WireFrame, Link, Pump, FrameSink),
)
"""Functions and types of the cores."""


def frames(draw: random.Random) -> None:
    """Every length, and identifiers and data with long runs of equal bits."""
    for _ in range(200):
        extended = draw.random() < 0.5
        remote = draw.random() < 0.1
        octets = draw.randrange(9)
        data = bytes(draw.choice([0x00, 0xFF, draw.randrange(256)]) for _ in range(0 if remote else octets))
        high, low = draw.randrange(1 << 11), draw.randrange(1 << 18)
        key = high << 21 | (3 << 19 | low << 1 | remote if extended else remote << 20)
        bits = wire_bits(key << 4 | octets, data)
        least = (64 if extended else 44) + 8 * len(data)
        assert least <= bits <= least + (least - 11) // 4, (hex(key), data, bits)


def drive(draw: random.Random) -> None:
    """A drive that is used as the firmware uses it: any motor, rate, encoder, load, and hostile numbers."""
    rate_hz = draw.choice([1_000, 4_001, 8_000, 16_000, 100_000])
    motor = replace(
        draw.choice([AZAIZ, LING]),
        coulomb_friction_nm=draw.choice([0.0, 0.05]),
        inertia_kg_m2=10.0 ** draw.uniform(-6.0, 1.0),
    )
    if draw.random() < 0.5:
        motor = replace(motor, mechanism=drawn_mechanism(draw, motor))
    if draw.random() < 0.3:
        motor = replace(motor, iron=_iron(draw, motor))
    parameters = FirmwareParameters(
        field=FieldOptions(draw.random() < 0.3, draw.choice([0.0, 0.0, draw.uniform(0.5, 1.0)])),
        inner_rate_hz=rate_hz,
        encoder_counts_per_revolution=draw.choice([16, 1000, 65_536, 1 << 30]),
        controller_q=_controller(draw, rate_hz) if draw.random() < 0.3 else None,
        encoder=drawn_encoder(draw, rate_hz) if draw.random() < 0.5 else None,
        path=drawn_path(draw, rate_hz),
        inverter=Inverter(draw.choice([0.0, 0.5 / rate_hz]), draw.choice([0.0, 1.0]), draw.uniform(0.1, 1.0)),
        current_sensors=drawn_sensors(draw) if draw.random() < 0.5 else None,
        speed=SpeedSensing(
            draw.choice(list(SpeedMethod)),
            draw.choice([None, 10.0 ** draw.uniform(0.0, 5.0)]),
            draw.choice([None, 10.0 ** draw.uniform(5.0, 10.0)]),
            rate_hz * draw.uniform(1e-4, 0.25),
        ),
    )
    firmware = Firmware(motor, parameters)
    now = draw.randrange(1 << draw.randrange(1, 60))
    firmware.start(Instant(now))
    for _ in range(ACTIONS):
        draw.choice(_DONE)(firmware, draw, Instant(now))
        now += draw.choice([0, draw.randrange(NS_PER_MS), draw.randrange(20 * NS_PER_MS)])
        if draw.random() < 0.3:
            firmware.inner.advance_to_motion_tick(now)
        else:
            firmware.advance_to(Instant(now))
        assert firmware.tick_at <= now < firmware.tick_after(Instant(now + 1))
        _tell(firmware.inner, draw)
        assert len(firmware.inner.state()) == len(InnerLoops().state())


def _iron(draw: random.Random, motor: PmsmParameters) -> Iron:
    per_d, per_q = 1.0 / motor.inductance_d_h, 1.0 / motor.inductance_q_h
    knee_wb2 = motor.flux_linkage_wb**2 * draw.uniform(1.0, 4.0)
    return Iron(per_d, per_q, motor.flux_linkage_wb * per_d, knee_wb2, 10.0 ** draw.uniform(0.0, 7.0))


def _controller(draw: random.Random, rate_hz: int) -> StateSpace:
    order = draw.randrange(9)
    a = np.diag([draw.uniform(-0.9, 0.9) for _ in range(order)])
    return StateSpace(a, np.ones((order, 1)), np.ones((1, order)), np.array([[1.0]]), 1.0 / rate_hz)


def _tell(inner: InnerLoops, draw: random.Random) -> None:
    """Any units; a state that is no number is refused."""
    inner.origin, inner.counts_per_position = odd_number(draw), odd_number(draw)
    inner.velocity_per_rad_s, inner.torque_unit_nm = odd_number(draw), odd_number(draw)
    inner.set_switch(draw.randrange(3), odd_number(draw), odd_number(draw))
    assert inner.switch_seen(draw.randrange(3)) in (False, True)
    try:
        position, velocity, torque = inner.position_told(), inner.velocity_told(), inner.torque_told()
        demand = inner.torque_demand_told()
    except ValueError:
        return
    assert max(position, velocity) < 1 << 31
    assert min(position, velocity) >= -(1 << 31)
    assert max(torque, demand) < 1 << 15
    assert min(torque, demand) >= -(1 << 15)


def _bear(firmware: Firmware, draw: random.Random, now: Instant) -> None:
    points = draw.choice([0, 1, 2, 300])
    times = np.cumsum([10.0 ** draw.uniform(-6.0, -1.0) for _ in range(points)])
    torques = np.array([odd_number(draw) for _ in range(points)])
    begins = Instant(now + draw.randrange(-NS_PER_MS, NS_PER_MS))
    firmware.bear(LoadTable(times.tobytes(), torques.tobytes()), draw.random() < 0.5, begins)


_DONE: Final[tuple[Callable[[Firmware, random.Random, Instant], object], ...]] = (
    lambda firmware, draw, now: firmware.control(draw.choice(list(InnerControl))),
    lambda firmware, draw, now: firmware.demand_torque(odd_number(draw)),
    lambda firmware, draw, now: firmware.ramp_to_speed(
        odd_number(draw), abs(odd_number(draw)), odd_number(draw)
    ),
    lambda firmware, draw, now: firmware.limit(
        abs(odd_number(draw)), abs(odd_number(draw)), abs(odd_number(draw))
    ),
    lambda firmware, draw, now: firmware.hold_encoder(draw.random() < 0.5),
    lambda firmware, draw, now: firmware.bear(None),
    _bear,
)


def random_runs(draw: random.Random) -> None:
    """Runs of loops with any figures, hostile ones too: each has its peak, whatever is run with it."""
    figures = [10.0 ** draw.uniform(-6.0, 4.0) for _ in range(15)]
    if draw.random() < 0.5:
        figures[draw.randrange(15)] = draw.choice(ODD)
    behind, steps = draw.randrange(6), draw.randrange(200)
    seed, first, count = draw.getrandbits(64), draw.randrange(1000), draw.randrange(20)

    def peaks(begin: int, runs: int) -> bytes:
        octets = pack("=15d", *figures)
        return native.random_runs(seed, begin, runs, octets, strategy, losses_max, behind, steps)

    strategy, losses_max = draw.randrange(3), draw.randrange(5)
    assert peaks(first, count) == b"".join(peaks(first + number, 1) for number in range(count))


class _Answering(Listener):
    """Sends, detaches a port, lets time pass or raises, in the middle of a delivery."""

    def __init__(self, draw: random.Random, segment: CanSegment) -> None:
        self._draw = draw
        self._segment = segment

    def on_frame(self, frame: Frame, now: Instant) -> None:
        chance = self._draw.random()
        if chance < 0.2:
            _act_on_bus(self._draw, self._segment, now)
        elif chance < 0.22:
            raise Refused(frame)


def _frame(draw: random.Random) -> Frame:
    extended, remote = draw.random() < 0.2, draw.random() < 0.1
    can_id = draw.randrange(1 << 29) if extended else draw.choice([0x80, 0x181, draw.randrange(1 << 11)])
    return Frame(can_id, b"" if remote else draw.randbytes(draw.randrange(9)), extended, remote, remote * 4)


def _act_on_bus(draw: random.Random, segment: CanSegment, now: Instant) -> None:
    """One of what may be done at any instant, within a callback too."""
    ports = segment.ports
    if not ports:
        return
    port = draw.choice(ports)
    match draw.randrange(40):
        case 0:
            port.detach()
        case 1:
            segment.attach("late", _Answering(draw, segment))
        case 2:
            port.go_bus_off() if draw.random() < 0.1 else port.set_listen_only(False)
        case 3:
            segment.timeline.call_at(Instant(now + draw.randrange(NS_PER_MS)), port.send).cancel()
        case 4:
            segment.timeline.run_until(Instant(now + draw.randrange(NS_PER_MS)))
        case 5:
            port.on_sent = None if draw.random() < 0.5 else lambda frame, _at: port.send(frame)
        case _:
            port.send(_frame(draw))


def _used_bus(draw: random.Random) -> "weakref.ref[CanSegment]":
    """A segment whose ports come, go and answer in the middle of a delivery, hosts with faults, and
    callbacks that raise."""
    timeline = Timeline()
    segment = CanSegment(timeline, draw.choice([10_000, 500_000, 1_000_000]))
    for number in range(draw.randrange(1, 6)):
        segment.attach(f"port{number}", _Answering(draw, segment))
    hosts = [HostPort(segment, f"host{number}") for number in range(draw.randrange(3))]
    for host in hosts:
        host.put_before(drawn_judge(draw), draw.choice(list(Direction)))
        if draw.random() < 0.5:
            host.hear_itself()
    for _ in range(200):
        try:
            _act_on_bus(draw, segment, timeline.now)
            for host in hosts:
                host.transmit(_frame(draw))
                host.receive(Instant(timeline.now + draw.randrange(NS_PER_MS)))
        except (Refused, can.CanOperationError):
            continue
        assert all(0 <= port.pending <= TRANSMIT_QUEUE_MAX for port in segment.ports)
    return weakref.ref(segment)


def bus(draw: random.Random) -> None:
    """A bus that was used in any way is garbage at the end."""
    gone = _used_bus(draw)
    gc.collect()
    assert gone() is None


def ring(draw: random.Random) -> None:
    """A ring whose reader comes at any time, or within the writer's wait, which may raise and close it."""
    capacity, rows = 1 << draw.randrange(6), draw.choice([FRAME, Struct("<4s"), Struct("<37q")])

    def on_full() -> bool:
        chance = draw.random()
        if chance < 0.02:
            Ring.close(writer)
        elif chance < 0.1:
            raise Refused(chance)
        elif chance < 0.4:
            reader.drain()
        return chance < 0.8

    writer = RingWriter(rows, capacity, on_full)
    reader = RingReader(writer.descriptor, np.dtype(f"V{rows.size}"))
    sink = FrameSink(writer, draw.randrange(128))
    for _ in range(300):
        try:
            if draw.random() < 0.5:
                writer.push(draw.randbytes(rows.size))
            else:
                can_id, data = draw.getrandbits(33), draw.randbytes(draw.randrange(10))
                sink.show(Frame(can_id, data), draw.random() < 0.5, Instant(draw.getrandbits(63)))
            assert 0 <= writer.taken <= reader.released + capacity
        except (Refused, ValueError):
            continue
        assert len(reader.look()) <= capacity
    writer.close()


def _pump(link: Link) -> Pump:
    given: list[Any] = [{}, {}, *[lambda *_given: 0] * 4]
    return Pump(link, *given)


def misuse(draw: random.Random) -> None:
    """Arguments of wrong number, type, size and range: an error of Python's, or taken."""
    inner = InnerLoops()
    inner.rate_hz = 16_000
    timeline = Timeline()
    segment, held, place = Segment(timeline, 500_000), HeldFrames(), HostPlace(timeline)
    port = Port(segment, 1, "port", place)
    descriptor = os.memfd_create("fuzz")
    ring = Ring(descriptor, FRAME.size, 4, bool)
    os.close(descriptor)
    faults = (
        *(Strike("loss", (0, 9)), Hold((0, 9), True), Queue(), Route(None, (), ())),
        *(EntryBlock(), Fates(None, 0, 0)),
    )
    stream = RegularStream(1, 0, 64, NS_PER_MS, False, False)
    link = Link()
    link.use(HostPort(CanSegment(timeline, 500_000), "host"), SimulatedClock(timeline).now, (OSError,))
    pump = _pump(link)
    codec = PdoCodec([(None, 1 + number, number) for number in range(3)], draw.random() < 0.5)
    own = (
        *(codec, inner, timeline, segment, held, place, port, BusLoad(500_000), SimulatedClock(timeline)),
        *(ring, stream, link, pump, FrameSink(ring, 0)),
    )
    calls: list[Callable[..., Any]] = [
        getattr(each, name)
        for each in (*own, *faults)
        for name in dir(each)
        if callable(getattr(each, name)) and name[0] != "_"
    ]
    table = pack("=3d", 0.0, 1.0, 2.0)
    for _ in range(100):
        call = draw.choice([*CALLED, *calls])
        buses = (timeline, segment, port, place, Frame(1), link)
        odd = [*AWRY, *ODD, 0, 1, -1, 5, table, table[:8], *buses, {}, *faults, lambda: table, (0, 9)]
        given = [draw.choice(odd) for _ in range(draw.randrange(9))]
        try:
            call(*given)
        except (TypeError, ValueError, OverflowError, AttributeError, NotImplementedError):
            continue


WORLDS: Final = (
    frames, drive, random_runs, misuse, bus, ring, streams, pdos, links, devices, receptions, set_points,
    hub_ends,
)  # fmt: skip
