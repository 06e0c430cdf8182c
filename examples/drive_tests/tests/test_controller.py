"""The controller closes its loop over CANopen, on a good day and on bad ones."""

import pytest
from spindle_control import SpindleController

from servobench import DriveInFault, LimitExceeded, State


def test_speed_settles_after_the_step_and_after_the_load(servo_bench, bench, controller):
    run = servo_bench(bench, controllers={"spindle": controller})
    run.assert_passed()
    run.assert_settles(within_s=0.5, band_percent=3)
    run.assert_error_below(percent=20, from_s=1.2)
    run.assert_no_unintended_frame()


@pytest.mark.servo_bus("simulated")  # so many in a row and no more: a figure of simulated time
def test_lost_and_late_readings_are_lived_with(servo_bench, bench, controller):
    bad_day = {
        "loss": [{"probability": 0.1, "direction": "drive_to_host"}],
        "delay": [{"delay_min_us": 0, "delay_max_us": 4500, "direction": "drive_to_host"}],
    }
    run = servo_bench(bench, faults=bad_day, controllers={"spindle": controller})
    run.assert_dropouts_handled(at_least=10, in_a_row_max=10)
    run.assert_settles(within_s=0.5, band_percent=5)


@pytest.mark.servo_bus("simulated")
def test_a_drive_fault_ends_the_run_with_the_drive_at_rest(servo_bench, bench, controller):
    over_temperature = {"drive_fault": [{"fault": "over_temperature", "at_s": 0.6}]}
    run = servo_bench(
        bench, faults=over_temperature, controllers={"spindle": controller}, ends_in=DriveInFault
    )
    assert "4310h" in str(run.error)
    run.assert_reached(State.FAULT, by_s=1.0)
    run.wire.assert_seen("083#1043*")


def test_a_controller_with_a_wrong_sign_is_stopped(servo_bench, bench):
    runaway = SpindleController(proportional=-0.05, integral=0.0, friction=0.0, period_s=0.005)
    run = servo_bench(bench, controllers={"spindle": runaway}, ends_in=LimitExceeded)
    assert "spindle" in str(run.error)
    run.assert_reached(State.SWITCH_ON_DISABLED)
