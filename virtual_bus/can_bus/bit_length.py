"""How many bits a classical CAN frame takes on the wire, stuff bits included.

ISO 11898-1 (in Bosch's CAN 2.0, part B: 3.2.1 and 3.2.2 frames and CRC sequence with the
polynomial 0x4599, 3.2.5 intermission, 6 bit stuffing: from start of frame to the end of the
CRC sequence a bit of opposite value after five equal ones, itself counted towards the next five).
"""

from collections.abc import Callable
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray

from drivers.timebase import NS_PER_S, Duration
from virtual_bus.can_bus.arbitration import arbitration_key
from virtual_bus.frame import Frame

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


def _crc_table() -> NDArray[np.int64]:
    """(256,): what the eight bits that leave the CRC register, combined with a byte, leave in it."""
    table = np.arange(256, dtype=np.int64) << 7
    for _ in range(8):
        table = np.where(table & 0x4000, (table << 1) ^ 0x4599, table << 1) & 0x7FFF
    return table


def _stuffing_table() -> NDArray[np.uint8]:
    """(8, 256): state and next byte -> next state | stuff bits in between << 3.

    A state is (length of the run of equal bits - 1) << 1 | their value; a run of five ends in
    its stuff bit, so that lengths are 1 to 4.
    """
    table = np.zeros((8, 256), dtype=np.uint8)
    for state in range(8):
        for byte in range(256):
            run, last, stuffed = (state >> 1) + 1, state & 1, 0
            for position in range(7, -1, -1):
                bit = byte >> position & 1
                run, last = (run + 1, bit) if bit == last else (1, bit)
                if run == 5:
                    run, last, stuffed = 1, 1 - bit, stuffed + 1
            table[state, byte] = (run - 1) << 1 | last | stuffed << 3
    return table


_CRC: Final = _crc_table()
_STUFFING: Final = _stuffing_table()


def _wire_bits(field: int, data: int) -> int:
    """Bits from start of frame to end of frame.

    ``field`` is the arbitration key (virtual_bus.can_bus.arbitration) and below it the four bits of
    the DLC; ``data`` the data bytes as one number, first byte highest.

    Whole bytes pass through the tables. The head is filled up in front: with zeros for the
    CRC, which leading zeros do not change; with alternating bits for the stuffing, which end
    in the recessive level of the idle bus and never make a run.
    """
    dlc = field & 0xF
    if field >> 23 & 1:  # IDE
        remote = field >> 4 & 1
        head_bits = _EXTENDED_HEAD_BITS
        head = field >> 4 << 6 | dlc
        shift = 32
        filling = 0b1000_0000
    else:
        remote = field >> 24 & 1
        head_bits = _STANDARD_HEAD_BITS
        head = field >> 23 << 5 | dlc
        shift = 16
        filling = 0b1010_1000
    crc = 0
    state = 0
    stuffed = 0
    while shift >= 0:
        byte = head >> shift & 0xFF
        crc = crc << 8 & 0x7FFF ^ _CRC[crc >> 7 ^ byte]
        step = _STUFFING[state, byte | filling]
        state = step & 7
        stuffed += step >> 3
        filling = 0
        shift -= 8
    data_bits = 0 if remote else 8 * dlc
    shift = data_bits - 8
    while shift >= 0:
        byte = data >> shift & 0xFF
        crc = crc << 8 & 0x7FFF ^ _CRC[crc >> 7 ^ byte]
        step = _STUFFING[state, byte]
        state = step & 7
        stuffed += step >> 3
        shift -= 8
    tail = crc << 1 | (~crc & 1)  # filled up to two bytes behind, with a bit that makes no run
    step = _STUFFING[state, tail >> 8]
    stuffed += step >> 3
    stuffed += _STUFFING[step & 7, tail & 0xFF] >> 3
    return int(head_bits + data_bits + _CRC_BITS + stuffed + TAIL_BITS)


wire_bits: Callable[[int, int], int] = numba.njit("int64(int64, uint64)", cache=True)(_wire_bits)
"""Compiled form of the count: arbitration key << 4 | DLC, and the data as one number."""


def frame_bits(frame: Frame) -> int:
    """Bits of ``frame`` from start of frame to the last bit of end of frame, without intermission."""
    data = frame[1]
    dlc = frame.remote_length if frame.remote else len(data)
    return wire_bits(arbitration_key(frame) << 4 | dlc, int.from_bytes(data, "big"))


def bits_duration(bits: int, bitrate_bit_s: int) -> Duration:
    """Time of ``bits`` bits, rounded up to the next ns."""
    return Duration(-(-bits * NS_PER_S // bitrate_bit_s))
