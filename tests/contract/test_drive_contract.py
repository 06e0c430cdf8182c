"""What the drive client promises, on the simulated drive over the simulated segment."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import can
import pytest

from servobench.design.motor import PmsmParameters, Transform
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import DriveInFault, NoAnswer
from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.faults.fault_injector import FaultInjector
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.faulty_bus import FaultyBus
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import SimulatedClock, Timeline
from tests.draws import few_of
from tests.fates import keys

MOTOR = PmsmParameters(
    name="Ling2012",
    resistance_ohm=2.875,
    inductance_d_h=0.0085,
    inductance_q_h=0.0085,
    flux_linkage_wb=math.sqrt(1.5) * 0.0816,
    pole_pairs=4,
    inertia_kg_m2=0.0008,
    viscous_friction_nm_s=0.00185,
    coulomb_friction_nm=0.0,
    transform=Transform.POWER_INVARIANT,
    rated_torque_nm=2.0,
    rated_speed_rad_s=157.0,
    current_max_a=15.0,
    dc_bus_voltage_v=300.0,
)
PERIOD = Duration(NS_PER_MS)
SETTINGS = DriveSettings(
    PERIOD, torque_max_nm=4.0, speed_max_rad_s=250.0, quick_stop_deceleration_rad_s2=1500.0
)


@dataclass
class Bench:
    timeline: Timeline
    segment: CanSegment
    bus: can.BusABC
    device: SimulatedServo
    network: CanopenNetwork
    drive: ServoDrive

    def soon(self, seconds: float = 1.0) -> Instant:
        return self.network.deadline_after(Duration(int(seconds * NS_PER_S)))

    def enable(self, settings: DriveSettings = SETTINGS) -> None:
        self.drive.connect(self.soon())
        self.drive.configure(settings)
        self.drive.enable(self.soon(5.0))

    def run(self, cycles: int, torque_nm: float) -> list[Reading]:
        """Cycles of SYNC, readings and a command that answers each reading."""
        start = self.network.clock.now()
        taken: list[Reading] = []
        for cycle in range(1, cycles + 1):
            due = Instant(start + cycle * PERIOD)
            self.network.send_sync()
            while self.network.pump_one(due):
                for reading in self.drive.take_readings():
                    taken.append(reading)
                    self.drive.write(Command(cycle, torque_nm, due, due))
            self.drive.check()
        return taken

    def listen(self, cycles: int) -> None:
        """Nothing is sent but heartbeats."""
        for _ in range(cycles):
            self.network.pump(self.soon(0.001))
            self.drive.check()


def make_bench(plan: FaultPlan | None = None, seed: int = 0) -> Bench:
    """The drive and its client on one segment; the client's side is faulty if there is a plan."""
    timeline = Timeline()
    clock, segment = SimulatedClock(timeline), CanSegment(timeline)
    device = SimulatedServo(1, MOTOR, DriveParameters(), 1)
    AttachedDevice(device, segment)
    bus: can.BusABC = SimulatedBus(segment=segment)
    if plan is not None:
        faulty = FaultyBus(bus, FaultInjector(plan, seed), clock, side="host")
        faulty.start(clock.now())
        bus = faulty
    network = CanopenNetwork(BusLink(bus, clock, StampSource.MONOTONIC, "simulated"), clock, writes=RIG)
    return Bench(timeline, segment, bus, device, network, ServoDrive(network, 1, "axis1"))


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = make_bench()
    yield made
    made.bus.shutdown()


def test_every_setting_is_taken(bench: Bench) -> None:
    bench.drive.connect(bench.soon())
    notes = bench.drive.configure(SETTINGS)
    assert [note for note in notes if not note.endswith(" written")] == []
    assert bench.drive.rated_torque_nm == pytest.approx(2.0)
    assert bench.drive.plan is not None
    assert [pdo.bits for pdo in bench.drive.plan.tpdos] == [64, 64, 24]


def test_each_sync_gives_one_reading_with_a_stamp_of_its_sync(bench: Bench) -> None:
    bench.enable()
    readings = bench.run(200, 0.0)
    stamps = [reading.device_time_ns for reading in readings if reading.device_time_ns is not None]
    assert len(stamps) == 200
    # A SYNC may have to wait for a frame, and a stamp be one inner tick of 62.5 us old.
    assert all(abs(later - stamp - PERIOD) < 200 * NS_PER_US for stamp, later in pairwise(stamps))
    assert bench.drive.assembler.malformed == 0


