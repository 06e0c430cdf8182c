"""Which of several frames wins the bus."""

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
