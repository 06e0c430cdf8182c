"""Error codes that the drive raises by itself (CiA 301 table 26, CiA 402-1)."""

from typing import Final

from virtual_bus.device.application import CommunicationLoss

COMMUNICATION_ERROR: Final = 0x8100
HEARTBEAT_ERROR: Final = 0x8130
LOSS_CODES: dict[CommunicationLoss, int] = {
    CommunicationLoss.HEARTBEAT: HEARTBEAT_ERROR,
    CommunicationLoss.LIFE_GUARDING: HEARTBEAT_ERROR,
    CommunicationLoss.RPDO_DEADLINE: 0x8250,
    CommunicationLoss.BUS_OFF: 0x8140,
}
"""Error code 603Fh by what was lost; the EMCY of it is the device engine's."""

FOLLOWING_ERROR: Final = 0x8611
"""60F4h was outside of 6065h for longer than 6066h."""
