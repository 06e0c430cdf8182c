"""Describes SocketCAN error frames in words (linux/can/error.h): classes in the identifier, details as
data."""

from typing import Final

_BUS_OFF, _RESTARTED, _CONTROLLER_CLASS, _PROTOCOL_CLASS, _NO_ACKNOWLEDGEMENT = (
    0x040,
    0x100,
    0x004,
    0x008,
    0x020,
)
_CLASSES: Final = {
    0x001: "transmission timed out",
    0x002: "arbitration lost",
    _CONTROLLER_CLASS: "controller",
    _PROTOCOL_CLASS: "protocol violation",
    0x010: "transceiver",
    _NO_ACKNOWLEDGEMENT: "no acknowledgement",
    _BUS_OFF: "bus-off",
    0x080: "bus error",
    _RESTARTED: "controller restarted",
}
_CONTROLLER: Final = {
    0x01: "receive overflow",
    0x02: "transmit overflow",
    0x04: "receive warning",
    0x08: "transmit warning",
    0x10: "receive error passive",
    0x20: "transmit error passive",
    0x40: "error active",
}
_PROTOCOL: Final = {
    0x01: "single bit",
    0x02: "form",
    0x04: "stuff",
    0x08: "dominant bit not sent",
    0x10: "recessive bit not sent",
    0x20: "overload",
    0x40: "active error announcement",
    0x80: "while transmitting",
}
_ERROR_PASSIVE: Final = 0x30
_CHECK: Final = "check the cable, its terminations, the bit rates, and that another node is on"
_CRC_SEQUENCE: Final = 0x08
_COUNTERS: Final = 0x200


def error_frame_text(classes: int, data: bytes) -> str:
    """Describe everything in an error frame."""
    data = data.ljust(8, b"\0")
    told = [text for bit, text in _CLASSES.items() if classes & bit]
    details = [text for bit, text in _CONTROLLER.items() if classes & _CONTROLLER_CLASS and data[1] & bit]
    details += [text for bit, text in _PROTOCOL.items() if classes & _PROTOCOL_CLASS and data[2] & bit]
    if classes & _PROTOCOL_CLASS and data[3] == _CRC_SEQUENCE:
        details.append("in the CRC sequence")
    if classes & _COUNTERS:
        details.append(f"counters: transmit {data[6]}, receive {data[7]}")
    text = ", ".join(told) or "no class of error"
    return f"{text} ({', '.join(details)})" if details else text


def controller_state_text(classes: int, data: bytes) -> str:
    """Return the controller state reported by an error frame; empty if it reports none.

    A burst of errors is many error frames and a few states.
    """
    if classes & _BUS_OFF:
        return "is bus-off: it sends and hears nothing until it is restarted"
    if classes & _RESTARTED:
        return "was restarted after bus-off"
    if classes & _CONTROLLER_CLASS and len(data) > 1:
        told = [text for bit, text in _CONTROLLER.items() if data[1] & bit]
        if told:
            return f"tells of its controller: {', '.join(told)}"
    if classes & _NO_ACKNOWLEDGEMENT:
        return "sends what nobody acknowledges: no other node is on, or at another bit rate"
    return ""


def anew_command(name: str) -> str:
    """Return the command that restarts the controller of the interface ``name``."""
    return f"ip link set {name} down; ip link set {name} up"


def controller_cure(classes: int, data: bytes, name: str) -> str:
    """Return the cure for the state that :func:`controller_state_text` reports of the interface ``name``;
    empty if it is sound.

    ``ip link set can0 type can restart`` is refused where restart-ms is set, and by drivers without it, such
    as that of serial adapters; down and up restarts each of them.
    """
    if classes & _BUS_OFF:
        return f"{_CHECK}, then {anew_command(name)}"
    faulty = classes & _CONTROLLER_CLASS and data[1] & _ERROR_PASSIVE
    return _CHECK if faulty or classes & _NO_ACKNOWLEDGEMENT else ""
