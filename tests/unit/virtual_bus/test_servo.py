"""The simulated drive over its frames: enabling, torque, ways to rest, limits, loss of the master."""

import itertools
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    CONTROLWORDS,
    TRANSITION_OF,
    AbortConnectionOption,
    DriveCommand,
    Mode,
    State,
    Status,
)
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.drive.load_object import LOAD_MACHINE
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.draws import examples_of
from tests.motors import LING
from tests.unit.virtual_bus.servo_bench import ENABLE, SYNC, ServoBench

MASTER = 127
NO_BRAKE = DriveParameters(brake_torque_nm=0.0)
BOOT_MS = DriveParameters().boot_after_reset_ms


def supervise(bench: ServoBench, milliseconds: int = 100) -> None:  # and hears the first heartbeat
    assert bench.write(0x1016, "I", MASTER << 16 | milliseconds, 1) is None
    bench.receive(Frame(0x700 + MASTER, b"\x05"))


def emergencies(bench: ServoBench) -> list[int]:
    return [int.from_bytes(frame.data[:2], "little") for frame in bench.sent if frame.can_id == 0x81]


def test_power_on_says_boot_up_and_nothing_else() -> None:
    servo = SimulatedServo(5, LING)
    assert list(servo.start(Instant(0))) == [Frame(0x705, b"\x00")]
    assert servo.drive.power.state is State.SWITCH_ON_DISABLED


def test_enable_through_the_states() -> None:
    bench = ServoBench()
    seen = [bench.state]
    for command in ENABLE:
        bench.command(command)
        seen.append(bench.state)
    assert seen == [State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON, State.OPERATION_ENABLED]
    assert bench.statusword & Status.FOLLOWS_COMMAND
    assert bench.statusword & Status.REMOTE


def test_a_sync_brings_both_pdos_with_the_sampled_values() -> None:
    bench = ServoBench()
    bench.turn()
    frames = bench.sync()
    assert [frame.can_id for frame in frames] == [0x181, 0x281]
    status, velocity, torque = struct.unpack("<Hih", frames[0].data)
    position, _stamp = struct.unpack("<iI", frames[1].data)
    firmware = bench.servo.drive.firmware
    assert status == bench.statusword
    assert velocity * 1e-3 * RAD_S_PER_RPM == pytest.approx(bench.speed_rad_s, rel=0.03)
    assert torque == pytest.approx(800, abs=2)
    turned = firmware.inner.turns + firmware.inner.angle_rad / math.tau
    assert position == math.floor(turned * 65_536)


def test_clock_offsets_differ_by_seed_and_node_and_repeat() -> None:
    def stamp(node: int, seed: int) -> int:
        servo = SimulatedServo(node, LING, seed=seed)
        servo.start(Instant(0))
        return int(servo.dictionary.variable(0x1013).read())

    assert stamp(1, 7) == stamp(1, 7)
    assert len({stamp(node, seed) for node, seed in itertools.product((1, 2), (7, 8))}) == 4


def test_target_torque_accelerates_as_the_inertia_says() -> None:
    bench = ServoBench(NO_BRAKE)
    bench.turn(milliseconds=20, torque_raw=500)
    before = bench.speed_rad_s
    bench.wait_ms(20)
    gained = bench.speed_rad_s - before
    drag = LING.viscous_friction_nm_s * (before + gained / 2)
    assert gained == pytest.approx((1.0 - drag) / LING.inertia_kg_m2 * 0.020, rel=0.005)


def test_no_torque_before_operation_enabled() -> None:
    bench = ServoBench(NO_BRAKE)
    for command in ENABLE[:2]:
        bench.command(command, torque_raw=1000)
        bench.wait_ms(50)
        assert bench.speed_rad_s == 0.0


