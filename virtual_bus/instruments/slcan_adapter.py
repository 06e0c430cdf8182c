"""A serial CAN adapter without I/O: lines from the host in, answers and received frames out.

Source: Lawicel AB, CAN232 Manual, version 3.0 (February 2010). The table below is its list of commands, with
the state of the CAN channel in which each is allowed; outside of it the answer is BEL.

    Sn sxxyy Xn Wn Mxxxxxxxx mxxxxxxxx Zn    closed     bit rate, BTR0/BTR1, auto poll, filter, time stamps
    O L                                       closed     open, or open to listen only; a bit rate must be set
    C F P A                                   open       close, status flags, poll one, poll all
    t T r R                                   open       send; not while listening only
    V N                                       always     version, serial number

Auto poll is on at power-up, as in the CANUSB and in every later firmware; a CAN232 leaves it off.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.slcan_protocol import (
    BEL,
    BITRATE_CODES,
    CR,
    STAMP_PERIOD_MS,
    LineSplitter,
    SlcanStatus,
    decode_frame,
    encode_frame,
)
from servobench.virtual_bus.frame import Frame

_ALL = 0xFFFF_FFFF


@dataclass(slots=True)
class AcceptanceFilter:
    """The acceptance filter of an SJA1000, which the commands M, m and W set. Lets everything pass at first.

    Source: Philips SJA1000 data sheet (January 2000), 6.4.15: four bytes of acceptance code, four of mask; a
    mask bit of 1 means "does not matter". In dual mode each half is a filter of its own, in single mode all
    four bytes are one. The data bytes that the filters can also look at are left out: here they never matter.
    """

    code: int = 0
    """AC0 in the highest byte, AC3 in the lowest."""
    mask: int = _ALL
    single: bool = False

    def passes(self, frame: Frame) -> bool:
        """Return True if the controller takes ``frame``."""
        if self.mask == _ALL:
            return True
        if self.single:
            if frame.extended:
                seen, width = frame.can_id << 3 | frame.remote << 2, 0xFFFF_FFFC
            else:
                seen, width = frame.can_id << 21 | frame.remote << 20, 0xFFF0_0000
            return not (self.code ^ seen) & ~self.mask & width
        if frame.extended:
            seen, width = frame.can_id >> 13, 0xFFFF
        else:
            seen, width = frame.can_id << 5 | frame.remote << 4, 0xFFF0
        return any(
            not (self.code >> shift ^ seen) & ~(self.mask >> shift) & width & 0xFFFF for shift in (16, 0)
        )


_AUTO_POLL, _STAMPS, _SINGLE, _CODE, _MASK = b"X", b"Z", b"W", b"M", b"m"
"""Commands that set something: 0 or 1, or the acceptance filter's code and mask, of eight digits."""
VERSION, SERIAL_NUMBER = b"V1013", b"NSB01"
POLLED_FRAMES_MAX = 32
"""Frames kept for a host that polls; one more is lost (manual, "P")."""
_BITRATES = {code: bitrate for bitrate, code in BITRATE_CODES.items()}
_BTR_CLOCK_HZ = 8_000_000
"""Half of the 16 MHz of the SJA1000."""


