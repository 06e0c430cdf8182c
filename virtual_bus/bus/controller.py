"""The CAN controller of one port: its error counters, and where they put it in the fault confinement of
ISO 11898-1 (Bosch CAN 2.0, part B, 8; the rules are cited by their numbers there).
"""

from enum import Enum

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.error_frame import Node

PASSIVE_FROM = 128
"""Either counter at this value makes a controller error passive (rule 9)."""
BUS_OFF_FROM = 256
"""The transmit error counter at this value takes it off the bus (rule 11)."""
PASSIVE_RECEIVER_AFTER_SUCCESS = 119
"""Value of a receive error counter above 127 after a good frame: rule 8 allows 119 to 127."""
RECOVERY_SEQUENCES = 128
"""How often 11 consecutive recessive bits must have been seen to come back (rule 12)."""
RECOVERY_SEQUENCE_BITS = 11
SUSPEND_BITS = 8
"""Addition of an error passive transmitter to the intermission (Bosch CAN 2.0, part B, 3.2.5)."""


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


RECEIVE_ERRORS_MAX = 255
"""Where the receive error counter stops, as in a controller with a counter of eight bits."""


class CanController:
    """Fault confinement of one node (ISO 11898-1)."""

    def __init__(self, bitrate_bit_s: int) -> None:
        self.bitrate_bit_s = bitrate_bit_s
        """That the node is set to, bit/s; right if it is the segment's."""
        self.listen_only = False
        """It never drives the bus: no frame, no acknowledgement, no error flag."""
        self.plugged = True
        """It is on the wire."""
        self.transmit_errors = 0
        """256 stands for bus-off."""
        self.receive_errors = 0
        """At most 255."""
        self.state = ErrorState.ACTIVE
        self.suspended_until = Instant(0)
        """It does not begin to send before this."""
        self.recovery_left = 0
        """Sequences of 11 recessive bits that it has still to see; 0: it does not try to come back."""
        self.recovery_from = Instant(0)
        """Since when it sees the recessive bits that are not yet counted."""

    @property
    def on_bus(self) -> bool:
        """True if it takes part in the bus at all."""
        return self.plugged and self.state is not ErrorState.BUS_OFF

    @property
    def can_send(self) -> bool:
        """True if it may compete for the bus."""
        return self.on_bus and not self.listen_only

    def hears(self, bitrate_bit_s: int) -> bool:
        """Return True if it understands a frame at that rate."""
        return self.on_bus and self.bitrate_bit_s == bitrate_bit_s

    def sent_well(self) -> None:
        """A frame of its own went out (rule 7)."""
        if self.transmit_errors:
            self.transmit_errors -= 1
            self._judge()

    def received_well(self) -> None:
        """A frame of another came in (rule 8)."""
        if self.receive_errors:
            self.receive_errors = after_reception(self.receive_errors)
            self._judge()

    def take(self, node: Node) -> None:
        """Count what it went through as ``node`` of one attempt."""
        self.transmit_errors = min(self.transmit_errors + node.transmit_errors, BUS_OFF_FROM)
        self.receive_errors = min(self.receive_errors + node.receive_errors, RECEIVE_ERRORS_MAX)
        if node.completed:
            self.transmit_errors = max(self.transmit_errors - 1, 0)
        elif node.accepted and not node.receive_errors:
            self.receive_errors = after_reception(self.receive_errors)
        self._judge()

    def force_off(self) -> None:
        """Bus-off, whatever the counters were."""
        self.transmit_errors = BUS_OFF_FROM
        self._judge()

    def come_back(self) -> None:
        """Recovery is complete: error active, with both counters at 0 (rule 12)."""
        self.transmit_errors = self.receive_errors = self.recovery_left = 0
        self._judge()

    def _judge(self) -> None:
        self.state = error_state(self.transmit_errors, self.receive_errors)
