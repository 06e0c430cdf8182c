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


def instants(commands: list[SentCommand]) -> list[int | None]:
    return [command.on_bus_at for command in commands]


def test_each_echo_finds_its_command(rig: Rig) -> None:
    commands = rig.send(10, 20, 30)
    for place in range(3):
        rig.echo(place, 100 + place)
    assert instants(commands) == [100, 101, 102]
    assert [(command.sequence, command.raw) for command in commands] == [(0, 10), (1, 20), (2, 30)]


def test_a_command_that_never_came_to_the_bus_has_no_instant(rig: Rig) -> None:
    commands = rig.send(10, 20, 30)
    rig.echo(0, 100)
    rig.echo(2, 102)
    assert instants(commands) == [100, None, 102]


def test_a_lost_command_is_not_found_again_by_a_later_one_of_its_value(rig: Rig) -> None:
    commands = rig.send(10, 20, 30, 20)
    for place in (0, 2, 3):
        rig.echo(place, 100 + place)
    assert instants(commands) == [100, None, 102, 103]


def test_frames_that_overtake_each_other_are_found(rig: Rig) -> None:
    commands = rig.send(10, 20, 30)
    for place in (2, 0, 1):
        rig.echo(place, 100 + place)
    assert instants(commands) == [100, 101, 102]


def test_of_equal_commands_the_first_is_found_first(rig: Rig) -> None:
    commands = rig.send(10, 10, 10)
    rig.echo(0, 100)
    rig.echo(1, 200)
    assert instants(commands) == [100, 200, None]


def test_of_equal_commands_that_wait_or_were_overtaken_each_may_be_the_one(rig: Rig) -> None:
    commands = rig.send(10, 20, 10, 30, 10)
    rig.echo(1, 100)
    rig.echo(2, 200)
    assert instants(commands) == [None, 100, 200, None, None]
    assert [command.maybe_at for command in commands] == [200, None, None, None, 200]
    rig.echo(4, 300)
    assert [command.maybe_at for command in commands] == [200, None, None, None, 200], "the first counts"


def test_an_echo_that_tells_when_its_frame_was_handed_over_is_of_no_other(rig: Rig) -> None:
    commands = []
    for _ in range(3):
        commands += rig.send(10)
        rig.network.clock.sleep_until(Instant(rig.network.clock.now() + 1))
    rig.echo(0, 100, handed_at=commands[2].handed_at)
    rig.echo(0, 200, handed_at=commands[0].handed_at)
    rig.echo(0, 300, handed_at=Instant(commands[2].handed_at + 1))
    assert instants(commands) == [200, None, 100]


def test_an_echo_of_what_is_no_command_is_passed_over(rig: Rig) -> None:
    commands = rig.send(10)
    rig.network.frame_pump.echo_handlers[TORQUE](b"other", Instant(1), UNTOLD)
    rig.echo(0, 2, can_id=VELOCITY)
    assert instants(commands) == [None]


def test_commands_without_echoes_are_not_kept_for_ever(rig: Rig) -> None:
    commands = rig.send(*range(300))
    rig.echo(0, 100)
    assert instants(commands) == [None] * 300
    rig.echo(299, 200)
    assert commands[-1].on_bus_at == 200


def test_what_was_overtaken_long_ago_is_not_looked_for(rig: Rig) -> None:
    commands = rig.send(*range(40))
    rig.echo(39, 200)
    rig.echo(0, 300)
    rig.echo(38, 400)
    assert commands[0].on_bus_at is None
    assert commands[38].on_bus_at == 400


def test_speeds_and_positions_are_commands_too(rig: Rig) -> None:
    speed = rig.set_point.send_speed(7.0, 1)
    position = rig.set_point.send_position(-3.0, 2)
    assert (speed.raw, position.raw) == (7, -3)
    for can_id, command in ((VELOCITY, speed), (POSITION, position)):
        rig.network.frame_pump.echo_handlers[can_id](rig.bus.sent_to(can_id)[-1], Instant(5), UNTOLD)
        assert command.on_bus_at == 5


def test_a_sync_of_our_own_is_told(rig: Rig) -> None:
    told: list[tuple[Instant, Instant]] = []
    rig.network.frame_pump.echo_handlers[0x080](b"", Instant(1), UNTOLD)
    rig.network.frame_pump.on_sync_echo = lambda *echo: told.append(echo)
    rig.network.frame_pump.echo_handlers[0x080](b"", Instant(4), Instant(2))
    assert told == [(4, 2)]