def test_quick_stop_comes_down_its_ramp_to_rest_and_switches_off() -> None:
    bench = ServoBench()
    assert bench.write(Object.QUICK_STOP_DECELERATION, "I", round(1000.0 / RAD_S_PER_RPM)) is None
    bench.turn()
    start = bench.speed_rad_s
    bench.rpdo(CONTROLWORDS[DriveCommand.QUICK_STOP], 800)
    assert bench.state is State.QUICK_STOP
    assert not bench.statusword & Status.FOLLOWS_COMMAND
    bench.wait_ms(start / 1000.0 * 500)
    assert bench.speed_rad_s == pytest.approx(start / 2, rel=0.1)
    bench.wait_until(lambda: bench.state is State.SWITCH_ON_DISABLED, 200)
    assert abs(bench.speed_rad_s) < 1.0
    bench.wait_ms(100)
    assert bench.speed_rad_s == 0.0, "the brake holds"


def test_quick_stop_that_stays_says_when_it_rests_and_holds_against_the_load() -> None:
    bench = ServoBench()
    assert bench.write(Object.QUICK_STOP_OPTION, "h", 6) is None
    bench.turn()
    assert bench.write(LOAD_MACHINE, "i", 600, 1) is None
    bench.command(DriveCommand.QUICK_STOP)
    bench.wait_until(lambda: bool(bench.statusword & Status.TARGET_REACHED), 300)
    assert bench.state is State.QUICK_STOP
    bench.wait_ms(200)
    assert abs(bench.speed_rad_s) < 0.5
    assert bench.read(Object.TORQUE_ACTUAL_VALUE, "h") == pytest.approx(300, abs=30)
    bench.command(DriveCommand.ENABLE_OPERATION)
    assert bench.shows(State.OPERATION_ENABLED)


def test_quick_stop_at_the_current_limit_uses_all_of_it() -> None:
    bench = ServoBench()
    bench.write(Object.QUICK_STOP_OPTION, "h", 3)
    bench.turn()
    shortest_ms = 1000 * bench.speed_rad_s * LING.inertia_kg_m2 / LING.torque_max_nm
    bench.command(DriveCommand.QUICK_STOP)
    assert bench.wait_until(lambda: bench.speed_rad_s < 2.0, 100) < 2 * shortest_ms
    bench.wait_until(lambda: bench.state is State.SWITCH_ON_DISABLED, 100)


def test_disable_operation_brings_the_shaft_to_rest_first() -> None:
    bench = ServoBench()
    bench.turn()
    bench.command(DriveCommand.DISABLE_OPERATION, DriveCommand.DISABLE_OPERATION)
    assert bench.state is State.OPERATION_ENABLED
    bench.wait_until(lambda: bench.state is State.SWITCHED_ON, 400)
    assert abs(bench.speed_rad_s) < 1.0


def test_disable_voltage_lets_the_shaft_coast() -> None:
    bench = ServoBench()
    bench.turn()
    start = bench.speed_rad_s
    bench.command(DriveCommand.DISABLE_VOLTAGE)
    assert bench.state is State.SWITCH_ON_DISABLED
    bench.wait_ms(100)
    rate = LING.viscous_friction_nm_s / LING.inertia_kg_m2
    assert bench.speed_rad_s == pytest.approx(start * math.exp(-0.1 * rate), rel=0.01)
    assert bench.read(Object.CURRENT_ACTUAL_VALUE, "h") == 0


