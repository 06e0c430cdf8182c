"""Set-points of commissioning's exercises: a drive is sent the quantity that its mode takes, and no other."""

from typing import cast

import pytest

from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.exchange import Command, Drive, PositionCommand, Reading, SpeedCommand
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.commissioning.drive_port import DrivePort
from servobench.hil.loop.scenario import Quantity

NOW = Instant(0)


class Noting(Drive):
    """A drive client in whatever mode; it notes what it would send."""

    name = "drive"

    def __init__(self) -> None:
        self.plan = mode_plan(1, PlanWish(coherent=True))
        self.sent: list[tuple[str, float]] = []
        self.told_at: list[int] = [0]
        """When the positions of the next readings were told."""

    def write(self, command: Command) -> None:
        if isinstance(command, SpeedCommand):
            self.sent.append(("rad/s", command.speed_rad_s))
        elif isinstance(command, PositionCommand):
            self.sent.append(("rad", command.position_rad))
        else:
            self.sent.append(("N m", command.torque_nm))

    def take_readings(self) -> list[Reading]:
        return [Reading(0.0, None, NOW, 5.0, Instant(at), 0.0, NOW, 0x237, NOW) for at in self.told_at]


def port_in(mode: Mode) -> tuple[DrivePort, Noting]:
    drive = Noting()
    return DrivePort(cast(ServoDrive, drive), mode, 1e-3), drive


def test_a_port_sends_what_its_mode_takes() -> None:
    port, drive = port_in(Mode.CYCLIC_SYNCHRONOUS_TORQUE)
    port.write(Command(1, 0.5, NOW, NOW))
    assert drive.sent == [("N m", 0.5)]
    port, drive = port_in(Mode.CYCLIC_SYNCHRONOUS_VELOCITY)
    port.write(SpeedCommand(1, 30.0, NOW, NOW))
    assert drive.sent == [("rad/s", 30.0)]
    port, drive = port_in(Mode.CYCLIC_SYNCHRONOUS_POSITION)
    port.take_readings()
    port.write(SpeedCommand(1, 30.0, NOW, NOW))
    port.write(SpeedCommand(2, -10.0, Instant(2 * NS_PER_MS), NOW))
    assert [unit for unit, _ in drive.sent] == ["rad", "rad"]
    assert [position for _, position in drive.sent] == pytest.approx([5.03, 5.01])


@pytest.mark.parametrize(
    "mode",
    [Mode.CYCLIC_SYNCHRONOUS_VELOCITY, Mode.PROFILE_VELOCITY, Mode.CYCLIC_SYNCHRONOUS_POSITION],
)
def test_a_torque_is_not_taken_for_a_speed(mode: Mode) -> None:
    port, drive = port_in(mode)
    assert port.quantity is not Quantity.TORQUE
    with pytest.raises(TypeError, match="is given speeds"):
        port.write(Command(1, 0.5, NOW, NOW))
    assert drive.sent == []


def test_a_reading_whose_position_was_lost_is_none() -> None:
    """In its place stands the last one, carried on by a velocity whose unit nobody has looked at yet."""
    port, drive = port_in(Mode.CYCLIC_SYNCHRONOUS_TORQUE)
    drive.told_at = [1, 2, 2, 2]
    assert [reading.position_told_at for reading in port.take_readings()] == [1, 2]
    drive.told_at = [2, 3]
    assert [reading.position_told_at for reading in port.take_readings()] == [3]


def test_a_drive_that_tells_its_position_more_seldom_is_taken_as_it_is() -> None:
    drive = Noting()
    drive.plan = mode_plan(1, PlanWish(position_every_cycles=4))
    port = DrivePort(cast(ServoDrive, drive), Mode.CYCLIC_SYNCHRONOUS_TORQUE, 1e-3)
    drive.told_at = [1, 1, 1, 1]
    assert len(port.take_readings()) == 4
