"""NMT, TIME, EMCY, error control and error frames in words (CiA 301 7.2.6 to 7.2.8, linux/can/error.h)."""

from datetime import UTC, datetime, timedelta
from typing import Final

from drivers.canopen.error_codes import fault_text
from drivers.canopen.nmt import parse_emergency
from drivers.canopen.nmt_states import NmtCommand, NmtState
from drivers.timebase import Instant

_EPOCH: Final = datetime(1984, 1, 1, tzinfo=UTC)
"""TIME_OF_DAY counts its days from here (CiA 301 7.1.6.6)."""
_CLASSES: Final = {
    0x001: "transmission timed out",
    0x002: "arbitration lost",
    0x004: "controller",
    0x008: "protocol violation",
    0x010: "transceiver",
    0x020: "no acknowledgement",
    0x040: "bus-off",
    0x080: "bus error",
    0x100: "controller restarted",
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
_CRC_SEQUENCE: Final = 0x08
_COUNTERS: Final = 0x200
_TIME_BYTES: Final = 6


def nmt_text(data: bytes) -> tuple[int | None, str]:
    """The node that is meant, None for all, and the command."""
    if len(data) != 2:
        return None, f"NMT command of {len(data)} bytes; it has 2"
    known = data[0] in NmtCommand.__members__.values()
    command = NmtCommand(data[0]).name.lower().replace("_", " ") if known else f"command {data[0]:02X}h"
    return data[1] or None, f"{command}, {f'node {data[1]}' if data[1] else 'all nodes'}"


def time_text(data: bytes) -> str:
    """TIME_OF_DAY as a date."""
    if len(data) != _TIME_BYTES:
        return f"TIME of {len(data)} bytes; it has 6"
    ms, days = int.from_bytes(data[:4], "little") & 0x0FFF_FFFF, int.from_bytes(data[4:], "little")
    return (_EPOCH + timedelta(days=days, milliseconds=ms)).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]


def emergency_text(node: int, data: bytes, make: tuple[int, str]) -> str:
    """An EMCY with the words of the drive's maker."""
    emergency = parse_emergency(node, data, Instant(0))
    if emergency is None:
        code = int.from_bytes(data[:2], "little")
        return f"EMCY of {len(data)} bytes; it has 8" + (
            f": {code:04X}h ({fault_text(code, *make)})" if len(data) >= 2 else ""
        )
    return emergency.told(*make)


def error_control_text(data: bytes, guarded: bool) -> tuple[str, str]:
    """Kind of the entry, heartbeat or guarding, and the state that is told."""
    if len(data) != 1:
        return "heartbeat", f"error control of {len(data)} bytes; it has 1"
    number, toggle = data[0] & 0x7F, data[0] >> 7
    known = number in NmtState.__members__.values()
    state = NmtState(number).name.lower().replace("_", "-") if known else f"state {number:02X}h"
    if guarded or toggle:
        return "guarding", f"{state}, toggle {toggle}"
    return "heartbeat", "boot-up" if number == NmtState.INITIALISING else state


def error_frame_text(classes: int, data: bytes) -> str:
    """An error frame as SocketCAN tells it."""
    data = data.ljust(8, b"\0")
    told = [text for bit, text in _CLASSES.items() if classes & bit]
    details = [text for bit, text in _CONTROLLER.items() if classes & 0x04 and data[1] & bit]
    details += [text for bit, text in _PROTOCOL.items() if classes & 0x08 and data[2] & bit]
    if classes & 0x08 and data[3] == _CRC_SEQUENCE:
        details.append("in the CRC sequence")
    if classes & _COUNTERS:
        details.append(f"counters: transmit {data[6]}, receive {data[7]}")
    text = ", ".join(told) or "no class of error"
    return f"{text} ({', '.join(details)})" if details else text
