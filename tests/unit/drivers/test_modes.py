"""Every mode of operation from the drive client, on a scripted node with the wire watched."""

import math
from collections.abc import Iterator
from dataclasses import replace
from struct import unpack_from

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.motion import HomingSetup, MoveProfile
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import all_modes_plan
from servobench.drivers.cia402.profile import Mode, State
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import DriveInFault, PeerFault, TransferAborted
from servobench.drivers.exchange import Command, PositionCommand, SpeedCommand
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.link import Direction
from tests.unit.drivers.fake_bus import FakeBus, make_network
from tests.unit.drivers.profile_servo import ProfileServo

PERIOD = Duration(NS_PER_MS)
NOW = Instant(0)
TURN = 2 * math.pi
ENABLED = 0x0F
SWITCHABLE = (
    Mode.PROFILE_POSITION,
    Mode.PROFILE_VELOCITY,
    Mode.PROFILE_TORQUE,
    Mode.HOMING,
    Mode.CYCLIC_SYNCHRONOUS_POSITION,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE,
)


class Rig:
    """An enabled drive on the plan with three RPDOs, each with the controlword, and a frame monitor."""

    def __init__(self, synchronous: bool) -> None:
        self.bus: FakeBus
        self.network: CanopenNetwork
        self.bus, self.network = make_network()
        self.servo = ProfileServo(self.bus)
        self.drive = ServoDrive(self.network, 1, "axis1")
        self.plan = all_modes_plan(1, synchronous_command=synchronous)
        self.controlwords: list[int] = []
        self.network.link.tap(self._watch)
        self.drive.connect(self.soon())
        self.drive.configure(DriveSettings(PERIOD, plan=self.plan, speed_max_rad_s=200.0))
        assert self.controlwords == [], "a controlword went out before anybody asked for one"
        self.drive.enable(self.soon())
        self.controlwords.clear()

    def soon(self, seconds: float = 1.0) -> Instant:
        return self.network.deadline_after(Duration(int(seconds * NS_PER_S)))

    def words(self) -> list[int]:
        """Controlwords sent since the last call, each change once."""
        words = self.controlwords
        changes = [word for place, word in enumerate(words) if place == 0 or words[place - 1] != word]
        words.clear()
        return changes

    def _watch(
        self, direction: Direction, can_id: int, data: bytes, _ext: bool, _remote: bool, _at: Instant
    ) -> None:
        if direction != "tx":
            return
        for pdo in self.plan.rpdos:
            place = pdo.place_of(Object.CONTROLWORD)
            if can_id == pdo.cob_id and place is not None:
                self.controlwords.append(pdo.codec().unpack(data)[place])
        if can_id == 0x601 and data[0] >> 5 == 1 and unpack_from("<H", data, 1)[0] == Object.CONTROLWORD:
            self.controlwords.append(unpack_from("<H", data, 4)[0])


@pytest.fixture(params=[False, True], ids=["on_arrival", "on_sync"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    made = Rig(request.param)
    yield made
    made.bus.shutdown()


def test_a_change_of_mode_sends_no_controlword_but_the_one_in_force(rig: Rig) -> None:
    for mode in (*SWITCHABLE, *reversed(SWITCHABLE)):
        rig.drive.change_mode(mode, rig.soon())
        assert rig.servo.values[0x6061, 0] == mode
    assert set(rig.words()) <= {ENABLED}
    assert set(rig.servo.control_history[rig.servo.control_history.index(ENABLED) :]) == {ENABLED}
    assert rig.servo.state is State.OPERATION_ENABLED


def test_the_bits_of_a_mode_are_cleared_before_the_next(rig: Rig) -> None:
    rig.drive.move_to(TURN, rig.soon(), relative=True)
    assert rig.servo.control_history[-1] & 0x60 == 0x60, (
        "relative and at once stay until something clears them"
    )
    rig.drive.change_mode(Mode.HOMING, rig.soon())
    assert rig.servo.modes[-1] == (Mode.HOMING, ENABLED)
    assert rig.servo.moves == [(65536, True, True)]


def test_a_set_point_of_long_ago_is_not_taken_up(rig: Rig) -> None:
    servo, drive = rig.servo, rig.drive
    servo.values[0x6064, 0] = 4711
    servo.values[0x607A, 0] = -9999
    servo.values[0x60FF, 0] = -9999
    servo.values[0x6071, 0] = 99
    drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_POSITION, rig.soon())
    assert servo.values[0x607A, 0] == 4711
    servo.values[0x606C, 0] = 250
    drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, rig.soon())
    assert servo.values[0x60FF, 0] == 250
    drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_TORQUE, rig.soon())
    assert servo.values[0x6071, 0] == 0


