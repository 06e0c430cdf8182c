"""What an identifier stands for in CANopen's predefined connection set, CiA 301 7.3.5."""

from drivers.canopen.error_codes import error_text

_BROADCASTS = {0x000: "NMT command", 0x080: "SYNC", 0x100: "TIME", 0x7E4: "LSS answer", 0x7E5: "LSS request"}
_SERVICES = {
    0x080: "EMCY",
    0x180: "TPDO1",
    0x200: "RPDO1",
    0x280: "TPDO2",
    0x300: "RPDO2",
    0x380: "TPDO3",
    0x400: "RPDO3",
    0x480: "TPDO4",
    0x500: "RPDO4",
    0x580: "SDO answer",
    0x600: "SDO request",
    0x700: "heartbeat",
}
_EMCY_CODE_BYTES = 2
_ERROR_FRAME = 0x2000_0000
"""CAN_ERR_FLAG, by which a log marks an error frame."""


def frame_name(can_id: int, data: bytes = b"") -> str:
    """In words, e.g. ``EMCY of node 1, 4310h excess temperature of the drive``."""
    if can_id in _BROADCASTS:
        return _BROADCASTS[can_id]
    if can_id & _ERROR_FRAME:
        return "error frame"
    service, node = _SERVICES.get(can_id & 0x780), can_id & 0x7F
    if service is None or not node or can_id > 0x7FF:
        return "no identifier of CANopen"
    if service == "EMCY" and len(data) >= _EMCY_CODE_BYTES:
        code = int.from_bytes(data[:_EMCY_CODE_BYTES], "little")
        return f"EMCY of node {node}, {code:04X}h {error_text(code)}"
    return f"{service} of node {node}"
