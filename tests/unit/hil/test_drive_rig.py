"""The fixture ``servo_drive`` in simulated time: what it asks of a drive, and what its assertions say."""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.cia402.profile import State
from drivers.errors import DriveInFault
from drivers.timebase import NS_PER_MS
from hil.testing.drive_rig import DriveRig, DriveWish, drive_rig
from hil.testing.hosted import DriveHost

OVER_TEMPERATURE = {"drive_fault": [{"fault": "over_temperature", "nodes": [3], "at_s": 0.5}]}


@pytest.fixture
def host(tmp_path: Path) -> DriveHost:
    return DriveHost("simulated", tmp_path)


@pytest.fixture
def rig(host: DriveHost) -> Iterator[DriveRig]:
    with drive_rig("simulated", host, DriveWish(node=3, seed=1)) as made:
        yield made


def test_it_enables_and_turns_the_shaft(rig: DriveRig) -> None:
    assert rig.device is not None
    assert rig.process is None
    assert rig.period == NS_PER_MS
    rig.enable()
    assert rig.state() is State.OPERATION_ENABLED
    began = rig.clock.now()
    readings = rig.run(0.2, torque_nm=0.3)
    assert rig.clock.now() - began == 200 * NS_PER_MS
    assert len(readings) == 200
    syncs = rig.wire.find("080#*", sent=True)
    assert syncs[-1].at - syncs[0].at == 199 * NS_PER_MS
    motor = rig.motor.parameters
    rise = 1.0 - math.exp(-0.2 * motor.viscous_friction_nm_s / motor.inertia_kg_m2)
    reached = (0.3 - motor.coulomb_friction_nm) / motor.viscous_friction_nm_s * rise
    assert readings[-1].velocity_rad_s == pytest.approx(reached, rel=0.02)


def test_a_torque_may_follow_the_reading(rig: DriveRig) -> None:
    rig.enable()
    readings = rig.run(0.5, lambda reading: 0.02 * (20.0 - reading.velocity_rad_s))
    assert readings[-1].velocity_rad_s == pytest.approx(20.0, rel=0.1)


def test_what_it_writes_are_the_motors_own_limits(rig: DriveRig) -> None:
    motor = rig.motor.parameters
    settings = rig.settings
    assert (settings.torque_max_nm, settings.speed_max_rad_s) == (
        motor.rated_torque_nm,
        motor.rated_speed_rad_s,
    )
    assert (settings.host_heartbeat_ms, settings.host_heartbeat_timeout_ms) == (100, 1000)
    assert (settings.drive_heartbeat_ms, settings.drive_heartbeat_timeout_ms) == (100, 1000)
    rig.configure(torque_max_nm=0.5 * motor.rated_torque_nm)
    assert rig.client.objects.read(0x6072, 0, "H") == 500
    assert rig.client.objects.read(0x1017, 0, "H") == 100
    rig.enable()
    assert rig.client.objects.read(0x6072, 0, "H") == 500  # what was configured is not configured anew
    rig.client.release()
    rig.enable(torque_max_nm=motor.rated_torque_nm)
    assert rig.client.objects.read(0x6072, 0, "H") == 1000


def test_a_state_that_is_reached_and_one_that_is_not(rig: DriveRig) -> None:
    rig.enable()
    rig.run(0.3, torque_nm=0.3)
    rig.client.quick_stop(rig.deadline(1.0))
    assert 0.0 <= rig.assert_reaches(State.SWITCH_ON_DISABLED, within_s=0.5) < 0.5
    rig.assert_stays(State.SWITCH_ON_DISABLED, for_s=0.1)
    with pytest.raises(AssertionError) as caught:
        rig.assert_reaches(State.OPERATION_ENABLED, within_s=0.2)
    assert str(caught.value) == (
        "node 3: not in 'operation enabled' after 0.2 s; it was in 'switch on disabled'"
    )
    with pytest.raises(AssertionError) as caught:
        rig.assert_stays(State.OPERATION_ENABLED, for_s=0.1)
    assert "'switch on disabled' after 0.00" in str(caught.value)
    assert str(caught.value).endswith("to stay in 'operation enabled' for 0.1 s")


def test_a_fault_is_told_with_its_code(host: DriveHost) -> None:
    with drive_rig("simulated", host, DriveWish(node=3, faults=OVER_TEMPERATURE)) as rig:
        rig.enable()
        with pytest.raises(DriveInFault):
            rig.run(1.0)
        assert rig.clock.now() / 1e9 == pytest.approx(0.5, abs=0.01)
        with pytest.raises(AssertionError) as caught:
            rig.assert_stays(State.OPERATION_ENABLED, for_s=0.5)
        assert "node 3: 'fault reaction active' after 0.000 s, to stay" in str(caught.value)
        assert "; EMCY: 4310h " in str(caught.value)
        with pytest.raises(AssertionError) as caught:
            rig.assert_reaches(State.OPERATION_ENABLED, within_s=0.05)
        assert "then in 'fault'; EMCY: 4310h" in str(caught.value)


def test_frames_that_nobody_intended_are_found(rig: DriveRig) -> None:
    with pytest.raises(ValueError, match="the drive was not configured: no PDO is intended yet"):
        rig.assert_no_unintended_frame()
    rig.enable()
    rig.run(0.01)
    rig.assert_no_unintended_frame()
    rig.network.send_message(0x555, b"\x01")
    rig.wait(0.001)
    with pytest.raises(AssertionError, match="555"):
        rig.assert_no_unintended_frame()
    rig.assert_no_unintended_frame(allow=("555#*",))
    rig.wire.clear()
    rig.assert_no_unintended_frame()


def test_controlwords_are_those_that_were_sent(rig: DriveRig) -> None:
    rig.configure()
    rig.wire.clear()
    rig.enable()
    rig.assert_controlwords(0x0006, 0x0007, 0x000F)
    rig.wire.clear()
    rig.run(0.01)
    with pytest.raises(AssertionError) as caught:
        rig.assert_controlwords(0x0006)
    assert str(caught.value).startswith("node 3: controlwords 0006h expected, the host sent")
    rig.wire.clear()
    rig.release()
    with pytest.raises(AssertionError) as caught:
        rig.assert_controlwords()
    assert str(caught.value).startswith("node 3: controlwords none expected, the host sent:\n  0.")
    assert rig.state() is State.SWITCH_ON_DISABLED


def test_at_its_end_the_drive_is_at_rest(host: DriveHost) -> None:
    with drive_rig("simulated", host, DriveWish(node=3)) as rig:
        rig.enable()
        assert rig.run(0.3, torque_nm=0.3)[-1].velocity_rad_s > 10.0
        rig.wire.clear()
    assert rig.client.plan is not None
    words = [command.word for command in rig.wire.controlwords(3, rig.client.plan)]
    assert (words[0], words[-1]) == (0x0002, 0x0000)  # quick stop, then disable voltage


def test_a_motor_and_a_plan_may_be_files(host: DriveHost, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('[[drive_fault]]\nfault = "under_voltage"\nnodes = [1]\nat_s = 0.1\n')
    wish = DriveWish(motor="examples/motors/azaiz2007.toml", faults=plan)
    with drive_rig("simulated", host, wish) as rig:
        assert rig.motor.parameters.pole_pairs == 4
        with pytest.raises(DriveInFault, match="3220h"):
            rig.enable()
