"""csp entered while the shaft turns, with a target position from before: drives that jump, and that hold."""

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.set_point_path import SetPointPath
from tests.unit.virtual_bus.motion_bench import COUNTS, MotionBench

SPEED = 10.0
"""turns/s."""


def entered(holds: bool, offset: int = 0) -> tuple[MotionBench, float]:
    """In csp from 600 r/min, some turns from the 607Ah = 0 of power-on; and where that was."""
    bench = MotionBench(Mode.PROFILE_VELOCITY, DriveParameters(path=SetPointPath(holds_stale=holds)))
    bench.set(Object.FOLLOWING_ERROR_WINDOW, "I", 0xFFFF_FFFF)
    bench.set(Object.POSITION_OFFSET, "i", offset)
    bench.speed(SPEED)
    bench.wait_until(lambda: bench.turns > 8.0, 5000)
    bench.set(Object.MODES_OF_OPERATION, "b", Mode.CYCLIC_SYNCHRONOUS_POSITION)
    return bench, bench.turns


@pytest.mark.parametrize("offset", [0, -COUNTS])
def test_a_drive_that_holds_stays_where_it_was(offset: int) -> None:
    bench, place = entered(holds=True, offset=offset)
    fastest = max(bench.watch(800, lambda: abs(bench.turns_s)))
    assert fastest == pytest.approx(SPEED, rel=0.05)
    assert bench.turns == pytest.approx(place, abs=0.01)
    bench.set(Object.TARGET_POSITION, "i", round(place * COUNTS) + COUNTS // 4 - offset)
    bench.wait_ms(300)
    assert bench.turns == pytest.approx(place + 0.25, abs=0.01)


def test_a_drive_that_does_not_goes_there_at_once() -> None:
    bench, _ = entered(holds=False)
    assert max(bench.watch(800, lambda: abs(bench.turns_s))) > 3.0 * SPEED
    assert bench.turns == pytest.approx(0.0, abs=0.01)


def test_the_same_set_point_written_again_is_a_new_one() -> None:
    bench, place = entered(holds=True)
    bench.wait_ms(500)
    assert bench.turns == pytest.approx(place, abs=0.01)
    bench.set(Object.TARGET_POSITION, "i", 0)
    bench.wait_ms(1000)
    assert bench.turns == pytest.approx(0.0, abs=0.01)
