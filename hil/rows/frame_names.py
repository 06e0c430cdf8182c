"""Names of identifiers in CANopen's predefined connection set, CiA 301 7.3.5."""

from servobench.drivers.canopen.cob_ids import BROADCASTS, NODE_BITS, SERVICES
from servobench.drivers.canopen.error_codes import error_text
from servobench.drivers.wire.identifiers import ERROR_FLAG, STANDARD_ID_MAX

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