@pytest.mark.parametrize(
    ("option", "passing", "final", "code"),
    [
        (AbortConnectionOption.QUICK_STOP, State.QUICK_STOP, State.SWITCH_ON_DISABLED, 0),
        (AbortConnectionOption.FAULT_SIGNAL, State.FAULT_REACTION, State.FAULT, 0x8130),
        (AbortConnectionOption.DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED, State.SWITCH_ON_DISABLED, 0),
        (AbortConnectionOption.NO_ACTION, State.OPERATION_ENABLED, State.OPERATION_ENABLED, 0),
    ],
)
def test_a_silent_master_is_answered_by_6007(
    option: AbortConnectionOption, passing: State, final: State, code: int
) -> None:
    bench = ServoBench()
    assert bench.write(Object.ABORT_CONNECTION_OPTION, "h", option) is None
    supervise(bench, 100)
    bench.turn(milliseconds=60)
    assert bench.state is State.OPERATION_ENABLED
    bench.wait_ms(41)
    assert bench.shows(passing)
    bench.wait_ms(400)
    assert bench.shows(final)
    assert (abs(bench.speed_rad_s) < 1.0) == (passing in (State.QUICK_STOP, State.FAULT_REACTION))
    assert bench.read(Object.ERROR_CODE, "H") == code
    assert emergencies(bench)[0] == 0x8130


def test_heartbeats_in_time_keep_the_drive_running() -> None:
    bench = ServoBench()
    supervise(bench, 100)
    bench.turn(milliseconds=0, torque_raw=0)
    for _ in range(20):
        bench.wait_ms(60)
        bench.receive(Frame(0x700 + MASTER, b"\x05"))
    assert bench.state is State.OPERATION_ENABLED


@pytest.mark.parametrize("command", [2, 129, 130])
def test_nmt_stop_and_resets_bring_an_enabled_drive_to_rest_or_off(command: int) -> None:
    bench = ServoBench()
    bench.turn()
    bench.nmt(command)
    assert bench.state is not State.OPERATION_ENABLED
    bench.wait_ms(400)
    assert bench.state is State.SWITCH_ON_DISABLED
    if command != 129:  # reset node: the firmware starts anew, the shaft coasts
        assert abs(bench.speed_rad_s) < 1.0


def test_reset_node_forgets_set_points_but_not_where_the_shaft_is() -> None:
    bench = ServoBench()
    bench.write(LOAD_MACHINE, "i", 100, 1)
    bench.turn()
    position = bench.servo.dictionary.variable(Object.POSITION_ACTUAL_VALUE).read()
    assert position > 10_000
    bench.nmt(129)
    bench.wait_ms(BOOT_MS)
    assert bench.servo.dictionary.variable(Object.POSITION_ACTUAL_VALUE).read() >= position
    assert bench.read(Object.TARGET_TORQUE, "h") == 0
    assert bench.read(LOAD_MACHINE, "i", 1) == 100, "the load machine is no part of the drive"


def test_a_fault_reacts_reports_and_is_left_on_request_only() -> None:
    bench = ServoBench()
    bench.turn()
    bench.servo.drive.fail(0x4310, ErrorRegister.TEMPERATURE)
    assert bench.shows(State.FAULT_REACTION)
    bench.wait_until(lambda: bench.state is State.FAULT, 300)
    assert abs(bench.speed_rad_s) < 1.0
    assert bench.read(Object.ERROR_CODE, "H") == 0x4310
    assert bench.read(0x1001, "B") == ErrorRegister.TEMPERATURE | ErrorRegister.GENERIC
    bench.command(*ENABLE)
    assert bench.shows(State.FAULT)
    bench.command(DriveCommand.FAULT_RESET)
    assert bench.state is State.SWITCH_ON_DISABLED
    assert bench.read(Object.ERROR_CODE, "H") == 0
    assert emergencies(bench) == [0x4310, 0x0000]


def test_a_reset_clears_every_fault_and_603f_keeps_the_first() -> None:
    bench = ServoBench()
    bench.servo.drive.fail(0x3220, ErrorRegister.VOLTAGE)
    bench.servo.drive.fail(0x4210, ErrorRegister.TEMPERATURE)
    assert bench.shows(State.FAULT)
    assert bench.read(Object.ERROR_CODE, "H") == 0x3220
    bench.command(DriveCommand.FAULT_RESET)
    assert bench.shows(State.SWITCH_ON_DISABLED)
    assert bench.read(0x1001, "B") == 0


