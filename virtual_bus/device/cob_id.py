"""COB-IDs as the dictionary holds them, and which CAN-IDs may be configured."""

NOT_VALID = 1 << 31
NO_RTR = 1 << 30
EXTENDED = 1 << 29
CAN_ID = 0x7FF

_RESTRICTED = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)
"""NMT, reserved, TIME's and TPDO's neighbours, default SDO, reserved, NMT error control, reserved."""


def restricted(can_id: int) -> bool:
    """Whether no SYNC, TIME, EMCY, PDO or SDO may be configured to this CAN-ID (CiA 301, 7.3.5, table 40)."""
    return any(can_id in ids for ids in _RESTRICTED)
