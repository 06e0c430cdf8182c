"""What a client of a hub may ask of its own controller.

Real time, as this is what is tested; every wait is bounded by a deadline and ends as soon as it may.
"""

import can
import pytest

from servobench.drivers.timebase import MonotonicClock, instant_after
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.hub import HubBus
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.hub_processes import join

PATIENCE_S = 10.0
CLOCK = MonotonicClock()


def test_a_client_takes_itself_off_the_bus_and_comes_back(buses: list[HubBus]) -> None:
    one, other = join(buses), join(buses)
    assert one.status().error_state is ErrorState.ACTIVE
    assert one.go_bus_off().error_state is ErrorState.BUS_OFF
    assert one.state is can.BusState.ERROR
    with pytest.raises(can.CanOperationError, match="bus-off"):
        one.frame_port.transmit(Frame(0x123))
    other.frame_port.transmit(Frame(0x100))
    assert one.recv(0.05) is None
    one.recover()
    deadline = instant_after(CLOCK.now(), PATIENCE_S)
    while one.status().error_state is ErrorState.BUS_OFF:
        assert CLOCK.now() < deadline
    assert one.state.name == "ACTIVE"
    one.frame_port.transmit(Frame(0x124))
    message = other.recv(PATIENCE_S)
    assert message is not None
    assert message.arbitration_id == 0x124


def test_an_unplugged_client_hears_nothing_and_sends_once_it_is_back(buses: list[HubBus]) -> None:
    one, other, third = join(buses), join(buses), join(buses)
    assert not one.unplug().plugged
    one.frame_port.transmit(Frame(0x123))
    other.frame_port.transmit(Frame(0x100))
    heard = third.recv(PATIENCE_S)
    assert heard is not None
    assert heard.arbitration_id == 0x100
    assert one.recv(0.05) is None
    assert one.plug().plugged
    message = other.recv(PATIENCE_S)
    assert message is not None
    assert message.arbitration_id == 0x123


def test_a_listener_keeps_what_it_has_to_say(buses: list[HubBus]) -> None:
    one, other = join(buses), join(buses)
    assert one.set_listen_only(True).listen_only
    one.frame_port.transmit(Frame(0x123))
    other.frame_port.transmit(Frame(0x100))
    heard = one.recv(PATIENCE_S)
    assert heard is not None
    assert heard.arbitration_id == 0x100
    assert other.recv(0.05) is None
    one.set_listen_only(False)
    assert other.recv(PATIENCE_S) is not None


def test_frames_that_come_before_an_answer_are_kept(buses: list[HubBus]) -> None:
    one, other = join(buses), join(buses)
    for number in range(20):
        other.frame_port.transmit(Frame(0x100 + number))
    deadline = instant_after(CLOCK.now(), PATIENCE_S)
    while one.status().frames < 20:
        assert CLOCK.now() < deadline
    got = [one.recv(PATIENCE_S) for _ in range(20)]
    assert [message and message.arbitration_id for message in got] == [0x100 + n for n in range(20)]
    assert one.status().load_percent <= 100
