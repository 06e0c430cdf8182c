"""Who notices that commands do not reach a drive any more."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import DriveInFault
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from tests.unit.drivers.fake_bus import FakeBus, make_network
from tests.unit.drivers.profile_servo import ProfileServo

PERIOD = Duration(NS_PER_MS)
SETTINGS = DriveSettings(
    PERIOD,
    torque_max_nm=5.0,
    speed_max_rad_s=250.0,
    quick_stop_deceleration_rad_s2=1000.0,
    command_timeout_ms=20,
)


class Rig:
    """A drive that shows, by 6074h or 6077h, the torque that it was sent, until it hears nothing more."""

    def __init__(self) -> None:
        self.bus: FakeBus
        self.bus, self.network = make_network()
        self.servo = ProfileServo(self.bus)
        self.drive = ServoDrive(self.network, 1, "axis1")
        self.deaf = False

    def soon(self) -> Instant:
        return self.network.deadline_after(Duration(NS_PER_S))

    def enable(self, settings: DriveSettings = SETTINGS) -> str:
        self.drive.connect(self.soon())
        self.drive.configure(settings)
        self.drive.enable(self.soon())
        return self.drive.supervise_commands()

    def run(self, cycles: int) -> None:
        """Torques that differ from cycle to cycle."""
        for cycle in range(cycles):
            if not self.deaf:
                shown = self.servo.values[0x6071, 0]
                self.servo.values[0x6074, 0], self.servo.values[0x6077, 0] = shown, shown + 50
            self.network.send_sync()
            due = self.network.deadline_after(PERIOD)
            self.network.pump(due)
            self.drive.write(Command(cycle, 0.004 * ((37 * cycle) % 500), due, due))
            self.drive.check()


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.bus.shutdown()


def test_a_drive_with_an_event_timer_looks_after_its_commands_itself_and_the_host_after_the_drive(
    rig: Rig,
) -> None:
    words = rig.enable()
    drive = "the drive itself (1400h:05), after 20 ms, and at rest within 250 ms from then"
    assert words == f"{drive}; the host by 6074h, after 22 cycles"
    assert rig.servo.values[0x1400, 5] == 20
    assert rig.drive.supervision.active
    rig.run(100)
    rig.deaf = True
    rig.run(15)
    with pytest.raises(DriveInFault, match="no longer follows its commands"):
        rig.run(8)


@pytest.mark.parametrize("leave", ["disable", "quick_stop", "release"])
def test_the_event_timer_is_taken_back_before_the_commands_cease(rig: Rig, leave: str) -> None:
    rig.enable()
    if leave == "release":
        rig.drive.release()
    else:
        getattr(rig.drive, leave)(rig.soon())
    assert rig.servo.values[0x1400, 5] == 0


def test_without_a_time_nobody_looks_after_them(rig: Rig) -> None:
    assert rig.enable(replace(SETTINGS, command_timeout_ms=None)) == ""
    assert rig.servo.values[0x1400, 5] == 0


@pytest.mark.parametrize("timer", ["missing", "refused", "stubborn"])
def test_in_place_of_a_drive_that_does_not_the_host_does(rig: Rig, timer: str) -> None:
    if timer == "missing":
        del rig.servo.types[0x1400, 5]
    elif timer == "refused":
        rig.servo.refuse[0x1400, 5] = 0x06010002
    else:
        rig.servo.stubborn.add((0x1400, 5))
    words = rig.enable()
    assert words == "the host by 6074h, after 20 cycles (20 ms), and at rest within 250 ms from then"
    rig.run(100)
    rig.deaf = True
    rig.run(15)
    with pytest.raises(DriveInFault, match="no longer follows its commands"):
        rig.run(6)
    assert not rig.drive.enabled


def test_without_torque_demand_the_host_looks_at_the_torque(rig: Rig) -> None:
    del rig.servo.types[0x1400, 5]
    del rig.servo.types[0x6074, 0]
    assert rig.enable().startswith("the host by 6077h, after 20 cycles")
    rig.run(100)
    rig.servo.values[0x6077, 0] = 2000
    rig.deaf = True
    rig.servo.mode_status = 1 << 11
    rig.run(50)
    rig.servo.mode_status = 0
    with pytest.raises(DriveInFault, match="no longer follows its commands"):
        rig.run(20)


def test_a_drive_that_is_let_go_is_not_watched_any_more(rig: Rig) -> None:
    del rig.servo.types[0x1400, 5]
    rig.enable()
    rig.run(30)
    rig.drive.disable(rig.soon())
    rig.drive.enable(rig.soon())
    rig.deaf = True
    rig.run(60)


def test_nobody_looks_after_speeds_that_a_drive_without_event_timer_is_sent(rig: Rig) -> None:
    del rig.servo.types[0x1400, 5]
    assert rig.enable(replace(SETTINGS, mode=Mode.CYCLIC_SYNCHRONOUS_VELOCITY)).startswith("nobody: ")
    rig.drive.disable(rig.soon())


def test_nobody_looks_before_the_first_command_and_after_the_last(rig: Rig) -> None:
    supervision = rig.drive.supervision
    assert not supervision.active
    rig.enable()
    assert supervision.active
    supervision.end()
    assert not supervision.active


def test_nobody_looks_after_a_drive_that_is_configured_anew(rig: Rig) -> None:
    for timer in ("the drive's", "missing"):
        if timer == "missing":
            del rig.servo.types[0x1400, 5]
        supervision = rig.drive.supervision
        rig.enable()
        assert supervision.active
        assert rig.drive.plan is not None
        supervision.configure(SETTINGS, rig.drive.plan, rig.drive.assembler)
        assert not supervision.active


def test_the_host_needs_two_cycles_to_judge_by(rig: Rig) -> None:
    del rig.servo.types[0x1400, 5]
    assert ", after 2 cycles (1 ms)" in rig.enable(replace(SETTINGS, command_timeout_ms=1))


def test_nobody_looks_after_a_set_point_that_no_rpdo_carries(rig: Rig) -> None:
    rig.enable()
    assert rig.drive.supervision.begin(Mode.CYCLIC_SYNCHRONOUS_POSITION).startswith("nobody: ")


def test_without_speed_or_deceleration_no_time_to_rest_is_promised(rig: Rig) -> None:
    own = ", then by the drive's own quick stop"
    assert rig.enable(replace(SETTINGS, speed_max_rad_s=None)).partition(";")[0].endswith(own)
    rig.drive.disable(rig.soon())
    assert rig.enable(replace(SETTINGS, quick_stop_deceleration_rad_s2=None)).partition(";")[0].endswith(own)