def test_a_mode_that_is_not_taken_up_tells_what_was_seen(rig: Rig) -> None:
    rig.servo.mode_ns = 10 * NS_PER_S
    with pytest.raises(SettingRefused, match=r"stays in mode 10; mode 9 was asked for; statusword 0227h"):
        rig.drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, rig.soon(0.1))


def test_a_mode_that_the_drive_has_not_is_refused_before_anything_is_sent(rig: Rig) -> None:
    rig.servo.values[0x6502, 0] = 1 << 9
    with pytest.raises(PeerFault, match=r"no homing mode; 6502h is 00000200h"):
        rig.drive.change_mode(Mode.HOMING, rig.soon())
    assert rig.words() == []
    assert rig.servo.values[0x6060, 0] == Mode.CYCLIC_SYNCHRONOUS_TORQUE


def test_move_to_shakes_hands_and_waits_for_the_target(rig: Rig) -> None:
    profile = MoveProfile(speed_rad_s=TURN, acceleration_rad_s2=10 * TURN, deceleration_rad_s2=20 * TURN)
    started = rig.network.clock.now()
    rig.drive.move_to(-2.5 * TURN, rig.soon(), profile)
    assert rig.network.clock.now() - started >= rig.servo.move_ns
    assert rig.servo.moves == [(round(-2.5 * 65536), False, True)]
    assert rig.servo.values[0x6081, 0] == 60_000
    assert (rig.servo.values[0x6083, 0], rig.servo.values[0x6084, 0]) == (600_000, 1_200_000)
    assert [word for word in rig.words() if word != ENABLED] == [0x3F, 0x2F]
    rig.drive.move_to(0.0, rig.soon())
    assert len(rig.servo.moves) == 2


def test_queued_moves_wait_for_room(rig: Rig) -> None:
    motion = rig.drive.motion
    assert motion is not None
    motion.start_move(TURN, rig.soon(), at_once=False)
    rig.servo.ack_ns = 10 * NS_PER_MS
    motion.start_move(2 * TURN, rig.soon(), at_once=False)
    motion.await_target(rig.soon())
    assert rig.servo.moves == [(65536, False, False), (131072, False, False)]


def test_a_set_point_that_is_not_acknowledged_tells_what_was_seen(rig: Rig) -> None:
    rig.servo.deaf_to_set_points = True
    with pytest.raises(DriveInFault, match=r"did not acknowledge its set-point in time; statusword 0227h"):
        rig.drive.move_to(TURN, rig.soon(0.2))


def test_a_fault_on_the_way_is_told_and_not_reset(rig: Rig) -> None:
    rig.bus.call_after(8 * NS_PER_MS, lambda: rig.servo.fault(0x8611))
    rig.servo.move_ns = NS_PER_S
    with pytest.raises(DriveInFault, match=r"is in fault; .*8611h \(following error\)"):
        rig.drive.move_to(TURN, rig.soon())
    assert not any(word & 0x80 for word in rig.words())
    assert rig.servo.state is State.FAULT


def test_a_move_needs_an_enabled_drive(rig: Rig) -> None:
    rig.drive.disable(rig.soon())
    with pytest.raises(DriveInFault, match="is in 'switch on disabled'"):
        rig.drive.move_to(TURN, rig.soon())
    assert rig.servo.moves == []


