"""CANopen's predefined connection set, CiA 301 7.3.5: which identifier means what; and COB-IDs in objects."""

from typing import Final

from servobench.drivers.canopen.error_codes import error_text
from servobench.drivers.wire.frame_port import ERROR_FLAG, STANDARD_ID_MAX

NMT: Final = 0x000
SYNC: Final = 0x080
TIME: Final = 0x100
LSS_ANSWER: Final = 0x7E4
LSS_REQUEST: Final = 0x7E5

# A service of one node: its node id is added.
EMERGENCY: Final = 0x080
SDO_ANSWER: Final = 0x580
SDO_REQUEST: Final = 0x600
ERROR_CONTROL: Final = 0x700
"""Boot-up, heartbeat, node guarding."""

NODE_BITS: Final = 0x07F
"""Bits of an identifier that hold the node id; the others are the function code."""
BROADCASTS: Final = {
    NMT: "NMT command",
    SYNC: "SYNC",
    TIME: "TIME",
    LSS_ANSWER: "LSS answer",
    LSS_REQUEST: "LSS request",
}
TPDOS: Final = {0x180: "TPDO1", 0x280: "TPDO2", 0x380: "TPDO3", 0x480: "TPDO4"}
RPDOS: Final = {0x200: "RPDO1", 0x300: "RPDO2", 0x400: "RPDO3", 0x500: "RPDO4"}
SENT_BY_NODES: Final = TPDOS | {EMERGENCY: "EMCY", SDO_ANSWER: "SDO answer", ERROR_CONTROL: "heartbeat"}
SERVICES: Final = SENT_BY_NODES | RPDOS | {SDO_REQUEST: "SDO request"}
"""Services by function code."""

# A COB-ID as an object holds it (CiA 301 7.5.2.5, 7.5.2.17, 7.5.2.35, 7.5.2.37).
NOT_VALID: Final = 1 << 31
NO_RTR: Final = 1 << 30
"""Bit of a TPDO's COB-ID; reserved in an RPDO."""
EXTENDED: Final = 1 << 29
CAN_ID: Final = 0x7FF

_RESTRICTED: Final = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)
"""NMT, reserved, TIME's and TPDO's neighbours, default SDO, reserved, NMT error control, reserved."""


def restricted(can_id: int) -> bool:
    """Return True if no SYNC, TIME, EMCY, PDO or SDO may be configured to this CAN-ID (CiA 301, 7.3.5, table
    40)."""
    return any(can_id in ids for ids in _RESTRICTED)


_EMCY_CODE_BYTES = 2


def frame_name(can_id: int, data: bytes = b"") -> str:
    """Describe a frame, e.g. ``EMCY of node 1, 4310h excess temperature of the drive``."""
    if can_id in BROADCASTS:
        return BROADCASTS[can_id]
    if can_id & ERROR_FLAG:
        return "error frame"
    service, node = SERVICES.get(can_id & ~NODE_BITS), can_id & NODE_BITS
    if service is None or not node or can_id > STANDARD_ID_MAX:
        return "no identifier of CANopen"
    if service == "EMCY" and len(data) >= _EMCY_CODE_BYTES:
        code = int.from_bytes(data[:_EMCY_CODE_BYTES], "little")
        return f"EMCY of node {node}, {code:04X}h {error_text(code)}"
    return f"{service} of node {node}"
