"""A classical CAN frame on the wire: its arbitration field, its length with all stuff bits, and its levels.

Levels are made for the attempts that something disturbs. The bits of others are only counted
(core/wire_bits.c), which is far cheaper. ISO 11898-1 (in Bosch's CAN 2.0, part B: 3.2.1 frames, 3.2.5
intermission).
"""

from typing import NamedTuple

from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.virtual_bus.core.native import INTERMISSION_BITS as INTERMISSION_BITS
from servobench.virtual_bus.core.native import LONGEST_FRAME_BITS as LONGEST_FRAME_BITS
from servobench.virtual_bus.core.native import wire_bits
from servobench.virtual_bus.frame import Frame

DOMINANT, RECESSIVE = 0, 1
SAMPLE_POINT = 0.8
"""Where in a bit a node looks at the bus, as part of the bit: between the 75 % and the 87.5 % at which
Linux sets controllers, by their rate (can_calc_bittiming)."""

_CRC_POLYNOMIAL = 0x4599
_TAIL = bytes([RECESSIVE, RECESSIVE, RECESSIVE, *([RECESSIVE] * 7)])
"""CRC delimiter, ACK slot (as its sender drives it), ACK delimiter, end of frame."""


class FrameImage(NamedTuple):
    """The bits driven by a sender from start of frame to end of frame, and the places of the fields."""

    levels: bytes
    """One level a bit: 0 dominant, 1 recessive."""
    stuff_bits: frozenset[int]
    """Places of the stuff bits."""
    arbitration_end: int
    """The first bit behind the arbitration field."""
    delimiter: int
    """Place of the CRC delimiter, behind which nothing is stuffed; -1 if no node can find it."""

    @property
    def acknowledge(self) -> int:
        """Place of the ACK slot."""
        return len(self.levels) - 9

    @property
    def last(self) -> int:
        """Place of the last bit of end of frame."""
        return len(self.levels) - 1


def frame_image(frame: Frame) -> FrameImage:
    """The wire image of ``frame`` as sent by a lone node."""
    fields = _fields(frame)
    fields += _crc(fields)
    contested = 33 if frame.extended else 13
    levels = bytearray()
    stuff_bits = set()
    arbitration_end = run = 0
    last = RECESSIVE
    for place, level in enumerate(fields):
        levels.append(level)
        run = run + 1 if level == last else 1
        last = level
        if run == 5:
            stuff_bits.add(len(levels))
            last = 1 - level
            levels.append(last)
            run = 1
        if place + 1 == contested:
            arbitration_end = len(levels)
    return FrameImage(bytes(levels) + _TAIL, frozenset(stuff_bits), arbitration_end, len(levels))


def resampled(image: FrameImage, rate: float) -> FrameImage:
    """``image`` sent at ``rate`` times the bus's bit rate, as the bus's own nodes sample it.

    They find no field in it: for them it is stuffed to its end.
    """
    length = max(int(len(image.levels) / rate), 1)
    levels = bytes(image.levels[min(int((bit + SAMPLE_POINT) * rate), image.last)] for bit in range(length))
    return FrameImage(levels, frozenset(), int(image.arbitration_end / rate), -1)


def _fields(frame: Frame) -> list[int]:
    """Start of frame to the end of the data, without stuff bits."""
    key = arbitration_key(frame)
    if frame.extended:
        head, width = key << 2, 34  # r1 and r0 dominant
    else:
        head, width = key >> 20 << 2, 14  # IDE and r0 dominant
    dlc = frame.remote_length if frame.remote else len(frame.data)
    number, bits = head << 4 | dlc, 1 + width + 4
    for byte in frame.data:
        number, bits = number << 8 | byte, bits + 8
    return [number >> place & 1 for place in range(bits - 1, -1, -1)]


def _crc(fields: list[int]) -> list[int]:
    register = 0
    for level in fields:
        invert = level ^ register >> 14
        register = register << 1 & 0x7FFF
        if invert:
            register ^= _CRC_POLYNOMIAL
    return [register >> place & 1 for place in range(14, -1, -1)]


def arbitration_key(frame: Frame) -> int:
    """The arbitration field as a number: the smaller one wins, as a dominant bit is a 0.

    Bits in their order on the wire (ISO 11898-1; Bosch CAN 2.0 part B, 3.2.1): 11 bits of
    base identifier, RTR (standard) or SRR (extended, recessive), IDE, then 18 bits of
    identifier extension and RTR. Hence standard before extended of the same base, and data
    before remote of the same identifier.
    """
    can_id, remote = frame.can_id, frame.remote
    if frame.extended:
        return (can_id >> 18) << 21 | 3 << 19 | (can_id & 0x3FFFF) << 1 | remote
    return can_id << 21 | remote << 20


def frame_bits(frame: Frame) -> int:
    """Bits of ``frame`` from start of frame to the last bit of end of frame, without intermission."""
    data = frame.data
    dlc = frame.remote_length if frame.remote else len(data)
    return wire_bits(arbitration_key(frame) << 4 | dlc, data)


def bits_duration(bits: int, bitrate_bit_s: int) -> Duration:
    """Time of ``bits`` bits, rounded up to the next ns."""
    return Duration(-(-bits * NS_PER_S // bitrate_bit_s))
