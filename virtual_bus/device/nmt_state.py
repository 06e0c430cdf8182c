"""NMT states and node-IDs of a CANopen device."""

from enum import IntEnum
from typing import Final

NODE_ID_MAX: Final = 127

UNCONFIGURED: Final = 255
"""Node-ID of a device that has none yet and waits for LSS (CiA 305)."""


class NmtState(IntEnum):
    """By their number in heartbeat and node guarding (CiA 301, 7.2.8.3.2)."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F
