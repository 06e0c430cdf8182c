"""python canopen as it is: master of the simulated drive's touch probe, torque limits and relative moves."""

from typing import Any

import canopen

from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING
from tests.scenario.test_canopen_master import Wire, data_sheet

COUNTS = 65_536


class Drive:
    """A simulated drive on a wire, and canopen's node for it by its exported sheet."""

    def __init__(self, mode: int) -> None:
        servo = SimulatedServo(1, LING)
        network = canopen.Network()
        self.wire = Wire(servo, network)
        network.bus = self.wire
        node: Any = canopen.RemoteNode(1, data_sheet(servo))
        network.add_node(node)
        self.sdo, self.ms = node.sdo, 0
        self.wire.power_on()
        self.wait(50)
        self.sdo[0x6060].raw = mode
        for word in (0x06, 0x07, 0x0F):
            self.sdo[0x6040].raw = word
            self.wait(5)
        assert self.sdo[0x6041].raw & 0x6F == 0x27

    def wait(self, milliseconds: int) -> None:
        self.ms += milliseconds
        self.wire.run_until_ms(self.ms)


def test_a_foreign_master_captures_the_zero_impulse_and_an_input() -> None:
    drive = Drive(3)
    sdo = drive.sdo
    sdo["Target velocity"].raw = 120_000
    sdo["Touch probe function"].raw = 0x1015
    sdo["Touch probe function"].raw = 0x1115
    drive.wait(1000)
    sdo[0x2110][11].raw = 2
    assert sdo["Touch probe status"].raw == 0x0303
    assert sdo["Touch probe 1 positive edge"].raw == COUNTS
    assert abs(sdo["Touch probe 2 positive edge"].raw - sdo["Position actual value"].raw) < 10
    assert sdo["Position actual value"].raw > COUNTS


def test_a_foreign_master_bounds_either_sign_of_the_torque() -> None:
    drive = Drive(10)
    drive.sdo["Positive torque limit"].raw = 50
    for target, made in ((400, 50), (-400, -400)):
        drive.sdo["Target torque"].raw = target
        drive.wait(5)
        assert drive.sdo["Torque demand"].raw == made


def test_a_foreign_master_moves_relative_to_where_the_shaft_is() -> None:
    drive = Drive(1)
    sdo = drive.sdo
    sdo["Positioning option code"].raw = 2
    sdo["Target position"].raw = 20 * COUNTS
    sdo["Controlword"].raw = 0x1F
    drive.wait(400)
    sdo["Controlword"].raw = 0x0F
    here = sdo["Position actual value"].raw
    assert 0 < here < 19 * COUNTS
    sdo["Target position"].raw = 8 * COUNTS
    sdo["Controlword"].raw = 0x7F
    drive.wait(4000)
    assert abs(sdo["Position actual value"].raw - here - 8 * COUNTS) < 0.01 * COUNTS
