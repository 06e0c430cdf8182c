"""The client in modes that need bits of the controlword: set-up and set-points, by the frames on the wire."""

import math
from itertools import pairwise
from struct import unpack

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.exchange import PositionCommand
from servobench.drivers.timebase import Instant
from servobench.hil.pytest_plugin import MakeDrive
from servobench.hil.testing.drive_rig import DriveRig

SUB_MODE = Object.INTERPOLATION_SUB_MODE_SELECT
COUNT = math.tau / 65536


def cycles(rig: DriveRig, positions: list[float]) -> None:
    for position in positions:
        due = Instant(rig.clock.now() + rig.period)
        rig.network.send_sync()
        rig.wait(0.0005)
        rig.client.take_readings()
        rig.client.write(PositionCommand(rig.network.sync_count, position, due, due))
        rig.network.pump(due)


def position(rig: DriveRig) -> float:
    return int(rig.client.objects.read(Object.POSITION_ACTUAL_VALUE, 0, "i")) * COUNT


def test_a_drive_is_led_through_profile_position_by_hand_shakes(servo_drive: MakeDrive) -> None:
    """Each rise of bit 4 hands over what 607Ah is then; none comes before bit 12 of the one before fell."""
    rig = servo_drive()
    rig.enable(mode=Mode.PROFILE_POSITION, coherent=True)
    rig.wire.clear()
    cycles(rig, [0.002 * cycle for cycle in range(301)] + [0.6] * 100)
    rig.wait(0.1)
    assert position(rig) == pytest.approx(0.6, abs=0.01)
    words = [unpack("<Hi", bytes(frame.data)) for frame in rig.wire.frames if frame.can_id == 0x201]
    rises = [target for (before, _), (word, target) in pairwise(words) if word & ~before & 0x10]
    assert len(rises) > 60, "a set-point in a few cycles"
    assert rises == sorted(rises)
    assert {word for word, _ in words} == {0x3F, 0x2F}, "changed at once"
    acknowledged = [unpack("<H", bytes(f.data)[:2])[0] & 0x1000 for f in rig.wire.frames if f.can_id == 0x181]
    edges = sum(after and not before for before, after in pairwise(acknowledged))
    assert edges == pytest.approx(len(rises), abs=1)


def test_a_sub_mode_of_its_maker_s_is_set_to_linear_or_told(servo_drive: MakeDrive) -> None:
    rig = servo_drive()
    assert rig.device is not None
    variable = rig.device.dictionary.variable(SUB_MODE)
    variable.value = -2
    assert not any("60C0h" in note for note in rig.configure(mode=Mode.INTERPOLATED_POSITION))
    assert rig.client.objects.read(SUB_MODE, 0, "h") == 0
    variable.value, variable.low, variable.high = -2, -2, -2
    (note,) = (note for note in rig.configure(mode=Mode.INTERPOLATED_POSITION) if "60C0h" in note)
    assert "refused 0 (linear interpolation" in note
    assert not any("60C0h" in note for note in rig.configure(mode=Mode.CYCLIC_SYNCHRONOUS_POSITION))


@pytest.mark.parametrize(("rad_s2", "speed", "seconds"), [(1000.0, 9549, 1), (2.0, 115, 6)])
def test_the_ramps_of_velocity_mode_are_within_half_a_percent(
    servo_drive: MakeDrive, rad_s2: float, speed: int, seconds: int
) -> None:
    rig = servo_drive()
    rig.configure(mode=Mode.VELOCITY, set_acceleration_rad_s2=rad_s2, quick_stop_deceleration_rad_s2=rad_s2)
    for index in (0x6048, 0x6049, 0x604A):
        held = [rig.client.objects.read(index, sub, code) for sub, code in ((1, "I"), (2, "H"))]
        assert held == [speed, seconds]
    assert speed / seconds * math.tau / 60.0 == pytest.approx(rad_s2, rel=5e-3)