def test_a_position_beyond_the_range_is_no_move(rig: Rig) -> None:
    with pytest.raises(ValueError, match="607Ah"):
        rig.drive.move_to(1e6, rig.soon())
    assert rig.servo.moves == []
    rig.drive.halt(rig.soon())
    assert rig.servo.values[0x607A, 0] == 0, "nor does it go out with the next controlword"


def test_a_target_that_the_drive_refuses_is_never_repeated(rig: Rig) -> None:
    rig.drive.change_mode(Mode.PROFILE_POSITION, rig.soon())
    rig.servo.refuse[0x607A, 0] = 0x06090031
    with pytest.raises(TransferAborted, match="06090031h"):
        rig.drive.move_to(TURN, rig.soon())
    rig.drive.halt(rig.soon())
    assert rig.servo.values[0x607A, 0] == 0
    assert rig.servo.moves == []


def test_run_at_and_apply_torque_wait_until_they_are_reached(rig: Rig) -> None:
    rig.drive.run_at(TURN, rig.soon(), MoveProfile(acceleration_rad_s2=TURN))
    assert rig.servo.values[0x606C, 0] == 60_000
    rig.drive.run_at(-TURN, rig.soon())
    assert rig.servo.values[0x606C, 0] == -60_000
    rig.drive.apply_torque(0.5, rig.soon(), MoveProfile(torque_slope_nm_s=4.0))
    assert rig.servo.values[0x6077, 0] == 250
    assert rig.servo.values[0x6087, 0] == 2000
    assert set(rig.words()) <= {ENABLED}


def test_a_profile_that_the_drive_does_not_take_is_no_move(rig: Rig) -> None:
    rig.servo.stubborn.add((0x6081, 0))
    with pytest.raises(SettingRefused, match=r"cannot move as asked; profile velocity.*holds 0 in 6081h"):
        rig.drive.move_to(TURN, rig.soon(), MoveProfile(speed_rad_s=TURN))
    assert rig.servo.moves == []


def test_homing_ends_at_home(rig: Rig) -> None:
    how = HomingSetup(
        switch_speed_rad_s=TURN, zero_speed_rad_s=TURN / 10, acceleration_rad_s2=TURN, offset_rad=TURN
    )
    rig.drive.home(33, rig.soon(), how)
    values = rig.servo.values
    assert values[0x6098, 0] == 33
    assert (values[0x6099, 1], values[0x6099, 2], values[0x609A, 0]) == (60_000, 6000, 60_000)
    assert values[0x6064, 0] == 65536
    assert rig.words()[-2:] == [0x1F, ENABLED]


def test_homing_that_fails_is_told(rig: Rig) -> None:
    rig.servo.home_fails = True
    with pytest.raises(DriveInFault, match="failed to find its home; statusword 2227h"):
        rig.drive.home(1, rig.soon())


def test_halt_and_resume_touch_one_bit(rig: Rig) -> None:
    rig.drive.run_at(TURN, rig.soon())
    rig.words()
    rig.drive.halt(rig.soon())
    rig.drive.resume()
    assert rig.words() == [0x10F, ENABLED]


def test_a_cyclic_mode_knows_no_halt(rig: Rig) -> None:
    rig.drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, rig.soon())
    rig.words()
    with pytest.raises(ValueError, match=r"no halt in cyclic synchronous velocity.*quick_stop"):
        rig.drive.halt(rig.soon())
    assert rig.words() == []


