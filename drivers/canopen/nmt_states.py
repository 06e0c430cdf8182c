"""States and commands of NMT, and the range of node-IDs (CiA 301 7.2.8, CiA 305)."""

from enum import IntEnum
from typing import Final

NODE_ID_MAX: Final = 127

UNCONFIGURED: Final = 255
"""Node-ID of a device that has none yet and waits for LSS (CiA 305)."""


class NmtCommand(IntEnum):
    """Command specifiers of NMT node control, CiA 301 7.2.8.3.1."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """States by their number in heartbeat and node guarding, CiA 301 7.2.8.3.2."""

    INITIALISING = 0x00
    """Shown by the boot-up message, which ends it."""
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F
