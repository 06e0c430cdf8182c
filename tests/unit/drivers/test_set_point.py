"""Set-points and the echoes of their frames."""

from collections.abc import Iterator

import pytest

from servobench.drivers.cia402.pdo_planner import all_modes_plan
from servobench.drivers.cia402.scaling import Scaling
from servobench.drivers.cia402.setpoint import SetPointFrames
from servobench.drivers.exchange import SentCommand
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import UNTOLD
from tests.unit.drivers.fake_bus import FakeBus, make_network

TORQUE, POSITION, VELOCITY = 0x201, 0x301, 0x401


class Rig:
    """Torques sent, and the echoes of their frames in whatever order."""

    def __init__(self) -> None:
        self.bus: FakeBus
        self.bus, self.network = make_network()
        plan = all_modes_plan(1)
        self.set_point = SetPointFrames(self.network, plan, Scaling(1.0, 1.0, 1.0, 1.0, 0.001), None)
        self.frames: list[bytes] = []

    def send(self, *torques_raw: int) -> list[SentCommand]:
        commands = [self.set_point.send_torque(0.001 * raw, place) for place, raw in enumerate(torques_raw)]
        self.frames = self.bus.sent_to(TORQUE)[-len(commands) :]
        return commands

    def echo(self, place: int, at: int, can_id: int = TORQUE, handed_at: Instant = UNTOLD) -> None:
        self.network.frame_pump.echo_handlers[can_id](self.frames[place], Instant(at), handed_at)


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.bus.shutdown()


def test_speeds_and_positions_are_commands_too(rig: Rig) -> None:
    speed = rig.set_point.send_speed(7.0, 1)
    position = rig.set_point.send_position(-3.0, 2)
    assert (speed.raw, position.raw) == (7, -3)
    for can_id, command in ((VELOCITY, speed), (POSITION, position)):
        rig.network.frame_pump.echo_handlers[can_id](rig.bus.sent_to(can_id)[-1], Instant(5), UNTOLD)
        assert command.on_bus_at == 5
