"""What a drive holds at the moment at which it is enabled, and what it was asked before."""

from collections.abc import Iterator

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.mode_control import MODE_BITS
from servobench.drivers.cia402.profile import Mode, State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from tests.unit.drivers.fake_bus import FakeBus, make_network
from tests.unit.drivers.profile_servo import ProfileServo

PERIOD = Duration(NS_PER_MS)
STATUSWORD_TPDO = 3
NEW_SET_POINT = 0x10


class SlowTeller(ProfileServo):
    """Its statusword is ``late_ns`` on its way by PDO; by SDO it is there at once."""

    def __init__(self, bus: FakeBus) -> None:
        super().__init__(bus)
        self.late_ns = 0

    def _send_tpdo(self, number: int, after_ns: int) -> None:
        late_ns = self.late_ns if number + 1 == STATUSWORD_TPDO else 0
        super()._send_tpdo(number, after_ns + late_ns)


Bench = tuple[FakeBus, SlowTeller, CanopenNetwork, ServoDrive]


@pytest.fixture
def bench() -> Iterator[Bench]:
    bus, network = make_network()
    servo, drive = SlowTeller(bus), ServoDrive(network, 1, "axis1")
    drive.connect(network.deadline_after(Duration(NS_PER_S)))
    yield bus, servo, network, drive
    bus.shutdown()


def soon(bench: Bench) -> Instant:
    return bench[2].deadline_after(Duration(NS_PER_S))


def configure(bench: Bench, mode: Mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE) -> None:
    bench[3].configure(DriveSettings(PERIOD, torque_max_nm=5.0, speed_max_rad_s=250.0, mode=mode))


def test_a_drive_that_was_not_configured_is_not_enabled(bench: Bench) -> None:
    """It would have no limits, nor would it watch the host."""
    bus, servo, _, drive = bench
    sent = len(bus.sent)
    with pytest.raises(RuntimeError, match="axis1 was not configured"):
        drive.enable(soon(bench))
    assert len(bus.sent) == sent
    assert servo.state is State.SWITCH_ON_DISABLED


def test_the_shaft_stays_where_it_is_now_not_where_it_was_when_configured(bench: Bench) -> None:
    _, servo, _, drive = bench
    servo.values[0x6064, 0] = 1000
    configure(bench, Mode.CYCLIC_SYNCHRONOUS_POSITION)
    assert servo.values[0x607A, 0] == 1000
    servo.values[0x6064, 0] = 50_000
    drive.enable(soon(bench))
    assert servo.state is State.OPERATION_ENABLED
    assert servo.values[0x607A, 0] == 50_000


def test_the_bits_of_the_mode_are_cleared_first(bench: Bench) -> None:
    """They would start a move, or homing, as soon as the drive is enabled."""
    _, servo, _, drive = bench
    configure(bench)
    drive.control.set_bits(MODE_BITS, NEW_SET_POINT)
    servo.control_history.clear()
    drive.enable(soon(bench))
    assert servo.state is State.OPERATION_ENABLED
    assert not [word for word in servo.control_history if word & MODE_BITS]


def test_a_drive_that_is_enabled_already_loses_the_bits_of_the_mode_too(bench: Bench) -> None:
    _, servo, _, drive = bench
    configure(bench)
    drive.enable(soon(bench))
    drive.control.set_bits(MODE_BITS, NEW_SET_POINT)
    drive.enable(soon(bench))
    assert servo.values[0x6040, 0] == 0x0F


def test_an_older_statusword_that_comes_late_does_not_end_it(bench: Bench) -> None:
    _, servo, network, drive = bench
    configure(bench)
    servo.late_ns = 30 * NS_PER_MS
    drive.enable(soon(bench))
    until = network.deadline_after(Duration(2 * servo.late_ns))
    while network.pump_one(until):
        drive.check()
    assert drive.enabled