class CanSide(Protocol):
    """The adapter's own CAN controller."""

    def open(self, bitrate_bit_s: int, listen_only: bool) -> None:
        """Take part in the bus."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...

    def send(self, frame: Frame) -> bool:
        """Queue a frame; False if there is no room."""
        ...

    def flags(self) -> SlcanStatus:
        """Return the flags since the last call."""
        ...


class SlcanAdapter:
    """The firmware of one adapter."""

    def __init__(self, can_side: CanSide, refuse: Callable[[], bool] = lambda: False) -> None:
        """``refuse``: asked before each frame to be sent; True: the adapter has no room for it."""
        self.is_open = False
        self.listen_only = False
        self.bitrate_bit_s: int | None = None
        self.frames_sent = 0
        self.refused = 0
        """Lines answered with BEL."""
        self._can = can_side
        self._refuse = refuse
        self._lines = LineSplitter()
        self._flags = SlcanStatus(0)
        self._filter = AcceptanceFilter()
        self._settings = {_AUTO_POLL: 1, _STAMPS: 0, _SINGLE: 0, _CODE: 0, _MASK: 0xFFFF_FFFF}
        self._polled: deque[bytes] = deque()
        self._commands: dict[bytes, Callable[[bytes], bytes | None]] = {
            b"S": self._set_bitrate,
            b"s": self._set_timing,
            b"O": lambda text: self._open(text, listen_only=False),
            b"L": lambda text: self._open(text, listen_only=True),
            b"C": self._close,
            b"F": self._tell_status,
            b"P": lambda text: self._poll(text, at_most=1),
            b"A": lambda text: self._poll(text, at_most=POLLED_FRAMES_MAX),
            b"V": lambda text: VERSION if text == b"V" else None,
            b"N": lambda text: SERIAL_NUMBER if text == b"N" else None,
            **dict.fromkeys((b"t", b"T", b"r", b"R"), self._send),
            **dict.fromkeys(self._settings, self._set),
        }

    def take(self, data: bytes) -> list[bytes]:
        """The answers to what the host sent, each with its terminator."""
        return [self._answer(line.text) for line in self._lines.feed(data) if not line.refused]

    def hear(self, frame: Frame, at: Instant) -> bytes | None:
        """The line for a frame from the bus; None if there is none to send now."""
        if not self.is_open or not self._filter.passes(frame):
            return None
        line = encode_frame(frame, at // NS_PER_MS % STAMP_PERIOD_MS if self._settings[_STAMPS] else None)
        if self._settings[_AUTO_POLL]:
            return line
        if len(self._polled) >= POLLED_FRAMES_MAX:
            self._flags |= SlcanStatus.RECEIVE_FIFO_FULL
        else:
            self._polled.append(line)
        return None

    def raise_flags(self, flags: SlcanStatus) -> None:
        """Something happened that the next status is to tell."""
        self._flags |= flags

    def _answer(self, text: bytes) -> bytes:
        if not text:
            return CR
        command = self._commands.get(text[:1])
        said = command(text) if command is not None else None
        if said is None:
            self.refused += 1
            return BEL
        return said + CR

    def _set_bitrate(self, text: bytes) -> bytes | None:
        code = _digits(text, 1)
        if self.is_open or code not in _BITRATES:
            return None
        self.bitrate_bit_s = _BITRATES[code]
        return b""

    def _set_timing(self, text: bytes) -> bytes | None:
        """BTR0 and BTR1, SJA1000 data sheet 6.5.1 and 6.5.2."""
        registers = _digits(text, 4)
        if self.is_open or registers is None:
            return None
        prescaler = (registers >> 8 & 0x3F) + 1
        quanta = 1 + (registers & 0xF) + 1 + (registers >> 4 & 0x7) + 1
        self.bitrate_bit_s = round(_BTR_CLOCK_HZ / (prescaler * quanta))
        return b""

    def _open(self, text: bytes, *, listen_only: bool) -> bytes | None:
        if self.is_open or self.bitrate_bit_s is None or len(text) != 1:
            return None
        self.is_open, self.listen_only = True, listen_only
        self._flags = SlcanStatus(0)
        self._polled.clear()
        self._can.open(self.bitrate_bit_s, listen_only)
        return b""

    def _close(self, text: bytes) -> bytes | None:
        if not self.is_open or len(text) != 1:
            return None
        self.is_open = False
        self._can.close()
        return b""

    def _tell_status(self, text: bytes) -> bytes | None:
        if not self.is_open or len(text) != 1:
            return None
        flags, self._flags = self._flags | self._can.flags(), SlcanStatus(0)
        return b"F%02X" % flags

    def _poll(self, text: bytes, at_most: int) -> bytes | None:
        """The frames that are waiting, each with a CR; after all of them an ``A`` (manual, "A")."""
        if not self.is_open or self._settings[_AUTO_POLL] or len(text) != 1:
            return None
        count = min(at_most, len(self._polled))
        lines = b"".join(self._polled.popleft() for _ in range(count))
        return lines + b"A" if at_most > 1 else lines.removesuffix(CR)

    def _set(self, text: bytes) -> bytes | None:
        letter = text[:1]
        wide = letter in (_CODE, _MASK)
        value = _digits(text, 8 if wide else 1)
        if self.is_open or value is None or (not wide and value > 1):
            return None
        self._settings[letter] = value
        code, mask, single = (self._settings[each] for each in (_CODE, _MASK, _SINGLE))
        self._filter = AcceptanceFilter(code, mask, bool(single))
        return b""

    def _send(self, text: bytes) -> bytes | None:
        frame = decode_frame(text)
        if not self.is_open or self.listen_only or frame is None:
            return None
        if self._refuse() or not self._can.send(frame):
            self._flags |= SlcanStatus.TRANSMIT_FIFO_FULL
            return None
        self.frames_sent += 1
        if not self._settings[_AUTO_POLL]:
            return b""
        return b"Z" if frame.extended else b"z"


def _digits(text: bytes, count: int) -> int | None:
    """The hexadecimal number behind a command's letter; None if it has not exactly ``count`` digits."""
    if len(text) != 1 + count or not text[1:].isalnum():
        return None
    try:
        return int(text[1:], 16)
    except ValueError:
        return None
