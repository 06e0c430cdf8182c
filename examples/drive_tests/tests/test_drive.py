"""The drive by itself: states, moves, faults, and what goes over the wire."""

import math

import pytest

from servobench.drivers.cia402.motion import MoveProfile
from servobench.drivers.cia402.pdo_planner import all_modes_plan
from servobench.drivers.cia402.profile import State


def test_enabling_sends_these_controlwords_and_nothing_else(spindle):
    spindle.assert_controlwords(0x06, 0x07, 0x0F)
    spindle.assert_no_unintended_frame()
    spindle.assert_stays(State.OPERATION_ENABLED, for_s=0.3)


def test_torque_turns_the_shaft_and_a_quick_stop_stops_it(spindle):
    readings = spindle.run(0.2, torque_nm=0.3)
    assert readings[-1].velocity_rad_s > 100.0

    spindle.client.quick_stop(spindle.deadline(2.0))
    spindle.assert_reaches(State.SWITCH_ON_DISABLED, within_s=0.1)


def test_a_move_of_three_turns_keeps_the_controlword_in_force(spindle):
    spindle.client.disable(spindle.deadline(1.0))
    spindle.enable(plan=all_modes_plan(3))
    spindle.wire.clear()

    profile = MoveProfile(speed_rad_s=100.0, acceleration_rad_s2=2000.0, deceleration_rad_s2=2000.0)
    spindle.client.move_to(3 * math.tau, spindle.deadline(3.0), profile)

    spindle.assert_controlwords(0x0F, 0x3F, 0x2F)
    spindle.assert_no_unintended_frame()


def test_a_fault_is_told_by_an_emergency_and_reset_only_on_request(servo_drive):
    over_current = {"drive_fault": [{"fault": "over_current", "at_s": 2.0}]}
    rig = servo_drive(node=3, faults=over_current)
    rig.enable()

    rig.assert_reaches(State.FAULT, within_s=10.0)
    rig.wire.assert_sequence("083#1023*")
    rig.assert_stays(State.FAULT, for_s=0.2)

    rig.client.reset_fault(rig.deadline(1.0))
    rig.assert_reaches(State.SWITCH_ON_DISABLED, within_s=0.1)


@pytest.mark.servo_bus("hub")
def test_a_pulled_plug_is_noticed(servo_drive):
    rig = servo_drive(node=3)
    rig.enable()

    rig.process.kill()
    rig.wait(1.5)

    assert rig.client.status.lost_at is not None
