"""NMT, TIME, EMCY and error control in words (CiA 301 7.2.6 to 7.2.8); LSS (CiA 305)."""

from datetime import UTC, datetime, timedelta
from typing import Final

from servobench.drivers.canopen.error_codes import fault_text
from servobench.drivers.canopen.lss import SCAN_RESET
from servobench.drivers.canopen.nmt import parse_emergency
from servobench.drivers.canopen.nmt_states import UNCONFIGURED, NmtCommand, NmtState
from servobench.drivers.timebase import Instant

_EPOCH: Final = datetime(1984, 1, 1, tzinfo=UTC)
"""TIME_OF_DAY counts its days from here (CiA 301 7.1.6.6)."""
_TIME_BYTES: Final = 6
_PARTS: Final = ("vendor-ID", "product code", "revision number", "serial number")
_IDENTIFY: Final = (
    "vendor-ID", "product code", "lowest revision", "highest revision", "lowest serial", "highest serial",
)  # fmt: skip
_BIT_RATES_KBIT_S: Final = (1000, 800, 500, 250, 125, None, 50, 20, 10)
"""Table 0 of CiA 305 by index; 9: found by the device itself."""
_DETECTED: Final = 9
_OTHER_ERROR: Final = 0xFF
_CONFIRMED: Final = {
    0x11: {1: "node-ID out of range"},
    0x13: {1: "bit timing not supported"},
    0x17: {1: "storing not supported", 2: "storage medium does not answer"},
}


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


def lss_text(data: bytes, answer: bool) -> str:
    """A frame of the master, or of a slave if ``answer``."""
    if len(data) != 8:
        return f"LSS of {len(data)} bytes; it has 8"
    command, number = data[0], int.from_bytes(data[1:5], "little")
    if command == 0x04:
        states = {0: "waiting", 1: "configuration"}
        return f"switch all to state {states.get(data[1], data[1])}"
    if 0x40 <= command <= 0x43:
        return f"select {_PARTS[command - 0x40]} {number:08X}h"
    if 0x46 <= command <= 0x4B:
        return f"identify {_IDENTIFY[command - 0x46]} {number:08X}h"
    if 0x5A <= command <= 0x5D:
        return f"{_PARTS[command - 0x5A]} is {number:08X}h" if answer else f"ask {_PARTS[command - 0x5A]}"
    if command == 0x51:
        return _fast_scan(data, number)
    if command in _CONFIRMED and answer:
        return _confirmation(data)
    return _plain(data, answer)


def _fast_scan(data: bytes, number: int) -> str:
    bit, part, following = data[5], data[6], data[7]
    if bit == SCAN_RESET:
        return "fast scan: is anybody without node-ID?"
    name = _PARTS[part] if part < len(_PARTS) else f"part {part}"
    then = f", then {_PARTS[following]}" if following < len(_PARTS) and following != part else ""
    return f"fast scan: {name} {number:08X}h down to bit {bit}{then}"


def _confirmation(data: bytes) -> str:
    what = {0x11: "node-ID", 0x13: "bit timing", 0x17: "store"}[data[0]]
    if not data[1]:
        return f"{what}: done"
    reason = _CONFIRMED[data[0]].get(data[1], f"error {data[1]}")
    return f"{what}: refused, " + (f"error {data[2]} of the maker" if data[1] == _OTHER_ERROR else reason)


def _plain(data: bytes, answer: bool) -> str:
    command, value = data[0], data[1]
    if command == 0x11:
        return "configure no node-ID" if value == UNCONFIGURED else f"configure node-ID {value}"
    if command == 0x13:
        return f"configure bit timing: table {value}, {_bit_rate(value, data[2])}"
    if command == 0x15:
        return f"activate bit timing after {value | data[2] << 8} ms"
    if command == 0x5E:
        return f"node-ID is {value}" if answer else "ask node-ID"
    texts = {
        0x17: "store configuration",
        0x44: "selected",
        0x4C: "is anybody without node-ID?",
        0x4F: "identified",
        0x50: "here is one without node-ID",
    }
    return texts.get(command, f"command {command:02X}h")


def _bit_rate(table: int, index: int) -> str:
    if table == 0 and index == _DETECTED:
        return "found by the device"
    rate = _BIT_RATES_KBIT_S[index] if table == 0 and index < len(_BIT_RATES_KBIT_S) else None
    return f"index {index}" if rate is None else f"{rate} kbit/s"