def test_torque_is_cut_at_6072_and_says_so() -> None:
    bench = ServoBench()
    assert bench.write(Object.MAX_TORQUE, "H", 200) is None
    bench.turn(milliseconds=10, torque_raw=1000)
    assert bench.read(Object.TORQUE_ACTUAL_VALUE, "h") == pytest.approx(200, abs=2)
    assert bench.statusword & Status.INTERNAL_LIMIT_ACTIVE


def test_reset_node_brings_the_limits_back_to_their_defaults() -> None:
    bench = ServoBench()
    assert bench.write(Object.MAX_TORQUE, "H", 200) is None
    bench.nmt(129)
    bench.wait_ms(BOOT_MS)
    bench.nmt(1)
    bench.turn(milliseconds=10, torque_raw=1000)
    assert bench.read(Object.TORQUE_ACTUAL_VALUE, "h") == pytest.approx(1000, abs=5)


def test_current_is_cut_at_6073() -> None:
    bench = ServoBench()
    assert bench.write(Object.MAX_CURRENT, "H", 300) is None
    bench.turn(milliseconds=10, torque_raw=1000)
    assert bench.read(Object.CURRENT_ACTUAL_VALUE, "h") == pytest.approx(300, abs=2)


def test_speed_is_held_below_6080() -> None:
    bench = ServoBench()
    assert bench.write(Object.MAX_MOTOR_SPEED, "I", 500) is None
    bench.turn(milliseconds=500, torque_raw=1000)
    assert 0.9 * 500 * RAD_S_PER_RPM < bench.speed_rad_s <= 500 * RAD_S_PER_RPM
    assert bench.statusword & Status.INTERNAL_LIMIT_ACTIVE
    bench.rpdo(CONTROLWORDS[DriveCommand.ENABLE_OPERATION], -300)
    assert not bench.statusword & Status.INTERNAL_LIMIT_ACTIVE


@pytest.mark.parametrize(
    ("index", "code", "value", "abort"),
    [
        (Object.MAX_TORQUE, "H", 3001, AbortCode.TOO_HIGH),
        (Object.MAX_CURRENT, "H", 3001, AbortCode.TOO_HIGH),
        (Object.MAX_MOTOR_SPEED, "I", 6000, AbortCode.TOO_HIGH),
        (Object.QUICK_STOP_DECELERATION, "I", 0, AbortCode.TOO_LOW),
        (Object.MODES_OF_OPERATION, "b", 5, AbortCode.INVALID_VALUE),
        (Object.MODES_OF_OPERATION, "b", 11, AbortCode.INVALID_VALUE),
        (Object.INTERPOLATION_SUB_MODE_SELECT, "h", -1, AbortCode.INVALID_VALUE),
        (Object.MODES_OF_OPERATION, "b", -1, AbortCode.INVALID_VALUE),
        (Object.HALT_OPTION, "h", 0, AbortCode.INVALID_VALUE),
        (Object.HOMING_METHOD, "b", 15, AbortCode.INVALID_VALUE),
        (Object.POLARITY, "B", 0x01, AbortCode.INVALID_VALUE),
        (Object.SI_UNIT_VELOCITY, "I", 0x00010300, AbortCode.INVALID_VALUE),
        (Object.MAX_ACCELERATION, "I", 0, AbortCode.TOO_LOW),
        (Object.QUICK_STOP_OPTION, "h", 9, AbortCode.INVALID_VALUE),
        (Object.STATUSWORD, "H", 0, AbortCode.READ_ONLY),
        (Object.TARGET_TORQUE, "i", 0, AbortCode.TOO_LONG),
        (0x5FFF, "H", 0, AbortCode.NO_OBJECT),
    ],
)
def test_what_the_drive_cannot_do_is_refused(index: int, code: str, value: int, abort: AbortCode) -> None:
    assert ServoBench().write(index, code, value) == abort


