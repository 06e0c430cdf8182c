"""python canopen, as it is, as a master over objects that its profile does not know: ranges, jerk, probes and
both encoders.
"""

import io
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import canopen
import pytest

from servobench.design.mechanism import Coupling, Mechanism
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING
from tests.scenario.test_canopen_master import Wire

NODE = 1
TURN = 65_536
NEAR = 0.001 * TURN
HALF = 0.5 * LING.inertia_kg_m2


class DriveMaster:
    """A canopen network on a wire with a drive that has two encoders."""

    def __init__(self) -> None:
        shaft = Coupling(HALF, HALF, 2000.0, 0.3, second_encoder=True)
        servo: Any = SimulatedServo(NODE, replace(LING, mechanism=Mechanism(shaft)))
        network = canopen.Network()
        self.wire = network.bus = Wire(servo, network)
        sheet = io.StringIO(export_eds(servo.dictionary))
        sheet.name = "servo.eds"
        self.node: Any = canopen.RemoteNode(NODE, sheet)
        network.add_node(self.node)
        self.network: Any = network
        self.wire.power_on()
        self._ms = 0

    def wait_ms(self, milliseconds: int) -> None:
        self._ms += milliseconds
        self.wire.run_until_ms(self._ms)

    def put(self, index: int, value: int, sub: int | None = None) -> None:
        entry = self.node.sdo[index]
        (entry if sub is None else entry[sub]).raw = value

    def get(self, index: int, sub: int | None = None) -> int:
        entry = self.node.sdo[index]
        return int((entry if sub is None else entry[sub]).raw)

    def refuses(self, index: int, value: int, sub: int | None = None) -> int:
        with pytest.raises(canopen.SdoAbortedError) as caught:
            self.put(index, value, sub)
        return int(caught.value.code)

    def enable(self, mode: int) -> None:
        self.put(0x6060, mode)
        for controlword in (0x06, 0x07, 0x0F):
            self.put(0x6040, controlword)
        self.wait_ms(20)


@pytest.fixture
def master() -> Iterator[DriveMaster]:
    made = DriveMaster()
    yield made
    made.wire.shutdown()


def test_its_data_sheet_knows_the_objects_and_refuses_what_the_drive_lacks(master: DriveMaster) -> None:
    for index, sub, value in ((0x607B, 1, -TURN), (0x607B, 2, TURN), (0x60A4, 1, 77_000), (0x60D0, 2, 6)):
        master.put(index, value, sub)
        assert master.get(index, sub) == value
    for index, value in ((0x6086, 3), (0x60A3, 1), (0x60F2, 0xC2)):
        master.put(index, value)
        assert master.get(index) == value
    for index, value in ((0x6086, 2), (0x60A3, 2), (0x60F2, 0x100)):
        assert master.refuses(index, value) == 0x0609_0030
    assert master.refuses(0x60D0, 3, 1) == 0x0609_0030
    assert [master.get(index, 1) for index in (0x60E6, 0x60EB, 0x60E8, 0x60ED)] == [TURN, 1, 1, 1]
    assert master.refuses(0x60E6, 1, 1) == 0x0601_0002


def test_a_jerk_limited_move_the_short_way_is_caught_by_a_probe(master: DriveMaster) -> None:
    master.put(0x607B, TURN, 2)
    master.put(0x60F2, 0xC0)
    master.put(0x6086, 3)
    for index, value in ((0x6081, 480_000), (0x6083, 4800), (0x6084, 4800)):
        master.put(index, value)
    master.put(0x60D0, 2, 1)
    master.enable(1)
    master.put(0x60B8, 0x19)
    master.put(0x607A, 62_000)
    master.put(0x6040, 0x1F)
    master.wait_ms(1500)
    assert master.get(0x6041) & 0x400
    assert master.get(0x6064) == pytest.approx(62_000, abs=NEAR)
    assert master.get(0x6063) == pytest.approx(62_000 - TURN, abs=NEAR)
    master.put(0x2110, 2, 11)
    assert master.get(0x60B9) == 3
    assert master.get(0x60BA) == pytest.approx(62_000, abs=NEAR)


def test_both_encoders_are_in_one_pdo_while_the_shaft_turns(master: DriveMaster) -> None:
    master.put(0x607B, TURN, 2)
    pdo = master.node.tpdo[3]
    master.node.tpdo.read()
    pdo.clear()
    pdo.add_variable(0x6064)
    pdo.add_variable(0x60E4, 1)
    pdo.trans_type, pdo.enabled = 1, True
    pdo.save()
    master.node.nmt.state = "OPERATIONAL"
    master.enable(3)
    master.put(0x60FF, 300_000)
    seen = []
    for _ in range(40):
        master.wait_ms(25)
        master.network.sync.transmit()
        seen.append((pdo[0].raw, pdo[1].raw))
    assert all(0 <= one < TURN for pair in seen for one in pair)
    assert max(first for first, _ in seen) - min(first for first, _ in seen) > 0.7 * TURN
    assert all((first - second + NEAR) % TURN < 2 * NEAR for first, second in seen)
    assert master.get(0x60E5, 1) == pytest.approx(300_000, rel=0.01)
