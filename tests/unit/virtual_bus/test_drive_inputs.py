"""Digital inputs 60FDh: switches, what a master sees of them, and safe torque off."""

import math

import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.cia402.objects402 import INTERLOCK, Object
from servobench.drivers.cia402.profile import Mode, State, Status
from servobench.virtual_bus.drive.machine import MACHINE
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.motion_bench import ENABLED, INPUTS_HELD, STO, MotionBench
from tests.unit.virtual_bus.test_drive_commands import WAY_TO


def bench_in(state: State) -> MotionBench:
    bench = MotionBench(Mode.PROFILE_VELOCITY, DriveParameters(brake_torque_nm=0.0), enabled=False)
    bench.set(Object.QUICK_STOP_OPTION, "h", 6)
    bench.profile(10.0, 500.0, 100.0)
    bench.speed(10.0)
    for word in WAY_TO[state]:
        bench.control(word)
        bench.wait_ms(60 if word == ENABLED else 0)
    if state in (State.FAULT, State.FAULT_REACTION):
        bench.servo.drive.fail(0x3210, ErrorRegister.VOLTAGE)
    assert bench.state is state
    return bench


@pytest.mark.parametrize("state", list(WAY_TO))
def test_safe_torque_off_in_every_state(state: State) -> None:
    bench = bench_in(state)
    faulty = state in (State.FAULT, State.FAULT_REACTION)
    after = State.FAULT if faulty else State.SWITCH_ON_DISABLED
    speed = bench.speed_rad_s
    bench.set(MACHINE, "B", 1, STO)
    assert bench.state is after
    assert bench.inputs == INTERLOCK
    assert not bench.statusword & Status.VOLTAGE_ENABLED
    bench.wait_ms(100)
    decay = math.exp(-0.1 * LING.viscous_friction_nm_s / LING.inertia_kg_m2)
    assert bench.speed_rad_s == pytest.approx(speed * decay, rel=0.02, abs=0.01), "no torque at all"
    bench.control(0x00)
    bench.control(0x80)
    for word in (0x06, 0x07, ENABLED):
        bench.control(word)
        assert bench.shows(State.SWITCH_ON_DISABLED), "arrow 2 is closed"
    bench.set(MACHINE, "B", 0, STO)
    assert bench.shows(State.SWITCH_ON_DISABLED), "and it stays so until it is commanded"
    assert bench.statusword & Status.VOLTAGE_ENABLED
    assert bench.inputs == 0
    bench.enable()


def test_switches_show_in_60fd_where_the_shaft_is() -> None:
    bench = MotionBench(Mode.PROFILE_POSITION)
    bench.profile(20.0, 500.0, 500.0)
    bench.fit(0b111, negative=-1.0, positive=1.0, home_from=-0.2, home_to=0.2)
    for place, bits in ((0.0, 0b100), (0.5, 0), (0.99, 0), (-0.5, 0), (-0.19, 0b100)):
        bench.target(place)
        bench.wait_ms(5)
        bench.until_reached()
        assert bench.inputs == bits, place
    bench.fit(0b011)
    assert bench.inputs == 0, "what is not fitted is not seen"


def test_inputs_held_by_hand_are_those_of_the_switches_and_more() -> None:
    bench = MotionBench(Mode.PROFILE_POSITION)
    for bits in (0b001, 0b010, 0b100, 0x0001_0000, 0x8000_0000):
        bench.set(MACHINE, "I", bits, INPUTS_HELD)
        assert bench.inputs == bits
    bench.set(MACHINE, "I", 0, INPUTS_HELD)
    assert bench.inputs == 0


def test_a_change_of_an_input_is_an_event_for_a_tpdo() -> None:
    bench = MotionBench(Mode.PROFILE_VELOCITY, enabled=False)
    bench.set(0x1802, "I", 0x8000_0381, 1)
    bench.set(0x1A02, "B", 0, 0)
    bench.set(0x1A02, "I", 0x60FD_0020, 1)
    bench.set(0x1A02, "B", 1, 0)
    bench.set(0x1802, "B", 255, 2)
    bench.set(0x1802, "I", 0x381, 1)

    def events() -> list[int]:
        seen = [int.from_bytes(frame.data, "little") for frame in bench.sent if frame.can_id == 0x381]
        bench.sent.clear()
        return seen

    bench.sent.clear()
    bench.set(MACHINE, "I", 0x8000, INPUTS_HELD)
    bench.set(MACHINE, "I", 0, INPUTS_HELD)
    assert events() == [0x8000, 0]
    bench.fit(0b100, home_from=0.5, home_to=0.7)
    bench.profile(10.0, 500.0, 100.0)
    bench.enable()
    bench.speed(10.0)
    bench.wait_ms(120)
    assert events() == [0b100, 0], "in and out again, without a write"
    bench.set(MACHINE, "B", 1, STO)
    assert events() == [INTERLOCK]


def test_the_machine_outlasts_a_reset_of_the_node() -> None:
    bench = MotionBench(Mode.PROFILE_POSITION)
    bench.fit(0b010, positive=-1.0)
    bench.set(MACHINE, "B", 1, STO)
    bench.nmt(129)
    bench.wait_ms(DriveParameters().boot_after_reset_ms)
    assert bench.inputs == 0b010 | INTERLOCK
    bench.control(0x06)
    assert bench.shows(State.SWITCH_ON_DISABLED)
