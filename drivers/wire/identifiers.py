"""Identifiers of CAN frames, and the flags beside them in the words of linux/can.h, of logs and of rows."""

from typing import Final

STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF

ERROR_FLAG: Final = 1 << 29
"""CAN_ERR_FLAG. Marks the identifier of an error frame, reported by the adapter."""
REMOTE_FLAG: Final = 1 << 30
"""CAN_RTR_FLAG."""
EXTENDED_FLAG: Final = 1 << 31
"""CAN_EFF_FLAG."""
