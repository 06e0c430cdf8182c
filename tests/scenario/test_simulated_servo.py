"""The simulated drive on a segment in simulated time: SYNC -> TPDOs, RPDO -> torque, at the bus's pace."""

import itertools
import struct

import pytest

from servobench.drivers.cia402.profile import State
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.hosting.devices import AttachedDevice
from servobench.virtual_bus.timeline import Timeline
from tests.hearing import Hearing
from tests.motors import AZAIZ, LING

SYNC = Frame(0x80)


class Master:
    """Sends frames at chosen instants and notes what comes back, and when."""

    def __init__(self) -> None:
        self.timeline = Timeline()
        self.segment = CanSegment(self.timeline)
        self.heard: list[tuple[Frame, Instant]] = []
        self.port = self.segment.attach("master", Hearing(lambda frame, at: self.heard.append((frame, at))))

    def add(self, node_id: int, servo: SimulatedServo) -> None:
        AttachedDevice(servo, self.segment, f"drive {node_id}")

    def wait_ms(self, milliseconds: float) -> None:
        self.timeline.run_until(Instant(self.timeline.now + round(milliseconds * NS_PER_MS)))

    def command(self, node_id: int, controlword: int, torque_raw: int = 0) -> None:
        self.port.send(Frame(0x200 + node_id, struct.pack("<Hh", controlword, torque_raw)))

    def enable(self, *nodes: int) -> None:
        self.port.send(Frame(0x000, b"\x01\x00"))
        for controlword in (0x06, 0x07, 0x0F):
            for node_id in nodes:
                self.command(node_id, controlword)
            self.wait_ms(1)
        self.heard.clear()

    def cycle(self, *nodes: int, torque_raw: int) -> None:
        """1 ms: SYNC at its start, the commands in its middle."""
        self.port.send(SYNC)
        self.wait_ms(0.6)
        for node_id in nodes:
            self.command(node_id, 0x0F, torque_raw)
        self.wait_ms(0.4)


@pytest.fixture
def master() -> Master:
    return Master()


def test_two_axes_close_a_millisecond_cycle_on_one_bus(master: Master) -> None:
    drives = {1: SimulatedServo(1, LING, seed=4), 2: SimulatedServo(2, AZAIZ, seed=4)}
    for node_id, servo in drives.items():
        master.add(node_id, servo)
    master.wait_ms(1)
    master.enable(1, 2)
    assert all(servo.drive.power.state is State.OPERATION_ENABLED for servo in drives.values())
    for _ in range(100):
        master.cycle(1, 2, torque_raw=300)
    identifiers = [frame.can_id for frame, _at in master.heard]
    assert identifiers == [0x181, 0x182, 0x281, 0x282] * 100, "by priority, after each SYNC"
    for servo, motor in ((drives[1], LING), (drives[2], AZAIZ)):
        acting_s = 0.1 - 0.6e-3
        gained = 0.3 * motor.rated_torque_nm / motor.inertia_kg_m2 * acting_s
        rate = motor.viscous_friction_nm_s / motor.inertia_kg_m2
        assert servo.drive.firmware.speed_rad_s == pytest.approx(gained * (1 - rate * acting_s / 2), rel=0.01)


def test_the_first_pdo_starts_when_the_sync_has_ended(master: Master) -> None:
    servo = SimulatedServo(1, LING)
    master.add(1, servo)
    master.wait_ms(1)
    master.enable(1)
    ends: list[tuple[int, Instant]] = []
    master.segment.add_monitor(lambda frame, at: ends.append((frame.can_id, at)))
    start = master.timeline.now
    master.cycle(1, torque_raw=0)
    assert [can_id for can_id, _at in ends] == [0x080, 0x181, 0x281, 0x201]
    assert 44_000 <= ends[0][1] - start <= 60_000, "an empty frame at 1 Mbit/s"
    for (_, earlier), (_, later) in itertools.pairwise(ends[:3]):
        assert 108_000 <= later - earlier <= 140_000, "three bits of intermission and eight bytes"


def test_a_set_point_acts_at_the_first_tick_after_its_frame(master: Master) -> None:
    servo = SimulatedServo(1, LING)
    master.add(1, servo)
    master.wait_ms(1)
    master.enable(1)
    master.command(1, 0x0F, 500)
    master.wait_ms(0.4)
    master.port.send(SYNC)
    master.wait_ms(0.4)
    (torque,) = struct.unpack_from("<h", master.heard[0][0].data, 6)
    assert torque > 400, "0.3 ms after the frame the current has nearly come up"


def test_unplugging_the_master_leaves_the_shaft_to_the_heartbeat_consumer(master: Master) -> None:
    servo = SimulatedServo(1, LING)
    master.add(1, servo)
    master.wait_ms(1)
    master.port.send(Frame(0x601, struct.pack("<BHBI", 0x23, 0x1016, 1, 127 << 16 | 150)))
    master.port.send(Frame(0x77F, b"\x05"))
    master.enable(1)
    for _ in range(80):
        master.cycle(1, torque_raw=700)
    assert servo.drive.firmware.speed_rad_s > 80.0
    master.port.detach()
    master.wait_ms(150)
    states = [servo.drive.power.state]
    master.wait_ms(200)
    states.append(servo.drive.power.state)
    assert states == [State.QUICK_STOP, State.SWITCH_ON_DISABLED]
    assert servo.drive.firmware.speed_rad_s == 0.0