def test_only_the_modes_that_exist_are_offered() -> None:
    bench = ServoBench()
    assert bench.read(Object.SUPPORTED_DRIVE_MODES, "I") == 0b11_1110_1111, "PP VL PV PT HM, IP CSP CSV CST"
    assert bench.read(Object.MODES_OF_OPERATION_DISPLAY, "b") == Mode.CYCLIC_SYNCHRONOUS_TORQUE


def test_objects_that_scale_the_others() -> None:
    bench = ServoBench()
    assert bench.read(Object.POSITION_ENCODER_RESOLUTION, "I", 1) == 65_536
    assert bench.read(Object.POSITION_ENCODER_RESOLUTION, "I", 2) == 1
    assert bench.read(Object.SI_UNIT_VELOCITY, "I") == 0xFDB44700
    assert bench.read(Object.SI_UNIT_POSITION, "I") == 0x00B50000
    assert bench.read(Object.MOTOR_RATED_TORQUE, "I") == 2000
    assert bench.read(Object.MOTOR_RATED_CURRENT, "I") == round(1000 * LING.rated_current_a / math.sqrt(3))
    assert bench.read(0x1000, "I") & 0xFFFF == 402


def test_the_load_machine_slows_the_shaft() -> None:
    bench = ServoBench(NO_BRAKE)
    bench.turn(milliseconds=30, torque_raw=300)
    assert bench.write(LOAD_MACHINE, "i", 600, 1) is None
    assert bench.read(LOAD_MACHINE, "i", 2) == 600
    before = bench.speed_rad_s
    bench.wait_ms(20)
    drag = LING.viscous_friction_nm_s * before / LING.inertia_kg_m2 * 0.020
    assert bench.speed_rad_s == pytest.approx(before - drag, rel=0.01)


def test_position_wraps_as_integer32() -> None:
    bench = ServoBench(NO_BRAKE)
    bench.servo.drive.firmware.inner.turns = 32_767.0
    bench.servo.drive.firmware.inner.count = 32_767.0 * 65_536
    bench.turn(milliseconds=200)
    assert bench.read(Object.POSITION_ACTUAL_VALUE, "i") < -2_000_000_000


def test_two_runs_are_bit_for_bit_the_same() -> None:
    def run() -> list[Frame]:
        bench = ServoBench(seed=9)
        bench.turn(milliseconds=5)
        for cycle in range(50):
            bench.receive(SYNC)
            bench.rpdo(0x0F, cycle * 10)
        return bench.sent

    assert run() == run()


def test_values_do_not_depend_on_how_often_the_drive_was_asked() -> None:
    def run(pieces: int) -> bytes:
        bench = ServoBench()
        bench.turn(milliseconds=0)
        for _ in range(20 * pieces):
            bench.wait_ms(1 / pieces)
            bench.receive(SYNC)
        return bench.servo.drive.firmware.inner.state()

    assert run(1) == run(4)


WORDS = st.one_of(st.sampled_from([0x00, 0x02, 0x06, 0x07, 0x0F, 0x80]), st.integers(0, 0xFFFF))


@examples_of(60)
@given(st.lists(st.tuples(WORDS, st.integers(-0x8000, 0x7FFF), st.integers(0, 30)), max_size=25))
def test_any_controlword_sequence_moves_along_the_arrows(words: list[tuple[int, int, int]]) -> None:
    """Each state that a TPDO shows is the one before or one that an arrow, or arrows 3 and 4, leads to."""
    follows = {(source, arrow.target) for (source, _cause), arrow in TRANSITION_OF.items()}
    follows |= {(State.READY, State.OPERATION_ENABLED)}
    follows |= {(State.OPERATION_ENABLED, State.SWITCH_ON_DISABLED)}
    bench = ServoBench()
    before = bench.state
    for controlword, torque, pause_ms in words:
        bench.rpdo(controlword, torque)
        after = bench.state
        assert after is before or (before, after) in follows
        bench.wait_ms(pause_ms)
        before, earlier = bench.state, after
        assert before is earlier or (earlier, before) in follows
