"""A classical CAN frame on the wire: its arbitration field, and its length with all stuff bits.

ISO 11898-1 (in Bosch's CAN 2.0, part B: 3.2.1 frames, 3.2.5 intermission); core/wire_bits.c counts them.
"""

from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.virtual_bus.core.native import INTERMISSION_BITS as INTERMISSION_BITS
from servobench.virtual_bus.core.native import LONGEST_FRAME_BITS as LONGEST_FRAME_BITS
from servobench.virtual_bus.core.native import wire_bits
from servobench.virtual_bus.frame import Frame


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
