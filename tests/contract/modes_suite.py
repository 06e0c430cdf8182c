"""What the drive client promises in the nine modes, with a monitor that sees every frame on the wire."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, combinations, pairwise, permutations
from struct import unpack_from

import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.canopen.write_list import ListedWrite, WriteList
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.motion import HomingSetup, MoveProfile
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.pdo_planner import all_modes_plan
from servobench.drivers.cia402.pdo_plans import TARGETS
from servobench.drivers.cia402.profile import FOLLOW_BITS, Mode, State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import DriveInFault
from servobench.drivers.exchange import PositionCommand, SpeedCommand
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.drive.load_object import SIMULATED_DRIVE
from servobench.virtual_bus.drive.servo import SimulatedServo

TURN = math.tau
COUNT = TURN / 65536
NODE = 1
PERIOD = Duration(NS_PER_MS)
PROFILE = MoveProfile(speed_rad_s=10 * TURN, acceleration_rad_s2=200 * TURN, deceleration_rad_s2=200 * TURN)
HOW = HomingSetup(switch_speed_rad_s=5 * TURN, zero_speed_rad_s=2 * TURN, acceleration_rad_s2=200 * TURN)
RECORD = Object.INTERPOLATION_DATA_RECORD
SDO_REQUEST = 0x600 + NODE
WRITES = RIG | WriteList(
    "the suite",
    (
        ListedWrite(
            range(0x2110, 0x2111), tuple(range(1, 9)), "Inputs", "what happens", "tests", SIMULATED_DRIVE
        ),
        ListedWrite(range(0x604C, 0x604D), (1,), "Dimension factor", "another unit", "tests"),
    ),
)
"""2110h: the switches, the index and the supply of a simulated drive."""
ENABLED = 0x0F
FAULT_RESET = 0x80
MODES = (
    Mode.PROFILE_POSITION,
    Mode.VELOCITY,
    Mode.PROFILE_VELOCITY,
    Mode.PROFILE_TORQUE,
    Mode.HOMING,
    Mode.INTERPOLATED_POSITION,
    Mode.CYCLIC_SYNCHRONOUS_POSITION,
    Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    Mode.CYCLIC_SYNCHRONOUS_TORQUE,
)
MARK = 0x7FF
"""An identifier that nobody uses (CiA 301 keeps it free): what was sent before it has been heard with it."""
HEARD_WITHIN_S = 10.0
"""For a monitor that the machine keeps from running."""


@dataclass
class ModesRig:
    """A drive on a bus, its client, and what a third participant has heard."""

    network: CanopenNetwork
    device: SimulatedServo
    drive: ServoDrive
    tell_device: Callable[[Callable[[SimulatedServo], None]], None]
    """Have something done to the device by whoever serves it."""
    synchronous: bool = False
    heard: list[tuple[int, bytes]] = field(default_factory=list)
    """Every data frame: identifier, data."""
    in_force: int | None = None
    """The last controlword heard."""

    @cached_property
    def plan(self) -> PdoPlan:
        """0x6040 stands in four RPDOs."""
        plan = all_modes_plan(NODE, synchronous_command=self.synchronous)
        entries = (plan.rpdos[0].entries[0], TARGETS[Mode.VELOCITY], TARGETS[Mode.INTERPOLATED_POSITION])
        further = replace(plan.rpdos[0], number=4, cob_id=0x500 + NODE, entries=entries)
        return replace(plan, rpdos=(*plan.rpdos, further))

    def start(self) -> None:
        """Connect and enable, as a bench does; the words up to there are forgotten."""
        settings = DriveSettings(
            PERIOD,
            plan=self.plan,
            torque_max_nm=4.0,
            speed_max_rad_s=250.0,
            quick_stop_deceleration_rad_s2=1500.0,
            drive_heartbeat_timeout_ms=5000,
            host_heartbeat_timeout_ms=5000,
        )
        self.drive.connect(self.soon(5.0))
        self.drive.configure(settings)
        assert self.words() == [], "a controlword went out before anybody asked for one"
        self.drive.enable(self.soon(5.0))
        assert self.words() == [0x06, 0x07, ENABLED]

    def soon(self, seconds: float = 2.0) -> Instant:
        return self.network.deadline_after(Duration(int(seconds * NS_PER_S)))

    def cycles(
        self, count: int, command: type[SpeedCommand | PositionCommand], value: float, start: float = 0.0
    ) -> None:
        """Set-points of 10 ms from ``start`` straight to ``value``."""
        for cycle in range(1, count + 1):
            due = self.network.deadline_after(Duration(10 * NS_PER_MS))
            self.network.send_sync()
            self.drive.write(command(cycle, start + (value - start) * cycle / count, due, self.soon()))
            self.network.pump(due)

    def wait(self, seconds: float) -> None:
        self.network.pump(self.soon(seconds))

    def words(self) -> list[int]:
        """Controlwords on the wire since the last call, in RPDOs and by SDO: each that was another than
        the one before."""
        self._let_all_be_heard()
        words: list[int] = []
        for can_id, data in self.heard:
            word = self._controlword(can_id, data)
            if word is not None and word != self.in_force:
                self.in_force = word
                words.append(word)
        self.heard.clear()
        return words

    def _let_all_be_heard(self) -> None:
        """Until the monitor has heard a frame that the client hands over behind all its others."""
        given_up = self.soon(HEARD_WITHIN_S)
        self.network.send_message(MARK, b"")
        while (MARK, b"") not in self.heard:
            assert self.network.clock.now() < given_up, "the monitor hears nothing"
            self.wait(0.001)

    def _controlword(self, can_id: int, data: bytes) -> int | None:
        for pdo in self.plan.rpdos:
            place = pdo.place_of(Object.CONTROLWORD)
            if can_id == pdo.cob_id and place is not None:
                return int(pdo.codec().unpack(data)[place])
        writes = can_id == SDO_REQUEST and data[0] >> 5 == 1
        if writes and unpack_from("<H", data, 1)[0] == Object.CONTROLWORD:
            return int(unpack_from("<H", data, 4)[0])
        return None

    @property
    def position_rad(self) -> float:
        return int(self.drive.objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")) * COUNT

    @property
    def velocity_rad_s(self) -> float:
        raw = int(self.drive.objects.read(Object.VELOCITY_ACTUAL_VALUE, 0, "i"))
        return raw * TURN / 60_000

    def shows(self, state: State) -> bool:
        """By the statusword, now."""
        return self.drive.control.read_state() is state


class ModesSuite:
    """Subclasses give the fixture ``rig``, enabled by ``rig.start``."""

    def test_a_profile_move_ends_where_it_was_sent(self, rig: ModesRig) -> None:
        rig.drive.move_to(3 * TURN, rig.soon(5.0), PROFILE)
        assert rig.position_rad == pytest.approx(3 * TURN, abs=0.02)
        assert rig.words() == [0x3F, 0x2F], "new set-point at once, and bit 4 taken back"
        rig.drive.move_to(-1 * TURN, rig.soon(5.0), relative=True)
        assert rig.position_rad == pytest.approx(2 * TURN, abs=0.02)
        assert rig.words() == [0x7F, 0x6F]

    def test_queued_moves_are_carried_out_one_after_the_other(self, rig: ModesRig) -> None:
        motion = rig.drive.motion
        assert motion is not None
        motion.start_move(2 * TURN, rig.soon(), PROFILE, at_once=False)
        motion.start_move(1 * TURN, rig.soon(), at_once=False)
        motion.start_move(-1 * TURN, rig.soon(5.0), at_once=False)
        motion.await_target(rig.soon(5.0))
        assert rig.position_rad == pytest.approx(-1 * TURN, abs=0.02)
        assert set(rig.words()) == {0x1F, ENABLED}

    def test_speed_halt_and_resume(self, rig: ModesRig) -> None:
        rig.drive.run_at(50.0, rig.soon(5.0), PROFILE)
        assert rig.velocity_rad_s == pytest.approx(50.0, rel=0.1)
        assert rig.words() == [], "a speed needs no controlword"
        rig.drive.halt(rig.soon(5.0))
        assert abs(rig.velocity_rad_s) < 1.0
        rig.drive.resume()
        rig.drive.run_at(-20.0, rig.soon(5.0))
        assert rig.velocity_rad_s == pytest.approx(-20.0, rel=0.1)
        assert rig.words() == [0x10F, ENABLED]

    def test_torque_is_reached(self, rig: ModesRig) -> None:
        rig.drive.apply_torque(0.1, rig.soon(5.0), MoveProfile(torque_slope_nm_s=20.0))
        assert rig.drive.objects.read(Object.TORQUE_DEMAND, 0, "h") == 50
        rig.drive.apply_torque(0.0, rig.soon(5.0))
        assert rig.words() == []

    def test_homing_finds_the_index_pulse(self, rig: ModesRig) -> None:
        rig.drive.objects.write(0x2110, 7, "I", 16384)
        rig.drive.home(34, rig.soon(5.0), HOW)
        assert rig.position_rad == pytest.approx(2**2 / 400 * TURN, abs=0.05), "it stops behind its home"
        assert rig.words() == [0x1F, ENABLED]
        rig.drive.home(35, rig.soon(5.0), HomingSetup(offset_rad=0.25 * TURN))
        assert rig.position_rad == pytest.approx(-0.25 * TURN, abs=0.02)

    def test_a_homing_that_fails_tells_why(self, rig: ModesRig) -> None:
        rig.drive.objects.write(0x2110, 4, "i", 20_000)
        rig.drive.objects.write(0x2110, 2, "B", 0b10)
        with pytest.raises(DriveInFault, match=r"failed to find its home; statusword [23A]"):
            rig.drive.home(20, rig.soon(5.0), HOW)
        assert rig.shows(State.OPERATION_ENABLED)

    def test_the_cyclic_modes_follow(self, rig: ModesRig) -> None:
        drive, network, cycles = rig.drive, rig.network, rig.cycles
        drive.objects.write(Object.INTERPOLATION_TIME_PERIOD, 1, "B", 10)
        drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_POSITION, rig.soon())
        cycles(40, PositionCommand, 1.0)
        network.send_sync()
        rig.wait(0.1)
        assert rig.position_rad == pytest.approx(1.0, abs=0.02)
        drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, rig.soon())
        cycles(40, SpeedCommand, 30.0)
        network.send_sync()
        rig.wait(0.1)
        assert rig.velocity_rad_s == pytest.approx(30.0, rel=0.05)
        cycles(20, SpeedCommand, 0.0)
        drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_TORQUE, rig.soon())
        assert rig.words() == [], "every RPDO repeats the word in force"
        assert rig.shows(State.OPERATION_ENABLED)

    def test_interpolated_position_follows_once_its_bit_is_set(self, rig: ModesRig) -> None:
        drive = rig.drive
        drive.objects.write(Object.INTERPOLATION_TIME_PERIOD, 1, "B", 10)
        drive.move_to(0.5, rig.soon(5.0), PROFILE)
        rig.words()
        drive.objects.write(RECORD, 1, "i", 40_000)
        drive.change_mode(Mode.INTERPOLATED_POSITION, rig.soon())
        assert rig.words() == [ENABLED, 0x1F]
        rig.network.send_sync()
        rig.wait(0.05)
        assert rig.position_rad == pytest.approx(0.5, abs=0.02), "it begins where the shaft is"
        rig.cycles(40, PositionCommand, 1.5, start=0.5)
        rig.network.send_sync()
        rig.wait(0.1)
        assert rig.position_rad == pytest.approx(1.5, abs=0.02)
        assert rig.words() == [], "every RPDO repeats the word in force"
        drive.halt(rig.soon())
        drive.resume()
        assert rig.words() == [0x11F, 0x1F]

    def test_velocity_mode_follows_in_whole_units_of_its_own(self, rig: ModesRig) -> None:
        drive = rig.drive
        drive.objects.write(Object.VL_VELOCITY_ACCELERATION, 1, "I", 30_000)
        drive.change_mode(Mode.VELOCITY, rig.soon())
        assert rig.words() == [0x7F]
        rpm = TURN / 60.0
        rig.cycles(40, SpeedCommand, 300.4 * rpm)
        rig.network.send_sync()
        rig.wait(0.2)
        assert drive.objects.read(Object.VL_TARGET_VELOCITY, 0, "h") == 300
        assert rig.velocity_rad_s == pytest.approx(300 * rpm, rel=0.05)
        assert rig.words() == [], "every RPDO repeats the word in force"
        sent = drive.write(SpeedCommand(1, 1e4, rig.soon(), rig.soon()))
        assert sent is not None
        assert sent.raw == int(250.0 / rpm), "the limit of speed, in whole r/min"
        drive.quick_stop(rig.soon())
        drive.objects.write(Object.VL_DIMENSION_FACTOR, 1, "i", 60)
        drive.enable(rig.soon())
        assert rig.words()[-2:] == [ENABLED, 0x7F]
        rig.cycles(10, SpeedCommand, 2.6 * TURN)
        rig.network.send_sync()
        rig.wait(0.01)
        assert drive.objects.read(Object.VL_TARGET_VELOCITY, 0, "h") == 3, "604Ch makes them turns a second"

    def test_a_change_of_mode_sends_the_controlword_in_force_and_the_bits_of_the_mode(
        self, rig: ModesRig
    ) -> None:
        """Each into each other one once, with SYNCs in between that let waiting RPDOs act."""
        words: list[int] = []
        walk = (*chain.from_iterable(combinations(MODES, 2)), MODES[0])
        assert sorted(pairwise(walk)) == sorted(permutations(MODES, 2))
        for mode in walk:
            words += [ENABLED] if words[-1:] not in ([], [ENABLED]) else []
            words += [ENABLED | FOLLOW_BITS[mode]] if mode in FOLLOW_BITS else []
            rig.drive.change_mode(mode, rig.soon())
            rig.network.send_sync()
            assert rig.drive.objects.read(Object.MODES_OF_OPERATION_DISPLAY, 0, "b") == mode
        rig.wait(0.02)
        assert rig.words() == words
        assert rig.shows(State.OPERATION_ENABLED)
        assert abs(rig.velocity_rad_s) < 1.0
        assert rig.position_rad == pytest.approx(0.0, abs=0.01)

    def test_a_mode_begins_where_the_shaft_is(self, rig: ModesRig) -> None:
        """The targets of the moves before are another position and another speed."""
        rig.drive.move_to(0.5 * TURN, rig.soon(5.0), PROFILE)
        rig.drive.run_at(10.0, rig.soon(5.0))
        rig.wait(0.1)
        rig.drive.run_at(0.0, rig.soon(5.0))
        rig.drive.apply_torque(0.0, rig.soon(5.0))
        standing = rig.position_rad
        assert standing > 0.55 * TURN
        for mode in (Mode.CYCLIC_SYNCHRONOUS_POSITION, Mode.CYCLIC_SYNCHRONOUS_VELOCITY):
            rig.drive.change_mode(mode, rig.soon())
            rig.network.send_sync()
            rig.wait(0.05)
            assert rig.position_rad == pytest.approx(standing, abs=0.05)

    def test_bits_of_one_mode_are_gone_before_the_next(self, rig: ModesRig) -> None:
        rig.drive.move_to(0.5 * TURN, rig.soon(5.0), PROFILE, relative=True)
        rig.drive.change_mode(Mode.HOMING, rig.soon())
        assert rig.words() == [0x7F, 0x6F, ENABLED]
        assert rig.drive.objects.read(Object.STATUSWORD, 0, "H") & 0x1000 == 0, "no homing was started"

    def test_a_fault_is_told_and_reset_on_request_only(self, rig: ModesRig) -> None:
        rig.drive.change_mode(Mode.PROFILE_VELOCITY, rig.soon())
        rig.words()
        rig.tell_device(lambda device: device.drive.fail(0x4310, ErrorRegister.TEMPERATURE))
        with pytest.raises(
            DriveInFault, match=r"is in fault; statusword .*4310h \(excess temperature of the drive\)"
        ):
            rig.drive.run_at(20.0, rig.soon())
        with pytest.raises(DriveInFault):
            rig.drive.move_to(1.0, rig.soon())
        with pytest.raises(DriveInFault):
            rig.drive.enable(rig.soon())
        assert not any(word & FAULT_RESET for word in rig.words())
        assert rig.shows(State.FAULT)
        rig.drive.reset_fault(rig.soon())
        assert sum(word & FAULT_RESET != 0 for word in rig.words()) == 1
        rig.drive.enable(rig.soon())
        assert rig.shows(State.OPERATION_ENABLED)

    def test_a_state_that_is_not_reached_ends_at_its_deadline_with_what_was_seen(self, rig: ModesRig) -> None:
        rig.drive.disable(rig.soon())
        rig.drive.objects.write(0x2110, 8, "B", 1)
        started = rig.network.clock.now()
        with pytest.raises(
            DriveInFault, match=r"did not reach 'operation enabled' in time; statusword 0[24][46]0h"
        ):
            rig.drive.enable(rig.soon(0.3))
        took = rig.network.clock.now() - started
        assert 0.3 * NS_PER_S <= took < 1.5 * NS_PER_S
        assert set(rig.words()) <= {0x00, 0x06, 0x07, ENABLED}
        rig.drive.objects.write(0x2110, 8, "B", 0)
        rig.drive.enable(rig.soon())
        assert rig.shows(State.OPERATION_ENABLED)

    def test_a_move_against_a_limit_switch_ends_at_the_deadline(self, rig: ModesRig) -> None:
        rig.drive.objects.write(0x2110, 4, "i", 65536)
        rig.drive.objects.write(0x2110, 2, "B", 0b10)
        with pytest.raises(DriveInFault, match=r"did not reach its target in time; statusword 0A37h"):
            rig.drive.move_to(5 * TURN, rig.soon(1.0), PROFILE)
        assert TURN < rig.position_rad < 1.5 * TURN
        rig.drive.move_to(0.0, rig.soon(5.0))
        assert rig.position_rad == pytest.approx(0.0, abs=0.02)

    def test_it_is_left_at_rest_and_disabled(self, rig: ModesRig) -> None:
        rig.drive.run_at(30.0, rig.soon(5.0), PROFILE)
        released = rig.drive.release()
        assert released.at_rest, released.evidence
        assert released.state is State.SWITCH_ON_DISABLED
        words = rig.words()
        assert words in ([0x02], [0x02, 0x00]), "a quick stop disables by itself; 0 where it had not yet"
