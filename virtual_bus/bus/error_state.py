"""Where a controller stands in the fault confinement of ISO 11898-1 (Bosch CAN 2.0, part B, 8)."""

from enum import Enum

PASSIVE_FROM = 128
"""Either counter at this value makes a controller error passive (rule 9)."""
BUS_OFF_FROM = 256
"""The transmit error counter at this value takes it off the bus (rule 11)."""
PASSIVE_RECEIVER_AFTER_SUCCESS = 119
"""What a good frame leaves of a receive error counter above 127: rule 8 allows 119 to 127."""
RECOVERY_SEQUENCES = 128
"""How often 11 consecutive recessive bits must have been seen to come back (rule 12)."""
RECOVERY_SEQUENCE_BITS = 11
SUSPEND_BITS = 8
"""What an error passive transmitter adds to the intermission (Bosch CAN 2.0, part B, 3.2.5)."""


class ErrorState(Enum):
    """Error active, error passive or bus-off."""

    ACTIVE = "error active"
    PASSIVE = "error passive"
    BUS_OFF = "bus-off"


def error_state(transmit_errors: int, receive_errors: int) -> ErrorState:
    """The state that the two counters make (rules 9 to 11)."""
    if transmit_errors >= BUS_OFF_FROM:
        return ErrorState.BUS_OFF
    if transmit_errors >= PASSIVE_FROM or receive_errors >= PASSIVE_FROM:
        return ErrorState.PASSIVE
    return ErrorState.ACTIVE


def after_reception(receive_errors: int) -> int:
    """The receive error counter after a good frame (rule 8)."""
    if receive_errors >= PASSIVE_FROM:
        return PASSIVE_RECEIVER_AFTER_SUCCESS
    return max(receive_errors - 1, 0)