def test_cyclic_set_points_go_out_in_one_frame_each(rig: Rig) -> None:
    rig.drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, rig.soon())
    sent = len(rig.bus.sent)
    rig.drive.write(SpeedCommand(1, TURN, NOW, rig.soon()))
    assert rig.servo.values[0x60FF, 0] == 60_000
    rig.drive.write(SpeedCommand(1, 1000.0, NOW, rig.soon()))
    assert rig.servo.values[0x60FF, 0] == int(200.0 / TURN * 60_000)
    rig.drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_POSITION, rig.soon())
    before = len(rig.bus.sent)
    sent_position = rig.drive.write(PositionCommand(1, -TURN, NOW, rig.soon()))
    assert sent_position is not None
    assert rig.servo.values[0x607A, 0] == sent_position.raw == -65536
    # As the position in a reading runs on where 0x6064 wraps, so does the set-point.
    rig.drive.write(PositionCommand(1, TURN * 2**15, NOW, rig.soon()))
    assert rig.servo.values[0x607A, 0] == -(2**31)
    assert len(rig.bus.sent) == before + 2
    assert before > sent + 2
    late = Instant(rig.network.clock.now() - 1)
    assert rig.drive.write(PositionCommand(1, 0.0, NOW, late)) is None
    assert rig.drive.write(SpeedCommand(1, 0.0, NOW, late)) is None
    assert set(rig.words()) <= {ENABLED}


def test_no_frame_of_a_stop_carries_the_speed_of_before(rig: Rig) -> None:
    """The controlword that stops it goes out in the frame of the set-point."""
    rig.drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, rig.soon())
    assert rig.drive.write(SpeedCommand(1, TURN, NOW, rig.soon())) is not None
    assert rig.servo.values[0x60FF, 0] == 60_000
    rig.drive.disable(rig.soon())
    assert rig.servo.values[0x60FF, 0] == 0


@pytest.mark.parametrize(("velocity", "torque"), [(-1, 1), (1, -1), (-1, -1)])
def test_a_drive_that_counts_the_other_way_is_turned_in_every_mode(velocity: int, torque: int) -> None:
    bus, network = make_network()
    servo, drive = ProfileServo(bus), ServoDrive(network, 1)
    turned = ScaleOverride(velocity_sign=velocity, torque_sign=torque)
    settings = DriveSettings(PERIOD, torque_max_nm=1.0, speed_max_rad_s=200.0, scale=turned)
    limit = int(200.0 / TURN * 60_000)

    def soon() -> Instant:
        return network.deadline_after(Duration(NS_PER_S))

    drive.connect(soon())
    drive.configure(replace(settings, plan=all_modes_plan(1)))
    drive.enable(soon())
    drive.run_at(TURN, soon())
    assert servo.values[0x60FF, 0] == velocity * 60_000
    drive.apply_torque(0.5, soon(), MoveProfile(torque_slope_nm_s=0.5))
    assert servo.values[0x6071, 0] == torque * 250
    assert servo.values[0x6087, 0] == 250, "a slope has no sign"
    drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, soon())
    drive.write(SpeedCommand(1, TURN, NOW, soon()))
    assert servo.values[0x60FF, 0] == velocity * 60_000
    drive.write(SpeedCommand(1, 1000.0, NOW, soon()))
    assert servo.values[0x60FF, 0] == velocity * limit
    drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_TORQUE, soon())
    for torque_nm, raw in ((0.25, 125), (-7.0, -500)):
        drive.write(Command(1, torque_nm, soon(), soon()))
        assert servo.values[0x6071, 0] == torque * raw
    assert servo.values[0x6072, 0] == 500, "nor has a limit"
    bus.shutdown()


def test_a_drive_can_begin_in_another_mode() -> None:
    bus, network = make_network()
    servo = ProfileServo(bus)
    drive = ServoDrive(network, 1)
    deadline = network.deadline_after(Duration(NS_PER_S))
    drive.connect(deadline)
    drive.configure(DriveSettings(PERIOD, mode=Mode.CYCLIC_SYNCHRONOUS_VELOCITY))
    drive.enable(network.deadline_after(Duration(NS_PER_S)))
    assert servo.values[0x6061, 0] == Mode.CYCLIC_SYNCHRONOUS_VELOCITY
    assert servo.values[0x1600, 2] == 0x60FF0020
    drive.write(SpeedCommand(1, TURN, NOW, network.deadline_after(PERIOD)))
    assert bus.sent_to(0x201)[-1] == bytes.fromhex("0f0060ea0000")
    bus.shutdown()