def test_torque_moves_the_shaft_as_newton_says(bench: Bench) -> None:
    bench.enable()
    readings = bench.run(101, 1.0)
    elapsed_s = (readings[100].received_at - readings[50].received_at) / NS_PER_S
    speeds = readings[50].velocity_rad_s, readings[100].velocity_rad_s
    friction_nm = MOTOR.viscous_friction_nm_s * sum(speeds) / 2
    gained = elapsed_s * (1.0 - friction_nm) / MOTOR.inertia_kg_m2
    assert speeds[1] - speeds[0] == pytest.approx(gained, rel=0.02)
    turned = readings[100].position_rad - readings[50].position_rad
    assert turned == pytest.approx(elapsed_s * sum(speeds) / 2, rel=0.02)
    assert readings[100].torque_nm == pytest.approx(1.0, rel=0.03)


def test_quick_stop_ends_at_rest_and_disabled(bench: Bench) -> None:
    bench.enable()
    assert bench.run(100, 1.0)[-1].velocity_rad_s > 80.0
    bench.drive.quick_stop(bench.soon())
    assert bench.drive.state is State.SWITCH_ON_DISABLED


def test_disable_goes_down_the_ramp(bench: Bench) -> None:
    bench.enable()
    bench.run(100, 1.0)
    bench.drive.disable(bench.soon(3.0))
    assert bench.drive.state is State.SWITCH_ON_DISABLED


def test_a_released_drive_stays_without_a_fault_when_the_host_is_gone(bench: Bench) -> None:
    bench.enable()
    bench.run(100, 1.0)
    assert bench.drive.release()[:3] == (True, State.SWITCH_ON_DISABLED, "")
    bench.network.produce_heartbeat(Duration(0))
    bench.network.pump(bench.soon())
    assert bench.drive.control.read_state() is State.SWITCH_ON_DISABLED
    assert bench.network.emergencies_seen == 0


def test_a_released_drive_can_be_had_again(bench: Bench) -> None:
    bench.enable()
    bench.drive.release()
    bench.drive.configure(SETTINGS)
    bench.drive.enable(bench.soon())
    assert len(bench.run(10, 0.1)) == 10


def test_a_drive_that_misses_the_host_stops_by_itself(bench: Bench) -> None:
    bench.enable()
    bench.run(100, 1.0)
    bench.network.produce_heartbeat(Duration(0))
    with pytest.raises(DriveInFault, match="8130h"):
        bench.run(2000, 0.0)
    assert not bench.drive.enabled
    bench.network.pump(bench.soon())
    assert bench.drive.control.read_state() is not State.OPERATION_ENABLED


def test_synchronous_set_points_act_too(bench: Bench) -> None:
    bench.enable(replace(SETTINGS, synchronous_command=True))
    assert bench.drive.plan is not None
    assert bench.drive.plan.rpdos[0].synchronous
    assert bench.run(50, 1.0)[-1].velocity_rad_s > 30.0
    assert bench.drive.release().at_rest


def test_a_seldom_position_agrees_with_one_of_every_cycle(bench: Bench) -> None:
    bench.enable(replace(SETTINGS, position_every_cycles=10))
    readings = bench.run(200, 1.0)
    assert len(readings) == 200
    for earlier, later in pairwise(readings[20:]):
        turned_rad = 0.5 * (earlier.velocity_rad_s + later.velocity_rad_s) * PERIOD / NS_PER_S
        assert later.position_rad - earlier.position_rad == pytest.approx(turned_rad, abs=0.02), (
            "what is told every tenth time is what was carried on to"
        )
    last = readings[-1]
    # The drive's own position is of the last time that it had to look, up to a period after the last SYNC.
    at_rad = bench.device.drive.objects.position.read() * math.tau / 65536
    assert -0.1 < at_rad - last.position_rad < last.velocity_rad_s * PERIOD / NS_PER_S + 0.1
    ages = [reading.received_at - reading.position_told_at for reading in readings[20:]]
    assert 9 * PERIOD < max(ages) < 10 * PERIOD
    assert None not in {reading.device_time_ns for reading in readings}, "each has its stamp all the same"


def test_nobody_at_another_node_id(bench: Bench) -> None:
    with pytest.raises(NoAnswer, match="node 2 on simulated"):
        ServoDrive(bench.network, 2).connect(bench.soon(0.5))


@pytest.mark.parametrize("seed", few_of(range(5), 2))
def test_a_bus_that_loses_every_tenth_frame_is_lived_with(seed: int) -> None:
    frames = ("pdo", "sdo", "nmt")
    loss = Loss(frames=frames, probability=0.1)
    bench = make_bench(FaultPlan((loss,)), seed)
    bench.enable()
    readings = bench.run(200, 0.3)
    assert 120 < len(readings) < 190
    assert bench.drive.release()[:3] == (True, State.SWITCH_ON_DISABLED, "")
    bench.bus.shutdown()


