"""What a drive that cannot serve is refused for: the truth, and what to do next."""

import pytest

from servobench.drivers.cia402.profile import BENCH_RULE
from servobench.drivers.errors import NoAnswer, PeerFault
from tests.unit.drivers.test_servo import SETTINGS, Bench, bench, soon

__all__ = ["bench"]


def test_no_torque_mode_is_refused(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.values[0x6502, 0] = 1
    drive.connect(soon(network))
    with pytest.raises(PeerFault, match="torque mode"):
        drive.configure(SETTINGS)


def test_a_drive_without_the_mode_is_not_asked_for_its_torque_unit(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.values[0x6502, 0] = 1 << 2
    servo.values[0x6076, 0] = 0
    drive.connect(soon(network))
    with pytest.raises(PeerFault, match="has no cyclic synchronous torque mode") as refused:
        drive.configure(SETTINGS)
    assert refused.value.remedy == BENCH_RULE
    servo.values[0x6502, 0] = 1 << 9
    with pytest.raises(PeerFault, match="does not tell its torque unit"):
        drive.configure(SETTINGS)


def test_a_node_that_is_not_there_or_no_drive_is_looked_for_by_hil_scan(bench: Bench) -> None:
    _, servo, network, drive = bench
    servo.values[0x1000, 0] = 0x00030191
    with pytest.raises(PeerFault, match="hil scan --bus fake"):
        drive.connect(soon(network))
    servo.silent = True
    with pytest.raises(NoAnswer, match="hil scan --bus fake"):
        drive.connect(soon(network))
