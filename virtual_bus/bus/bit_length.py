"""A classical CAN frame on the wire: its arbitration field, and its length with all stuff bits.

ISO 11898-1 (in Bosch's CAN 2.0, part B: 3.2.1 and 3.2.2 frames and CRC sequence with the
polynomial 0x4599, 3.2.5 intermission, 6 bit stuffing: from start of frame to the end of the
CRC sequence a bit of opposite value after five equal ones, itself counted towards the next five).
"""

from collections.abc import Callable
from types import FunctionType
from typing import Final, cast

from mypy_extensions import i64

from drivers.timebase import NS_PER_S, Duration
from virtual_bus.frame import Frame


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


TAIL_BITS: Final = 10
"""CRC delimiter, ACK slot, ACK delimiter and seven bits of end of frame: never stuffed."""
INTERMISSION_BITS: Final = 3
"""Recessive bits between the end of a frame and the next start of frame."""
LONGEST_FRAME_BITS: Final = 157
"""Extended, eight data bytes, as many stuff bits as there can be: 118 + 29 + 10."""

_CRC_BITS: Final = 15
_STANDARD_HEAD_BITS: Final = 19
"""Start of frame, identifier, RTR, IDE, r0, DLC."""
_EXTENDED_HEAD_BITS: Final = 39
"""Start of frame, base, SRR, IDE, extension, RTR, r1, r0, DLC."""


def _crc_table() -> list[int]:
    """[256]: what the eight bits that leave the CRC register, combined with a byte, leave in it."""
    table = []
    for byte in range(256):
        register = byte << 7
        for _ in range(8):
            register = (register << 1 ^ 0x4599 if register & 0x4000 else register << 1) & 0x7FFF
        table.append(register)
    return table


def _stuffing_table() -> list[int]:
    """[8 * 256]: state << 8 | next byte -> next state | stuff bits in between << 3.

    A state is (length of the run of equal bits - 1) << 1 | their value; a run of five ends in
    its stuff bit, so that lengths are 1 to 4.
    """
    table = []
    for state in range(8):
        for byte in range(256):
            run, last, stuffed = (state >> 1) + 1, state & 1, 0
            for position in range(7, -1, -1):
                bit = byte >> position & 1
                run, last = (run + 1, bit) if bit == last else (1, bit)
                if run == 5:
                    run, last, stuffed = 1, 1 - bit, stuffed + 1
            table.append((run - 1) << 1 | last | stuffed << 3)
    return table


_CRC: Final = _crc_table()
_STUFFING: Final = _stuffing_table()


def _count_bits(field: i64, data: bytes) -> i64:
    """See :func:`wire_bits`.

    Whole bytes pass through the tables. The head is filled up in front: with zeros for the
    CRC, which leading zeros do not change; with alternating bits for the stuffing, which end
    in the recessive level of the idle bus and never make a run.
    """
    crc_table = _CRC
    stuffing = _STUFFING
    dlc: i64 = field & 0xF
    crc: i64 = 0
    state: i64 = 0
    stuffed: i64 = 0
    step: i64 = 0
    byte: i64 = 0
    remote: i64 = 0
    head: i64 = 0
    head_bits: i64 = _STANDARD_HEAD_BITS
    shift: i64 = 16
    filling: i64 = 0b1010_1000
    if field >> 23 & 1:  # IDE
        remote = field >> 4 & 1
        head_bits = _EXTENDED_HEAD_BITS
        head = field >> 4 << 6 | dlc
        shift = 32
        filling = 0b1000_0000
    else:
        remote = field >> 24 & 1
        head = field >> 23 << 5 | dlc
    while shift >= 0:
        byte = head >> shift & 0xFF
        crc = crc << 8 & 0x7FFF ^ crc_table[crc >> 7 ^ byte]
        step = stuffing[state << 8 | byte | filling]
        state = step & 7
        stuffed += step >> 3
        filling = 0
        shift -= 8
    length: i64 = 0 if remote else dlc
    for place in range(length):
        byte = data[place]
        crc = crc << 8 & 0x7FFF ^ crc_table[crc >> 7 ^ byte]
        step = stuffing[state << 8 | byte]
        state = step & 7
        stuffed += step >> 3
    tail: i64 = crc << 1 | (~crc & 1)  # filled up to two bytes behind, with a bit that makes no run
    step = stuffing[state << 8 | tail >> 8]
    stuffed += step >> 3
    stuffed += stuffing[(step & 7) << 8 | tail & 0xFF] >> 3
    return head_bits + 8 * length + _CRC_BITS + stuffed + TAIL_BITS


def _by_numba() -> Callable[[int, bytes], int]:
    """The same function for numba, which wants its tables as arrays.

    Where mypyc has compiled this module, a broker or a host without it starts a quarter of a second sooner.
    """
    import numpy as np

    from design.kept_code import kept

    tables = {"_CRC": np.array(_CRC), "_STUFFING": np.array(_STUFFING)}
    function = FunctionType(_count_bits.__code__, {**globals(), **tables}, "_count_bits")
    return kept(cast("Callable[[int, bytes], int]", function))


_COMPILED: Final[bool] = not isinstance(_count_bits, FunctionType)
_numba_count: Final = _count_bits if _COMPILED else _by_numba()
"""Where mypyc has not compiled this module, numba does."""


def wire_bits(field: int, data: bytes) -> int:
    """Bits from start of frame to end of frame.

    ``field`` is the arbitration key (virtual_bus.bus.bit_length) and below it the four bits of the DLC.
    """
    return _count_bits(field, data) if _COMPILED else _numba_count(field, data)


def frame_bits(frame: Frame) -> int:
    """Bits of ``frame`` from start of frame to the last bit of end of frame, without intermission."""
    data = frame.data
    dlc = frame.remote_length if frame.remote else len(data)
    return wire_bits(arbitration_key(frame) << 4 | dlc, data)


def bits_duration(bits: int, bitrate_bit_s: int) -> Duration:
    """Time of ``bits`` bits, rounded up to the next ns."""
    return Duration(-(-bits * NS_PER_S // bitrate_bit_s))
