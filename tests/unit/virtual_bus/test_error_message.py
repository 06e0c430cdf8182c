"""Error frames against the classes, bits and places of linux/can/error.h."""

import can
import pytest

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.controller import CanController, ErrorState
from servobench.virtual_bus.bus.disturbance import BusError, ErrorKind
from servobench.virtual_bus.bus.error_message import bus_state, error_frame_of, told_bus_off
from servobench.virtual_bus.frame import Frame

CLASSES = {
    "lost arbitration": 0x2, "controller": 0x4, "protocol": 0x8, "transceiver": 0x10, "no acknowledge": 0x20,
    "bus-off": 0x40, "bus error": 0x80, "restarted": 0x100, "counters": 0x200,
}  # fmt: skip
STATUS = {
    "receive overflow": 0x1, "transmit overflow": 0x2, "receive warning": 0x4, "transmit warning": 0x8,
    "receive passive": 0x10, "transmit passive": 0x20, "active": 0x40,
}  # fmt: skip
WRONG = {"bit": 0x1, "form": 0x2, "stuff": 0x4, "dominant bit": 0x8, "recessive bit": 0x10, "overload": 0x20}
PLACES = {"CRC sequence": 0x8, "acknowledge slot": 0x19}
EVERY_FRAME = {"bus error", "counters"}


def told(
    kind: ErrorKind, transmit: int = 0, receive: int = 0, state: ErrorState = ErrorState.ACTIVE
) -> Frame:
    controller = CanController(1_000_000)
    controller.transmit_errors, controller.receive_errors, controller.state = transmit, receive, state
    return error_frame_of(BusError(Instant(7), kind, "drive", Frame(0x181, b""), 12, 40), controller)


def words(bits: int, names: dict[str, int]) -> set[str]:
    named = {name for name, bit in names.items() if bits & bit}
    assert sum(names[name] for name in named) == bits
    return named


@pytest.mark.parametrize(
    ("kind", "classes", "wrong", "place"),
    [
        (ErrorKind.BIT, {"protocol"}, {"bit"}, 0),
        (ErrorKind.FORM, {"protocol"}, {"form"}, 0),
        (ErrorKind.STUFF, {"protocol"}, {"stuff"}, 0),
        (ErrorKind.CRC, {"protocol"}, set(), PLACES["CRC sequence"]),
        (ErrorKind.ACKNOWLEDGEMENT, {"no acknowledge"}, set(), PLACES["acknowledge slot"]),
        (ErrorKind.CUT_OFF, {"protocol"}, set(), 0),
    ],
)
def test_what_went_wrong(kind: ErrorKind, classes: set[str], wrong: set[str], place: int) -> None:
    frame = told(kind)
    assert frame.can_id & 0x20000000, "CAN_ERR_FLAG"
    assert words(frame.can_id & 0x1FFFFFFF, CLASSES) == EVERY_FRAME | classes
    assert len(frame.data) == 8
    assert words(frame.data[2], WRONG) == wrong
    assert (frame.data[0], frame.data[1], *frame.data[3:]) == (0, 0, place, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("transmit", "receive", "status"),
    [
        (95, 95, set()),
        (96, 0, {"transmit warning"}),
        (0, 96, {"receive warning"}),
        (127, 127, {"transmit warning", "receive warning"}),
        (128, 0, {"transmit passive"}),
        (0, 128, {"receive passive"}),
        (96, 200, {"transmit warning", "receive passive"}),
    ],
)
def test_the_controller_s_counters(transmit: int, receive: int, status: set[str]) -> None:
    frame = told(ErrorKind.BIT, transmit, receive)
    assert words(frame.data[1], STATUS) == status
    assert ("controller" in words(frame.can_id & 0x1FFFFFFF, CLASSES)) == bool(status)
    assert tuple(frame.data[6:]) == (transmit, receive)


def test_bus_off_is_a_class_and_its_counter_fits_a_byte() -> None:
    frame = told(ErrorKind.BIT, 256, 300, ErrorState.BUS_OFF)
    assert "bus-off" in words(frame.can_id & 0x1FFFFFFF, CLASSES)
    assert tuple(frame.data[6:]) == (255, 255)
    for state in (ErrorState.ACTIVE, ErrorState.PASSIVE):
        assert "bus-off" not in words(told(ErrorKind.BIT, state=state).can_id & 0x1FFFFFFF, CLASSES)


def test_who_listens_is_told_of_bus_off_and_of_its_end() -> None:
    assert told_bus_off(CLASSES["bus-off"] | CLASSES["counters"]) is True
    assert told_bus_off(CLASSES["restarted"]) is False
    for name in set(CLASSES) - {"bus-off", "restarted"}:
        assert told_bus_off(CLASSES[name]) is None


def test_states_in_python_can_s_words() -> None:
    assert bus_state(ErrorState.ACTIVE) is can.BusState.ACTIVE
    assert bus_state(ErrorState.PASSIVE) is can.BusState.PASSIVE
    assert bus_state(ErrorState.BUS_OFF) is can.BusState.ERROR