@pytest.mark.parametrize("seed", few_of(range(5), 2))
def test_a_speed_and_its_stamp_are_of_one_sync_on_a_lossy_bus(seed: int) -> None:
    bench = make_bench(FaultPlan((Loss(probability=0.3),)), seed)
    bench.enable()
    bench.run(10, 1.0)
    readings = bench.run(100, 1.0)
    assert 40 < len(readings) < 100
    for earlier, later in pairwise(readings):
        assert earlier.device_time_ns is not None
        assert later.device_time_ns is not None
        elapsed_s = (later.device_time_ns - earlier.device_time_ns) / NS_PER_S
        friction_nm = MOTOR.viscous_friction_nm_s * earlier.velocity_rad_s
        gained = elapsed_s * (1.0 - friction_nm) / MOTOR.inertia_kg_m2
        assert later.velocity_rad_s - earlier.velocity_rad_s == pytest.approx(gained, abs=0.5)
        turned = elapsed_s * (earlier.velocity_rad_s + later.velocity_rad_s) / 2
        assert later.position_rad - earlier.position_rad == pytest.approx(turned, abs=0.02)
    bench.bus.shutdown()


def test_read_backs_show_which_commands_the_drive_follows(bench: Bench) -> None:
    bench.enable()
    bench.run(1, 0.0)
    bench.drive.take_readbacks()
    due = bench.soon(0.001)
    sent = bench.drive.write(Command(1, 0.5, due, due))
    assert sent is not None
    bench.run(2, 0.5)
    assert bench.drive.take_readbacks()[-1].demand_raw == sent.raw == 250


def test_a_drive_that_hears_no_command_stops_by_itself(bench: Bench) -> None:
    bench.enable(replace(SETTINGS, command_timeout_ms=20))
    assert bench.drive.supervise_commands().startswith("the drive itself (1400h:05), after 20 ms")
    assert bench.run(100, 0.5)[-1].velocity_rad_s > 40.0
    began = bench.network.clock.now()
    with pytest.raises(DriveInFault, match="8250h"):
        bench.listen(cycles=1000)
    assert (bench.network.clock.now() - began) / NS_PER_S < 0.03
    assert bench.drive.release().at_rest


def test_a_drive_that_is_let_go_stops_by_no_timer(bench: Bench) -> None:
    bench.enable(replace(SETTINGS, command_timeout_ms=20))
    bench.drive.supervise_commands()
    bench.run(100, 0.5)
    bench.drive.disable(bench.soon(3.0))
    bench.network.pump(bench.soon())
    assert bench.network.emergencies_seen == 0


def test_a_fault_is_noticed_in_the_cycle_in_which_it_comes(bench: Bench) -> None:
    bench.enable()
    bench.run(20, 0.1)
    bench.device.drive.fail(0x2310, ErrorRegister.CURRENT)
    began = bench.network.clock.now()
    with pytest.raises(DriveInFault, match="2310h"):
        bench.run(20, 0.1)
    assert bench.network.clock.now() - began < 3 * PERIOD


def test_a_drive_that_nothing_stops_stops_by_the_end_of_the_heartbeat() -> None:
    """Every SDO and RPDO to the first of two drives is lost. The second is let go in order all the same."""
    to_the_first = keys(direction="host_to_drive", frames=(0x601, 0x201), from_s=1e-9 * NS_PER_S)
    bench = make_bench(FaultPlan((Loss(**to_the_first, probability=1.0),)))
    AttachedDevice(SimulatedServo(2, MOTOR, DriveParameters(), 2), bench.segment)
    other = ServoDrive(bench.network, 2, "axis2")
    other.connect(bench.soon())
    other.configure(SETTINGS)
    bench.enable()
    other.enable(bench.soon())
    bench.run(300, 0.3)
    bench.network.pump(Instant(NS_PER_S))
    assert bench.device.drive.power.state is State.OPERATION_ENABLED

    released = bench.drive.release(Duration(NS_PER_S // 2))
    assert not released.at_rest
    assert "the host's heartbeat ended: each drive on simulated that watches it (1016h)" in released.evidence
    assert not bench.network.produces_heartbeat
    ended = other.release()
    assert ended.at_rest, ended
    bench.network.pump(bench.soon(0.4))
    assert bench.device.drive.power.state is not State.OPERATION_ENABLED
    assert abs(bench.device.drive.firmware.speed_rad_s) < 1.0
    bench.bus.shutdown()
