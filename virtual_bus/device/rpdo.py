"""Receive PDOs: immediate (254, 255) or at the next SYNC (0..240), with deadline (CiA 301, 7.2.2)."""

from collections import deque
from typing import Final

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.objects301 import RPDO_COMMUNICATION, RPDO_MAPPING
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.virtual_bus.core.native import CyclicRpdo
from servobench.virtual_bus.device.application import CommunicationLoss
from servobench.virtual_bus.device.emergency import EmergencyProducer
from servobench.virtual_bus.device.pdo_codec import compiled
from servobench.virtual_bus.device.pdo_parameters import PdoParameters
from servobench.virtual_bus.device.station import Handler, Station
from servobench.virtual_bus.frame import Frame

PDO_TOO_SHORT: Final = 0x8210
PDO_TOO_LONG: Final = 0x8220
PDO_DEADLINE: Final = 0x8250
SYNCHRONOUS_TYPE_MAX: Final = 240


class ReceivePdo(PdoParameters):
    """One RPDO. Of a value out of range the variable keeps the one that it has (core/rpdo_type.c)."""

    reserved_types = range(241, 254)
    transmit = False

    def __init__(self, station: Station, emergency: EmergencyProducer, number: int) -> None:
        """``number``: 1.. as in RPDO1."""
        super().__init__(station, RPDO_COMMUNICATION + number - 1, RPDO_MAPPING + number - 1)
        self._emergency = emergency
        self._number = number
        self._listening: int | None = None
        self._deadline = deadline = station.timer(self._on_deadline)
        self._held: deque[tuple[Instant, Frame]] = deque()
        """Frames that the task has not taken in, and when it will."""
        self._holding = station.timer(self._on_due)
        self.reception: Final = CyclicRpdo(
            station.cycle, self._judge_length, deadline, self._deadline_met, compiled([])
        )

    def configure(self) -> None:
        """Take over COB-ID, type, mapping and deadline."""
        if self._listening is not None:
            self.station.ignore(self._listening, self._handler)
            self._listening = None
        self.reception.map(compiled(self.fields()))
        self.reception.synchronous = self.parameter(2) <= SYNCHRONOUS_TYPE_MAX
        self.reception.deadline_ns = Duration(self.parameter(5) * NS_PER_MS)
        self._forget()
        # The deadline counts from the next reception, so a change starts from anew.
        self._deadline.stop()
        if self.exists:
            self._listening = self.can_id
            self.station.listen(self._listening, self._handler)

    def leave_operational(self) -> None:
        """PDOs exist in OPERATIONAL only: forget what waits for a SYNC, and the deadline."""
        self._forget()
        self._deadline.stop()

    @property
    def _handler(self) -> Handler:
        return self.reception if self.station.receiving is None else self._hold

    def _hold(self, frame: Frame, now: Instant) -> None:
        assert self.station.receiving is not None
        self._held.append((self.station.receiving.due(now), frame))
        self._holding.start(self._held[0][0])

    def _on_due(self, now: Instant) -> None:
        while self._held and self._held[0][0] <= now:
            self.reception.take(self._held.popleft()[1], now)
        if self._held:
            self._holding.start(self._held[0][0])

    def _forget(self) -> None:
        """What waits for the task, or for a SYNC, does not take effect."""
        self._held.clear()
        self._holding.stop()
        self.reception.forget_waiting()

    def _judge_length(self, length: int) -> None:
        """8210h: too short, not processed. 8220h: too long, the first bytes are. (CiA 301, table 26)."""
        code, reception = 0, self.reception
        if length != reception.length:
            code = PDO_TOO_SHORT if length < reception.length else PDO_TOO_LONG
        if code == reception.wrong_length:
            return
        if reception.wrong_length:
            self._emergency.clear_error(reception.wrong_length, self._number)
        reception.wrong_length = code
        if code:
            self._emergency.raise_error(code, ErrorRegister.COMMUNICATION, source=self._number)

    def _deadline_met(self) -> None:
        self._emergency.clear_error(PDO_DEADLINE, self._number)

    def _on_deadline(self, now: Instant) -> None:
        self.reception.missed = True
        self._emergency.raise_error(PDO_DEADLINE, ErrorRegister.COMMUNICATION, source=self._number)
        self.station.application.on_communication_loss(CommunicationLoss.RPDO_DEADLINE, 0, now)

    def forget_errors(self) -> None:
        """At a reset: no error of the past is to be cleared later."""
        self.reception.missed = False
        self.reception.wrong_length = 0
