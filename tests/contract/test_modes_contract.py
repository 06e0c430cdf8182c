"""Every mode of operation from the drive client, on the simulated drive with its motor."""

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest

from drivers.exchange import Reading
from drivers.motion import Homing, Profile
from drivers.pdo_plans import all_modes_plan
from drivers.profile402 import Mode, State
from drivers.timebase import Instant
from tests.contract.test_drive_contract import PERIOD, SETTINGS, Bench, make_bench

TURN = math.tau
PROFILE = Profile(speed_rad_s=10 * TURN, acceleration_rad_s2=200 * TURN, deceleration_rad_s2=200 * TURN)
COUNT = TURN / 65536


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = make_bench()
    made.enable(replace(SETTINGS, plan=all_modes_plan(1, device_stamp=True)))
    yield made
    made.bus.shutdown()


def counts(bench: Bench) -> int:
    return int(bench.drive.objects.read(0x6064, 0, "i"))


def test_a_profile_move_ends_where_it_was_sent(bench: Bench) -> None:
    bench.drive.move_to(3 * TURN, bench.soon(3.0), PROFILE)
    bench.network.pump(bench.soon(0.1))
    assert counts(bench) * COUNT == pytest.approx(3 * TURN, abs=0.02)
    bench.drive.move_to(-1 * TURN, bench.soon(3.0), relative=True)
    bench.network.pump(bench.soon(0.1))
    assert counts(bench) * COUNT == pytest.approx(2 * TURN, abs=0.02)


def test_profile_velocity_reaches_its_speed_and_halts(bench: Bench) -> None:
    bench.drive.run_at(50.0, bench.soon(3.0), PROFILE)
    assert bench.run(10, 0.0)[-1].velocity_rad_s == pytest.approx(50.0, rel=0.02)
    bench.drive.halt(bench.soon(3.0))
    assert abs(bench.run(10, 0.0)[-1].velocity_rad_s) < 1.0
    bench.drive.resume()
    bench.drive.run_at(-20.0, bench.soon(3.0))
    assert bench.run(10, 0.0)[-1].velocity_rad_s == pytest.approx(-20.0, rel=0.03)


def test_profile_torque_reaches_its_torque(bench: Bench) -> None:
    bench.drive.apply_torque(0.2, bench.soon(3.0), Profile(torque_slope_nm_s=20.0))
    assert bench.drive.objects.read(0x6077, 0, "h") == pytest.approx(100, abs=5)


def test_homing_on_the_spot_sets_the_position(bench: Bench) -> None:
    bench.drive.move_to(TURN, bench.soon(3.0), PROFILE)
    bench.drive.home(35, bench.soon(3.0), Homing(offset_rad=0.25 * TURN))
    assert counts(bench) == pytest.approx(-16384, abs=100), "the zero is the home plus its offset"


def test_cyclic_position_and_velocity_follow(bench: Bench) -> None:
    drive, network = bench.drive, bench.network
    start = counts(bench) * COUNT
    drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_POSITION, bench.soon())
    readings: list[Reading] = []
    for cycle in range(1, 401):
        due = network.deadline_after(PERIOD)
        network.send_sync()
        drive.write_position(start + 0.5 * (1 - math.cos(cycle * 0.4e-3 * TURN)), Instant(due))
        network.pump(due)
        readings += drive.take_readings()
    assert readings[-1].position_rad == pytest.approx(start + 0.5 * (1 - math.cos(0.16 * TURN)), abs=0.05)
    drive.change_mode(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, bench.soon())
    for cycle in range(1, 401):
        due = network.deadline_after(PERIOD)
        network.send_sync()
        drive.write_speed(min(cycle * 0.1, 30.0), Instant(due))
        network.pump(due)
        readings += drive.take_readings()
    assert readings[-1].velocity_rad_s == pytest.approx(30.0, rel=0.03)
    assert drive.control.read_state() is State.OPERATION_ENABLED
    assert drive.release().at_rest
